"""The bodies of a session in an engine: lanes that continue from their last state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import point_positions
from rfdropo_bayes.fem.dynamics import Prepared, State, StepInfo, remembering, step
from rfdropo_bayes.fem.equilibrium import quasi_static_step
from rfdropo_bayes.fem.native.rod_session import RodSession
from rfdropo_bayes.fem.pushing import PushGeometry, smallest_gap
from rfdropo_bayes.fem.rigid_body import Cube
from rfdropo_bayes.fem.rod import joined
from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.fem.section_loads import loaded
from rfdropo_bayes.simulators.body_engine import CubeInputs, Engine, cube_arrays
from rfdropo_bayes.simulators.port_signals import BodySignals

TOUCHING = 0.001
"""[m] A body that overlaps the cube by less starts in contact. The first step then moves the cube by as much."""


class LaneStart(NamedTuple):
    """Start of lanes."""

    material: Any  # fem.Material; of a black box its parameters by name
    start: Float[Any, "*row cable"]  # displacements that the initial state belongs to [m]
    cube: CubeInputs | None
    loads: BodySignals | None = None  # that act on the initial state, in one row


class BodyLanes(Protocol):
    """The bodies of a session's lanes; their `Motion` is the present state, without an axis of rows, with the largest
    tensions of the period.
    """

    def reset(self, rows: Int[np.ndarray, " row"], given: LaneStart) -> Motion:
        """Start some lanes anew, with one entry per row; returns the motion of these rows."""

    def advance(self, displacement: Float[np.ndarray, "lane step cable"], loads: BodySignals | None = None) -> Motion:
        """Take steps to the cable displacements [m] at their ends, under the loads of each step; lanes without loads
        get None.
        """

    def save(self) -> Float[np.ndarray, "lane values"]:
        """A copy of the state, one row a lane."""

    def restore(self, rows: Int[np.ndarray, " row"], state: Float[np.ndarray, "row values"]) -> None:
        """Set lanes to rows of a saved state."""


def body_lanes(engine: Engine, count: int) -> BodyLanes:
    """Bodies for ``count`` lanes.

    Raises:
        InputError: an engine whose body is no rod.
    """
    if not engine.is_rod:
        raise InputError("a body of tetrahedra cannot run in control sessions", where="a session", remedy="use a rod")
    kind = ReferenceLanes if engine.backend.name == "jax" else CompiledLanes
    return kind(engine, count) if engine.scene is None else LanesBeforeCube(kind, engine, engine.scene, count)


class LanesBeforeCube:
    """Bodies that start clear of cube and plate: see `BodyLanes`.

    The equilibrium of a body ignores both, and a body that overlaps the cube would throw it away. The unbalanced force
    of a start in penetration counts as infinite.
    """

    def __init__(
        self, kind: Callable[[Engine, int], BodyLanes], engine: Engine, scene: PushGeometry, count: int
    ) -> None:
        markers: Any = engine.body.markers
        spheres: Any = scene.spheres
        self._shown, self._count = len(markers.weight), count
        body: Any = engine.body
        body = body._replace(markers=joined([markers, spheres.centre]))
        self._bodies = kind(replace(engine, body=body), count)
        self.save, self.restore = self._bodies.save, self._bodies.restore

        def gap(cube: CubeInputs, centre: Float[Array, "sphere 3"]) -> Float[Array, ""]:
            return smallest_gap(scene, cube.cube, cube.start, centre)

        self._gaps = jax.jit(jax.vmap(gap))

    def reset(self, rows: Int[np.ndarray, " row"], given: LaneStart) -> Motion:
        motion = self._bodies.reset(rows, given)
        # all lanes are computed, so that the same program serves any number of rows
        source = np.zeros(self._count, int)
        source[rows] = np.arange(len(rows))
        spheres = motion.position[:, self._shown :]
        gap = np.asarray(self._gaps(*jax.tree.map(lambda part: np.asarray(part)[source], (given.cube, spheres))))[rows]
        return self._markers(motion._replace(imbalance=np.where(gap < -TOUCHING, np.inf, motion.imbalance)))

    def advance(self, displacement: Float[np.ndarray, "lane step cable"], loads: BodySignals | None = None) -> Motion:
        return self._markers(self._bodies.advance(displacement, loads))

    def _markers(self, motion: Motion) -> Motion:
        return motion._replace(position=motion.position[:, : self._shown])


class CompiledLanes:
    """Bodies in the compiled engine: see `BodyLanes`."""

    def __init__(self, engine: Engine, count: int) -> None:
        self._session, self._from_equilibrium = RodSession(engine.native, count), engine.from_equilibrium
        self._acting, self._at_rest = engine.section_loads, engine.at_rest
        self.save, self.restore = self._session.save, self._session.restore

    def reset(self, rows: Int[np.ndarray, " row"], given: LaneStart) -> Motion:
        cube = None if given.cube is None else cube_arrays(given.cube)
        begin = {"start" if self._from_equilibrium else "before": given.start}
        return _last(self._session.reset(rows, given.material, **begin, cube=cube, loads=self._acting(given.loads)))

    def advance(self, displacement: Float[np.ndarray, "lane step cable"], loads: BodySignals | None = None) -> Motion:
        if self._at_rest:
            displacement, loads = _ends(displacement, loads)
        return _last(self._session.advance(displacement, loads=self._acting(loads)), begun=1)


def _ends(
    displacement: Float[np.ndarray, "lane step cable"], loads: BodySignals | None
) -> tuple[Float[np.ndarray, "lane 1 cable"], BodySignals | None]:
    """The last step alone, as a body at rest takes it."""
    return displacement[:, -1:], jax.tree.map(lambda part: part[:, -1:], loads)


def _last(motion: Motion, begun: int = 0) -> Motion:
    """The last recorded row, and the largest tensions of rows from ``begun`` on."""
    pose, peak = None if motion.pose is None else motion.pose[:, -1], motion.tension[:, begun:].max(axis=1)
    return motion._replace(position=motion.position[:, -1], tension=motion.tension[:, -1], pose=pose, peak=peak)


class _Lane(NamedTuple):
    """One body of a session."""

    prepared: Prepared
    state: State
    diverged: Bool[Array, ""]
    imbalance: Float[Array, ""]
    converged: Bool[Array, ""]
    cube: Cube | None


class ReferenceLanes:
    """Bodies in the reference engine: see `BodyLanes`."""

    def __init__(self, engine: Engine, count: int) -> None:
        self._engine, self._count = engine, count
        self._system: Any = engine.body.system
        self._lanes: _Lane | None = None

    def reset(self, rows: Int[np.ndarray, " row"], given: LaneStart) -> Motion:
        """See `BodyLanes`. All lanes are computed, so that the same compiled program works for any number of rows."""
        source = np.zeros(self._count, int)
        source[rows] = np.arange(len(rows))
        fresh = self._first(jax.tree.map(lambda part: jnp.asarray(part)[source], given))
        if self._lanes is None:
            self._lanes = fresh
        elif str(jax.tree.structure(fresh)) != str(jax.tree.structure(self._lanes)):
            raise InputError("a lane has other body effects than earlier lanes", where="reset")
        self._lanes = jax.tree.map(lambda new, old: old.at[rows].set(new[rows]), fresh, self._lanes)
        return Motion(*(None if part is None else part[rows] for part in self._shown(self._lanes.state.tension)))

    def advance(self, displacement: Float[np.ndarray, "lane step cable"], loads: BodySignals | None = None) -> Motion:
        if self._engine.at_rest:
            displacement, loads = _ends(displacement, loads)
        self._lanes, peak = self._moved(self._lanes, jnp.asarray(displacement), loads)
        return self._shown(peak)

    def save(self) -> Float[np.ndarray, "lane values"]:
        return flat_lanes(self._lanes, self._count)

    def restore(self, rows: Int[np.ndarray, " row"], state: Float[np.ndarray, "row values"]) -> None:
        whole = self.save()
        whole[rows] = state
        self._lanes = lanes_like(self._lanes, whole)

    def _shown(self, peak: Float[Array, "lane cable"]) -> Motion:
        assert self._lanes is not None
        lanes, markers = self._lanes, self._engine.body.markers
        place = lanes.state.position, lanes.state.orientation
        position = jax.vmap(lambda *stations: point_positions(markers, *stations))(*place)
        cube, pose = lanes.state.cube, None
        if cube is not None:
            pose = np.concatenate([cube.position, cube.orientation], axis=1)
        parts = position, lanes.state.tension, lanes.diverged, lanes.imbalance, lanes.converged
        shown: Any = [*map(np.asarray, parts), pose, np.asarray(peak)]
        return Motion(*shown)

    @cached_property
    def _first(self) -> Callable[[LaneStart], _Lane]:
        engine = self._engine

        def first(given: LaneStart) -> _Lane:
            prepared, state, imbalance = engine.initial(given.material, given.start, given.loads)
            state = remembering(self._system, prepared, state, engine.scene, engine.integrator)
            solid, place = (None, None) if given.cube is None else given.cube
            return _Lane(prepared, state._replace(cube=place), jnp.array(False), imbalance, jnp.array(True), solid)

        return jax.jit(jax.vmap(first))

    @cached_property
    def _moved(self) -> Callable[[_Lane | None, Array, BodySignals | None], tuple[_Lane, Array]]:
        system, time_step, engine = self._system, self._engine.time_step, self._engine

        def moved(
            lane: _Lane, displacement: Float[Array, "step cable"], loads: BodySignals | None
        ) -> tuple[_Lane, Float[Array, " cable"]]:
            acting = engine.section_loads(loads)

            def one(before: _Lane, given: tuple[Float[Array, " cable"], Int[Array, ""]]) -> tuple[_Lane, Array]:
                under, force = before.prepared, cast("Array | float", 0.0)
                if acting is not None:
                    under, force = loaded(system, under, acting, given[1])
                if engine.at_rest:
                    codes = StepInfo(before.diverged, before.converged)
                    state, info = quasi_static_step(system, under, before.state, given[0], force, codes)
                else:
                    around = force, engine.scene, before.cube
                    state, info = step(system, under, before.state, given[0], time_step, *around, engine.integrator)
                diverged, converged = before.diverged | info.diverged, before.converged & info.converged
                return before._replace(state=state, diverged=diverged, converged=converged), state.tension

            lane, tension = jax.lax.scan(one, lane, (displacement, jnp.arange(len(displacement))))
            return lane, tension.max(axis=0)

        return jax.jit(jax.vmap(moved))


def flat_lanes(tree: Any, count: int) -> Float[np.ndarray, "lane values"]:
    """All leaves of a tree, one row a lane; whole numbers as floats."""
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(tree)]
    rows = [leaf.reshape(len(leaf), -1) for leaf in leaves]
    return np.concatenate([np.zeros((count, 0)), *rows], axis=1)


def lanes_like(tree: Any, flat: Float[np.ndarray, "lane values"]) -> Any:
    """The inverse of `flat_lanes`, with the shapes and types of a tree."""
    leaves, structure = jax.tree.flatten(tree)
    ends = np.cumsum([leaf[0].size for leaf in leaves])[:-1]
    parts = np.split(flat, ends, axis=1)[: len(leaves)]
    like = [jnp.asarray(p.reshape(leaf.shape), leaf.dtype) for p, leaf in zip(parts, leaves, strict=True)]
    return jax.tree.unflatten(structure, like)
