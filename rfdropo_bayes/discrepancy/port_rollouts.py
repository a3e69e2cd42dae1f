"""Rollouts with laws at ports whose coefficients are further coordinates beside the simulator's.

One compiled simulator serves all laws: their signals are computed outside and handed over with the commands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.bayes.batches import chunk_sizes, in_chunks
from rfdropo_bayes.bayes.lanes import Fields, Lanes
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.discrepancy.forward import Forward, Points
from rfdropo_bayes.discrepancy.journal import digest
from rfdropo_bayes.mechanisms.default_priors import normal
from rfdropo_bayes.mechanisms.features import Feature, gauges_of, motion_dictionary
from rfdropo_bayes.mechanisms.laws import FAR, shape_spec, unit_of
from rfdropo_bayes.mechanisms.ports import Port, PortMap, sensed
from rfdropo_bayes.simulators.callbacks import distinct
from rfdropo_bayes.simulators.commands import Commands, observed_at
from rfdropo_bayes.simulators.extended import ExtendedSimulator
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.robot_simulator import PASSES, RobotSimulator

Signals = Float[np.ndarray, "lane row"]
PREFIX = "law_"
"""Prefix of the names of coefficients."""


class Scope(NamedTuple):
    """The recordings in which a law acts: one group's, or all if ``group`` is empty."""

    group: str = ""
    recordings: tuple[str, ...] = ()

    def has(self, recordings: Sequence[str]) -> Bool[np.ndarray, " recording"]:
        """Mask of the given recordings in which the law acts."""
        return np.array([not self.group or name in self.recordings for name in recordings])


EVERYWHERE = Scope()


class PlacedTerm(NamedTuple):
    """A term of a law: the port, the feature, its coefficient, its shape if that is also a parameter, and the
    recordings in which it acts.
    """

    port: Port
    feature: Feature
    spec: ParameterSpec
    shape: ParameterSpec | None = None
    scope: Scope = EVERYWHERE

    @property
    def place(self) -> tuple[Port, Feature, str]:
        """The port, the feature and the group, which no two terms of a law share."""
        return self.port, self.feature, self.scope.group

    @property
    def specs(self) -> tuple[ParameterSpec, ...]:
        """Its parameters."""
        return (self.spec,) if self.shape is None else (self.spec, self.shape)

    def with_shape(self, command_unit: str) -> PlacedTerm:
        """The term with the shape of its feature as a parameter."""
        return self._replace(shape=shape_spec(f"{self.spec.name}_shape", self.feature, command_unit))


class FeatureTable:
    """Values of features over the steps of a simulator, compiled once for a whole audit.

    Args:
        lanes: the simulator.
        features: all features of time and commands; features of motion are added if the body supports them.
    """

    def __init__(self, lanes: Lanes, features: Sequence[Feature]) -> None:
        self.lanes, self.features = lanes, tuple(features)
        self._of_shape: dict[Feature, Any] = {}
        simulator: Any = lanes.simulator
        self.time_step = float(simulator.description["time_step_s"])
        carries = isinstance(simulator, RobotSimulator) and simulator.engine.carries_loads
        self.of_motion = tuple(motion_dictionary()) if carries else ()

    @cached_property
    def _levels(self) -> Any:
        simulator = self.lanes.simulator

        def one(theta: jax.Array, commands: Commands) -> jax.Array:
            initial, command = jnp.asarray(commands.initial), jnp.asarray(commands.step)
            if isinstance(simulator, ExtendedSimulator):
                values = dict(zip(self.lanes.physical, theta, strict=True))
                initial, command = simulator.actuated(values, commands, self.time_step)
            return jnp.concatenate([initial[None], command])

        return jax.jit(jax.vmap(one))

    @cached_property
    def _values(self) -> Any:
        def one(levels: jax.Array) -> jax.Array:
            return jnp.stack([feature.over(levels, self.time_step) for feature in self.features])

        return jax.jit(jax.vmap(one))

    def shaped(
        self, levels: Float[np.ndarray, "lane row channel"], feature: Feature, shape: Float[np.ndarray, " lane"]
    ) -> Float[np.ndarray, "lane row"]:
        """One feature, with a shape of its own in every lane."""
        once, again = distinct([levels, shape])
        kind = feature._replace(shape=None)
        if kind not in self._of_shape:
            self._of_shape[kind] = jax.jit(jax.vmap(lambda own, shape: kind.in_shape(shape).over(own, self.time_step)))
        values, lanes = self._of_shape[kind], (levels[once], shape[once])
        return np.asarray(in_chunks(lambda own: values(*own), lanes, chunk_sizes(self.lanes.width)))[again]

    @cached_property
    def _paths(self) -> Any:
        simulator = self.lanes.simulator
        assert isinstance(simulator, RobotSimulator)

        def one(theta: jax.Array, commands: Commands) -> jax.Array:
            values = dict(zip(self.lanes.physical, theta, strict=True))
            gauges = gauges_of(simulator.path(values, commands))
            return jnp.stack([feature.over(gauges, self.time_step) for feature in self.of_motion])

        return jax.jit(jax.vmap(one))

    def over_motion(
        self, theta: Float[np.ndarray, "lane physical"], commands: Commands, check: Callable[[], None] = lambda: None
    ) -> Float[np.ndarray, "lane feature row"]:
        """Features of the motion that commands and their signals make, all that a body can carry.

        ``check`` is called before every batch of rollouts, and may raise.
        """
        once, again = distinct([theta, *map(np.asarray, jax.tree.leaves(commands))])
        lanes = (theta[once], commands.of(once))
        features = in_chunks(lambda own: self._paths(*own), lanes, (self.lanes.width,), before=check)
        return np.asarray(features)[again]

    def levels(self, theta: Float[np.ndarray, "lane physical"], commands: Commands) -> np.ndarray:
        """Commands that reach the ports, without signals (lane, row, channel)."""
        plain = commands._replace(signals=None)
        return np.asarray(in_chunks(lambda own: self._levels(*own), (theta, plain), (self.lanes.width,)))

    def over(
        self, levels: Float[np.ndarray, "lane row channel"], chosen: Sequence[Feature] | None = None
    ) -> Float[np.ndarray, "lane feature row"]:
        """Features, all by default; computed once for lanes with the same commands."""
        once, again = distinct([levels])
        features = in_chunks(lambda own: self._values(*own), (levels[once],), chunk_sizes(self.lanes.width))
        places = slice(None) if chosen is None else [self.features.index(feature) for feature in chosen]
        return np.asarray(features)[:, places][again]


