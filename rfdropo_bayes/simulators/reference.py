"""The reference engine: the layered body in JAX, differentiable, on whatever device JAX finds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rfdropo_bayes.fem import Material, PointMap, point_positions, prepare, simulate, simulate_prefix, state_at_rest
from rfdropo_bayes.fem import static_equilibrium as find_equilibrium
from rfdropo_bayes.simulators.trunk import Assembly, Motion


@dataclass(frozen=True)
class ReferenceEngine:
    """One linear solve a step by block elimination, double precision.

    Attributes:
        assembly: the discretised robot.
        time_step: of the simulation [s].
        from_equilibrium: start in the static equilibrium of the initial displacements, else undeformed.
    """

    assembly: Assembly
    time_step: float
    from_equilibrium: bool
    lanes: ClassVar[int] = 64

    def describe(self) -> dict[str, object]:
        """Name and precision."""
        return {"engine": "jax", "precision": "float64", "device": jax.devices()[0].platform}

    def recording(self, points: PointMap) -> ReferenceEngine:
        """See `Engine.recording`."""
        return replace(self, assembly=self.assembly._replace(markers=points))

    def motion(
        self,
        material: Material,
        start: Float[Array, " cable"],
        displacement: Float[Array, "step cable"],
        steps: Int[Array, ""] | None,
    ) -> Motion:
        """See `Engine.motion`."""
        system, markers = self.assembly.system, self.assembly.markers
        prepared = prepare(system, material)
        imbalance = jnp.zeros(())
        state = state_at_rest(system)
        if self.from_equilibrium:
            state, found = find_equilibrium(system, prepared, start)
            imbalance = found.residual
        rows = displacement[:, None, :]
        if steps is None:
            rollout = simulate(system, prepared, state, rows, self.time_step, markers)
        else:
            rollout = simulate_prefix(system, prepared, state, rows, self.time_step, markers, steps)
        first = point_positions(markers, state.position)
        return Motion(
            jnp.concatenate([first[None], rollout.position]),
            jnp.concatenate([state.tension[None], rollout.tension]),
            rollout.diverged,
            imbalance,
            rollout.cables_converged,
        )
