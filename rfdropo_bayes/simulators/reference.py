"""The reference engine: the layered body in JAX, differentiable, on whatever device JAX finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import Material, PointMap, point_positions, prepare, simulate, simulate_prefix, state_at_rest
from rfdropo_bayes.fem import static_equilibrium as find_equilibrium
from rfdropo_bayes.fem.dynamics import Prepared, State, remembering, step
from rfdropo_bayes.simulators.session import LaneMotion, flat_lanes, lanes_like
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

    def body_lanes(self, count: int) -> ReferenceLanes:
        """See `Engine.body_lanes`."""
        return ReferenceLanes(self, count)

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


class _Lane(NamedTuple):
    """One body of a session."""

    prepared: Prepared
    state: State
    diverged: Bool[Array, ""]
    imbalance: Float[Array, ""]
    cables_converged: Bool[Array, ""]


class ReferenceLanes:
    """Bodies of a session in the reference engine: see `BodyLanes`."""

    def __init__(self, engine: ReferenceEngine, count: int) -> None:
        self._engine, self._count = engine, count
        self._lanes: _Lane | None = None

    @property
    def nbytes(self) -> int:
        """See `BodyLanes`."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self._lanes))

    def reset(
        self, rows: Int[np.ndarray, " row"], material: Material, start: Float[np.ndarray, "row cable"]
    ) -> LaneMotion:
        """See `BodyLanes`. All lanes are computed, so that one program serves any number of rows."""
        spread = np.zeros(self._count, int)
        spread[rows] = np.arange(len(rows))
        fresh = self._first(*jax.tree.map(lambda part: jnp.asarray(part)[spread], (material, start)))
        if self._lanes is None:
            self._lanes = fresh
        elif str(jax.tree.structure(fresh)) != str(jax.tree.structure(self._lanes)):
            raise InputError("a lane whose body has other effects than the lanes before", where="reset")
        self._lanes = jax.tree.map(lambda new, old: old.at[rows].set(new[rows]), fresh, self._lanes)
        return LaneMotion(*(part[rows] for part in self._shown()))

    def advance(self, displacement: Float[np.ndarray, "lane step cable"]) -> LaneMotion:
        """See `BodyLanes`."""
        self._lanes = self._moved(self._lanes, jnp.asarray(displacement))
        return self._shown()

    def save(self) -> Float[np.ndarray, "lane values"]:
        """See `BodyLanes`."""
        return flat_lanes(self._lanes, self._count)

    def restore(self, rows: Int[np.ndarray, " row"], state: Float[np.ndarray, "row values"]) -> None:
        """See `BodyLanes`."""
        whole = self.save()
        whole[rows] = state
        self._lanes = lanes_like(self._lanes, whole)

    def _shown(self) -> LaneMotion:
        assert self._lanes is not None
        lanes, markers = self._lanes, self._engine.assembly.markers
        position = jax.vmap(lambda nodes: point_positions(markers, nodes))(lanes.state.position)
        shown = position, lanes.state.tension, lanes.diverged, lanes.imbalance, lanes.cables_converged
        return LaneMotion(*map(np.asarray, shown))

    @cached_property
    def _first(self) -> Callable[[Material, Array], _Lane]:
        system = self._engine.assembly.system

        def first(material: Material, start: Float[Array, " cable"]) -> _Lane:
            prepared, imbalance = prepare(system, material), jnp.zeros(())
            state = state_at_rest(system)
            if self._engine.from_equilibrium:
                state, found = find_equilibrium(system, prepared, start)
                imbalance = found.residual
            state = remembering(system, prepared, state)
            return _Lane(prepared, state, jnp.array(False), imbalance, jnp.array(True))

        return jax.jit(jax.vmap(first))

    @cached_property
    def _moved(self) -> Callable[[_Lane | None, Array], _Lane]:
        system, time_step = self._engine.assembly.system, self._engine.time_step

        def moved(lane: _Lane, displacement: Float[Array, "step cable"]) -> _Lane:
            def one(before: _Lane, command: Float[Array, " cable"]) -> tuple[_Lane, None]:
                state, info = step(system, before.prepared, before.state, command, time_step)
                codes = before.diverged | info.diverged, before.cables_converged & info.cables_converged
                return before._replace(state=state, diverged=codes[0], cables_converged=codes[1]), None

            return jax.lax.scan(one, lane, displacement)[0]

        return jax.jit(jax.vmap(moved))