@partial(jax.jit, static_argnames=("port", "ports"))
def _port_signals(ports: PortMap, port: Port, w: jax.Array) -> Any:
    return jax.vmap(lambda own: ports.signals(port, own))(w)


@partial(jax.jit, static_argnames="port")
def _sensed(port: Port, w: jax.Array, position: jax.Array, time: jax.Array) -> jax.Array:
    return jax.vmap(lambda *own: sensed(port, *own))(w, position, time)


def signals_of(ports: PortMap, acting: Sequence[tuple[Port, Signals]]) -> Any:
    """Signals at ports of actuation and of the body together; None if there are none."""
    given = [(port, w) for port, w in acting if port.stage != "sensing"]
    if not given:
        return None
    # Ports are hashable without the mapping of excluded ports.
    plain = ports._replace(left_out=())  # type: ignore[arg-type]
    signals = [_port_signals(plain, port, w) for port, w in given]
    return jax.tree.map(lambda *parts: np.sum([np.asarray(part) for part in parts], axis=0), *signals)


def as_sensed(
    acting: Sequence[tuple[Port, Signals]],
    position: Float[np.ndarray, "lane time marker 3"],
    commands: Commands,
    dt: float,
) -> np.ndarray:
    """Positions as they are measured with signals at ports of sensing."""
    time = np.asarray(observed_at(commands, dt))
    step, share = np.asarray(commands.sample_step), np.asarray(commands.sample_fraction)
    for port, w in acting:
        if port.stage == "sensing":
            before = np.take_along_axis(w, step, axis=1)
            after = np.take_along_axis(w, np.minimum(step + 1, w.shape[1] - 1), axis=1)
            position = np.asarray(_sensed(port, before + share * (after - before), position, time - time[:, :1]))
    return position


