"""The compiled engine behind JAX: one call out of a traced program for a whole batch of rollouts."""

from __future__ import annotations

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
    differentiable: ClassVar[bool] = False

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
        """See `Engine.motion`."""
        rows, cables = displacement.shape[0] + 1, displacement.shape[1]
        markers = len(self.assembly.markers.node)
        limit = jnp.asarray(displacement.shape[0] if steps is None else steps)
        shapes = Motion(
            jax.ShapeDtypeStruct((rows, markers, 3), jnp.float64),
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
