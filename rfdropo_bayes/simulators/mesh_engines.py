"""Engines for a body of tetrahedra: in JAX, differentiable; and compiled, one call out of a traced program a batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.fem import PointMap, point_positions
from rfdropo_bayes.fem.native.tetrahedral_engine import TetrahedralEngine
from rfdropo_bayes.fem.tetrahedral_dynamics import TetrahedralMaterial, simulate, state_at_rest
from rfdropo_bayes.simulators.compiled import flattened, padded
from rfdropo_bayes.simulators.differences import (
    ACCELERATION,
    LENGTH,
    MASS_DAMPING,
    STIFFNESS_DAMPING,
    with_differences,
)
from rfdropo_bayes.simulators.mesh_body import MeshAssembly

Inputs = tuple[TetrahedralMaterial, Float[Array, "step cable"]]


class MeshMotion(NamedTuple):
    """What an engine returns: rows are time steps, row 0 is the initial state."""

    position: Float[Array, "row marker 3"]
    tension: Float[Array, "row cable"]
    diverged: Bool[Array, ""]
    cables_converged: Bool[Array, ""]


class MeshEngine(Protocol):
    """Computes the motion of a body of tetrahedra from rest.

    Attributes:
        lanes: how many rollouts it likes to be given at once.
    """

    lanes: ClassVar[int]

    def describe(self) -> dict[str, object]:
        """Name and precision, for the record."""

    def motion(
        self, material: TetrahedralMaterial, displacement: Float[Array, "step cable"], steps: Int[Array, ""] | None
    ) -> MeshMotion:
        """Roll out; ``steps`` limits the steps computed, later rows hold no meaning."""

    def recording(self, points: PointMap) -> MeshEngine:
        """The same engine in double precision, recording these points of the body in place of the markers."""


@dataclass(frozen=True)
class ReferenceMeshEngine:
    """Double precision, on whatever device JAX finds; it always computes all steps.

    Attributes:
        assembly: the robot with its mesh.
        time_step: of the simulation [s].
    """

    assembly: MeshAssembly
    time_step: float
    lanes: ClassVar[int] = 16

    def describe(self) -> dict[str, object]:
        """Name and precision."""
        return {"engine": "jax", "precision": "float64", "device": jax.devices()[0].platform}

    def recording(self, points: PointMap) -> ReferenceMeshEngine:
        """See `MeshEngine.recording`."""
        return replace(self, assembly=self.assembly._replace(markers=points))

    def motion(
        self, material: TetrahedralMaterial, displacement: Float[Array, "step cable"], steps: Int[Array, ""] | None
    ) -> MeshMotion:
        """See `MeshEngine.motion`."""
        system, markers = self.assembly.system, self.assembly.markers
        state = state_at_rest(system)
        rollout = simulate(system, material, state, displacement[:, None, :], self.time_step, markers)
        first = point_positions(markers, state.position)
        return MeshMotion(
            jnp.concatenate([first[None], rollout.position]),
            jnp.concatenate([state.tension[None], rollout.tension]),
            rollout.diverged,
            rollout.cables_converged,
        )


def input_sizes(inputs: Inputs) -> Inputs:
    """Sizes that perturbations of the inputs are relative to."""
    material, displacement = inputs
    magnitudes = TetrahedralMaterial(*(jnp.abs(value) + 1e-12 for value in material))._replace(
        gravity=jnp.full_like(material.gravity, ACCELERATION),
        rayleigh_mass=jnp.abs(material.rayleigh_mass) + MASS_DAMPING,
        rayleigh_stiffness=jnp.abs(material.rayleigh_stiffness) + STIFFNESS_DAMPING,
    )
    return magnitudes, jnp.full_like(displacement, LENGTH)


def with_start(
    assembly: MeshAssembly, position: Float[np.ndarray, "batch rows marker 3"], tension: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Recorded markers and tensions with the body at rest before them."""
    markers, count = assembly.markers, len(position)
    first = np.einsum("pk,pki->pi", markers.weight, assembly.system.body.rest[markers.node])
    start = np.broadcast_to(first, (count, 1, *first.shape)), np.zeros((count, 1, tension.shape[-1]))
    return np.concatenate([start[0], position], axis=1), np.concatenate([start[1], tension], axis=1)


@dataclass(frozen=True)
class CompiledMeshEngine:
    """The Numba engine: SIMD lanes and threads over the batch; the same numbers as the reference engine.

    Attributes:
        assembly: the robot with its mesh.
        time_step: of the simulation [s].
        precision: of all arithmetic.
        threads: None for all processors.
        difference: of derivatives, see `with_differences`.
    """

    assembly: MeshAssembly
    time_step: float
    precision: Literal["float64", "float32"] = "float64"
    threads: int | None = None
    difference: float | None = None
    lanes: ClassVar[int] = 64

    @cached_property
    def _native(self) -> TetrahedralEngine:
        system = self.assembly.system
        return TetrahedralEngine(
            system.body,
            system.cables,
            system.limits,
            self.assembly.markers,
            dtype=np.dtype(self.precision).type,
            threads=self.threads,
        )

    def describe(self) -> dict[str, object]:
        """Name and precision."""
        return {"engine": "numba", "precision": self.precision, "device": "cpu"}

    def recording(self, points: PointMap) -> CompiledMeshEngine:
        """See `MeshEngine.recording`."""
        return replace(self, assembly=self.assembly._replace(markers=points), precision="float64")

    def motion(
        self, material: TetrahedralMaterial, displacement: Float[Array, "step cable"], steps: Int[Array, ""] | None
    ) -> MeshMotion:
        """See `MeshEngine.motion`. Derivatives are central differences along each tangent."""
        limit = jnp.asarray(displacement.shape[0] if steps is None else steps, jnp.float64)
        return self._differentiable((material, displacement), limit)

    @cached_property
    def _differentiable(self) -> Callable[[Inputs, Array], MeshMotion]:
        return with_differences(self._call, input_sizes, self.precision, difference=self.difference)

    def _call(self, inputs: Inputs, limit: Array) -> MeshMotion:
        material, displacement = inputs
        rows, cables = displacement.shape[0] + 1, displacement.shape[1]
        shapes = MeshMotion(
            jax.ShapeDtypeStruct((rows, len(self.assembly.markers.node), 3), jnp.float64),
            jax.ShapeDtypeStruct((rows, cables), jnp.float64),
            jax.ShapeDtypeStruct((), jnp.bool_),
            jax.ShapeDtypeStruct((), jnp.bool_),
        )
        return jax.pure_callback(self._on_host, shapes, material, displacement, limit, vmap_method="broadcast_all")

    def _on_host(self, material: TetrahedralMaterial, displacement: Array, limit: Array) -> MeshMotion:
        """Flatten whatever batch axes vmap has added, roll out, and restore them."""
        batch, rows = displacement.shape[:-2], displacement.shape[-2] + 1
        count = int(np.prod(batch))
        found = self._native.rollouts(
            {name: flattened(np.asarray(v), len(batch), count) for name, v in material._asdict().items()},
            flattened(np.asarray(displacement), len(batch), count)[:, : int(np.max(limit))],
            time_step=self.time_step,
        )
        position, tension = with_start(self.assembly, found.position, found.tension)
        return MeshMotion(
            padded(position, rows).reshape(*batch, rows, -1, 3),
            padded(tension, rows).reshape(*batch, rows, displacement.shape[-1]),
            found.diverged.reshape(batch),
            found.cables_converged.reshape(batch),
        )