class PortedForward(Forward):
    """`Forward` with laws at ports.

    Args:
        forward: without them.
        ports: ports of the simulator.
        table: table of the laws' features.
        terms: their coefficients, which become the last coordinates.
    """

    def __init__(self, forward: Forward, ports: PortMap, table: FeatureTable, terms: Sequence[PlacedTerm]) -> None:
        self.__dict__.update({k: v for k, v in forward.__dict__.items() if k != "identity"})
        self.plain, self.ports, self.table, self.terms = forward, ports, table, tuple(terms)
        specs = [spec for term in terms for spec in term.specs]  # measured from null in prior deviations
        further = build_scopes(specs, {spec.name: {} for spec in specs}, {}, ())
        self.coordinates = forward.coordinates.with_further(further)
        added = np.full((len(forward.slots), len(self._own)), -1)
        self.slots = np.concatenate([forward.slots, added], axis=1)
        self.forget()

    @cached_property
    def identity(self) -> str:
        """Digest of the inputs of rollouts."""
        own = self.coordinates
        scale = own.values(np.stack([np.zeros(len(own.names)), np.ones(len(own.names))]))
        terms = [(t.port.name, t.feature, t.specs, t.scope.has(self.recordings).tolist()) for t in self.terms]
        return digest(self.plain.identity, repr(terms), scale)

    def instead_of(self, forward: Forward, table: FeatureTable) -> PortedForward:
        """The same laws on other rollouts, as of other recordings or of a finer simulator."""
        return PortedForward(forward, self.ports, table, self.terms)

    def with_difference(self, step: float) -> Forward:
        """See `Forward.with_difference`."""
        return self.instead_of(self.plain.with_difference(step), self.table)

    @property
    def _own(self) -> list[str]:
        """Names of the laws' parameters, the last coordinates."""
        return [spec.name for term in self.terms for spec in term.specs]

    def _beside(self, points: Points) -> Float[np.ndarray, "n k"]:
        return self.coordinates.values(points)[:, len(self.coordinates.names) - len(self._own) :]

    def _acting(
        self, theta: np.ndarray, commands: Commands, points: Points, terms: Sequence[PlacedTerm]
    ) -> list[tuple[Port, Signals]]:
        """Signals of every lane at each port that has some of the law's terms."""
        flat = theta.reshape(-1, theta.shape[-1])
        own = dict(zip(self._own, np.repeat(self._beside(points), self.count, axis=0).T, strict=True))
        for term in terms:
            own[term.spec.name] = own[term.spec.name] * np.tile(term.scope.has(self.recordings), len(points))
        parts = [(t, m) for t in terms if not t.feature.of_motion for m in self.ports.members(t.port)]
        by_port: dict[Port, Signals] = {}
        if parts:
            levels = self.table.levels(flat, commands)
            fixed = [(term, member) for term, member in parts if term.shape is None]
            values = self.table.over(levels, [t.feature.of(m.number) for t, m in fixed]) if fixed else np.zeros(0)
            signals = [(*part, values[:, place]) for place, part in enumerate(fixed)]
            signals += [
                (t, m, self.table.shaped(levels, t.feature.of(m.number), own[t.shape.name]))
                for t, m in parts
                if t.shape is not None
            ]
            for term, member, w in signals:
                by_port[member] = by_port.get(member, 0.0) + own[term.spec.name][:, None] * w
        following = [term for term in terms if term.feature.of_motion]
        acting = by_port
        for _ in range(PASSES if following else 0):
            signals = signals_of(self.ports, list(acting.items()))
            values = self.table.over_motion(flat, commands._replace(signals=signals), self.deadline.check)
            acting = dict(by_port)
            for term in following:
                w = own[term.spec.name][:, None] * values[:, self.table.of_motion.index(term.feature)]
                acting[term.port] = acting.get(term.port, 0.0) + w
        return list(acting.items())

    def _per_lane(self, theta: np.ndarray, points: Points) -> tuple[np.ndarray, np.ndarray, Commands]:
        flat, start, commands = super()._per_lane(theta, points)
        moving = [term for term in self.terms if term.port.stage != "sensing"]
        signals = signals_of(self.ports, self._acting(theta, commands, points, moving))
        return flat, start, commands._replace(signals=signals)

    def _as_seen(self, fields: Fields, theta: np.ndarray, points: Points) -> Fields:
        seen_by = [term for term in self.terms if term.port.stage == "sensing"]  # they do not move the body
        if not seen_by:
            return fields
        commands = self.commands.of(np.tile(np.arange(self.count), len(points)))
        acting = self._acting(theta, commands, points, seen_by)
        shift = self._offset(theta).reshape(-1, 1, 1, 3)  # of the measuring frame, which comes last
        seen = as_sensed(acting, fields["position"] - shift, commands, self.table.time_step)
        return {**fields, "position": seen + shift}


def with_laws_of(own: Forward, forward: Forward) -> Forward:
    """Rollouts of other recordings, with the laws that a model's own rollouts have."""
    if not isinstance(own, PortedForward):
        return forward
    table = own.table if forward.lanes is own.table.lanes else FeatureTable(forward.lanes, own.table.features)
    return own.instead_of(forward, table)


def placed(
    port: Port, feature: Feature, size: float, channels: Sequence[str], unit: str, scope: Scope = EVERYWHERE
) -> PlacedTerm:
    """A term whose coefficient has the prior scale ``size`` times the port's size over the feature's size."""
    scale = float(f"{SPREAD * port.size / max(size, 1e-300):.3g}")
    name = coefficient_name(port, feature, channels, scope.group)
    words = f"of the law at {port.words}: it changes {feature.words(channels)}"
    return PlacedTerm(
        port,
        feature,
        ParameterSpec(name, unit_of(port.unit, feature, unit), -FAR * scale, FAR * scale, 0.0, normal(scale), words),
        scope=scope,
    )


def coefficient_name(port: Port, feature: Feature, channels: Sequence[str], group: str = "") -> str:
    """Name of the parameter that is the coefficient of a feature at a port, in one group of recordings or in all."""
    at = f"{port.name} {feature.kind} {' '.join(feature.commands(channels))}".strip()
    shape = "" if feature.shape is None else f"_{feature.shape:.3g}"
    own = f"_in_{group}" if group else ""
    return f"{PREFIX}{at.replace(' ', '_')}{shape}{own.replace(' ', '_')}"


SPREAD = 3.0
"""Scale of a coefficient's prior in sizes of its port: wide, so that data decide."""
