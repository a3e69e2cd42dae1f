"""The compiled engine behind JAX: one call out of a traced program for a whole batch of rollouts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.fem import Material
from rfdropo_bayes.fem.native.layered import NativeLayered
from rfdropo_bayes.simulators.trunk import Assembly, Motion

Inputs = tuple[Material, Float[Array, " cable"], Float[Array, "step cable"]]

# Relative perturbation of a central difference. Its error is of second order in it, that of rounding (1e-13 m and
# 1e-5 m of the positions) is divided by it: near the cube root of the precision both are small.
DIFFERENCE = {"float64": 1e-5, "float32": 1e-2}
# Sizes that perturbations are relative to, where a value may be zero: [m] of cable, [kg], [m/s2].
LENGTH, MASS, ACCELERATION = 0.05, 0.1, 9.81


def _relative_size(inputs: Inputs, directions: Inputs) -> Float[Array, ""]:
    """Largest component of a direction in units of what it changes; one for a direction that changes nothing."""
    material, start, displacement = inputs
    sizes = (
        Material(*(jnp.abs(value) + 1e-12 for value in material))._replace(
            gravity=jnp.full_like(material.gravity, ACCELERATION),
            point_mass=jnp.full_like(material.point_mass, MASS),
            rayleigh_mass=jnp.abs(material.rayleigh_mass) + 0.1,
            rayleigh_stiffness=jnp.abs(material.rayleigh_stiffness) + 0.01,
        ),
        jnp.full_like(start, LENGTH),
        jnp.full_like(displacement, LENGTH),
    )
    ratios = jax.tree.map(lambda d, s: jnp.max(jnp.abs(d) / s, initial=0.0), directions, sizes)
    largest = jnp.max(jnp.stack(jax.tree.leaves(ratios)))
    return jnp.where(largest > 0.0, largest, 1.0)


@dataclass(frozen=True)
class CompiledEngine:
    """The Numba engine: SIMD lanes and threads over the batch; the same numbers as the reference engine.

    Attributes:
        assembly: the discretised robot.
        time_step: of the simulation [s].
        from_equilibrium: start in the static equilibrium of the initial displacements, else undeformed.
        precision: of all arithmetic.
        threads: None for all processors.
    """

    assembly: Assembly
    time_step: float
    from_equilibrium: bool
    precision: Literal["float64", "float32"] = "float64"
    threads: int | None = None
    lanes: ClassVar[int] = 512
    differentiable: ClassVar[bool] = True

    @cached_property
    def _native(self) -> NativeLayered:
        return NativeLayered(
            self.assembly.system,
            self.assembly.markers,
            self.time_step,
            precision=self.precision,
            threads=self.threads,
            from_equilibrium=self.from_equilibrium,
        )

    def describe(self) -> dict[str, object]:
        """Name and precision."""
        return {"engine": "numba", "precision": self.precision, "device": "cpu"}

    def motion(
        self,
        material: Material,
        start: Float[Array, " cable"],
        displacement: Float[Array, "step cable"],
        steps: Int[Array, ""] | None,
    ) -> Motion:
        """See `Engine.motion`. Derivatives are central differences along each tangent, two rollouts per direction."""
        limit = jnp.asarray(displacement.shape[0] if steps is None else steps, jnp.float64)
        return self._differentiable((material, start, displacement), limit)

    @cached_property
    def _differentiable(self) -> Callable[[Inputs, Array], Motion]:
        @jax.custom_jvp
        def motion(inputs: Inputs, limit: Array) -> Motion:
            return self._call(inputs, limit)

        @motion.defjvp
        def _(primals: tuple, tangents: tuple) -> tuple[Motion, Motion]:
            (inputs, limit), (directions, _) = primals, tangents
            step = DIFFERENCE[self.precision] / _relative_size(inputs, directions)
            ahead, behind = (
                self._call(jax.tree.map(lambda x, d, s=sign: x + s * step * d, inputs, directions), limit)
                for sign in (1.0, -1.0)
            )
            slope = jax.tree.map(
                lambda a, b: (a - b) / (2.0 * step) if a.dtype == jnp.float64 else np.zeros(a.shape, jax.dtypes.float0),
                ahead,
                behind,
            )
            return self._call(inputs, limit), slope

        return motion

    def _call(self, inputs: Inputs, limit: Array) -> Motion:
        material, start, displacement = inputs
        rows, cables = displacement.shape[0] + 1, displacement.shape[1]
        shapes = Motion(
            jax.ShapeDtypeStruct((rows, len(self.assembly.markers.node), 3), jnp.float64),
            jax.ShapeDtypeStruct((rows, cables), jnp.float64),
            jax.ShapeDtypeStruct((), jnp.bool_),
            jax.ShapeDtypeStruct((), jnp.float64),
        )
        return jax.pure_callback(
            self._on_host, shapes, material, start, displacement, limit, vmap_method="broadcast_all"
        )

    def _on_host(self, material: Material, start, displacement, limit) -> Motion:
        """Flatten whatever batch axes vmap has added, roll out, and restore them."""
        displacement = np.asarray(displacement)
        batch = displacement.shape[:-2]
        count = int(np.prod(batch))
        flat = Material(*(_flatten(np.asarray(value), len(batch), count) for value in material))
        found = self._native.rollout(
            flat,
            _flatten(displacement, len(batch), count),
            start=_flatten(np.asarray(start), len(batch), count),
            steps=int(np.max(limit)),
        )
        rows = displacement.shape[-2] + 1
        return Motion(
            _padded(found.position, rows).reshape(*batch, rows, -1, 3),
            _padded(found.tension, rows).reshape(*batch, rows, displacement.shape[-1]),
            found.diverged.reshape(batch),
            found.residual.reshape(batch),
        )


def _flatten(array: np.ndarray, axes: int, count: int) -> np.ndarray:
    return array.reshape(count, *array.shape[axes:])


def _padded(recorded: np.ndarray, rows: int) -> np.ndarray:
    """Zero rows where fewer steps were computed than there are commands."""
    full = np.zeros((recorded.shape[0], rows, *recorded.shape[2:]))
    full[:, : recorded.shape[1]] = recorded
    return full
