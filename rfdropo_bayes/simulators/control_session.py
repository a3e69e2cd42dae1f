"""Sessions: many robots that advance by one control period per call, each with its own parameters and time.

A session is a rollout in parts: drives, mechanisms, body and cameras are the same, and their states are kept between
calls. Its state is plain arrays with one row per lane.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import astuple, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.robots import Travel
from rfdropo_bayes.simulators.body_lanes import BodyLanes, LaneStart, flat_lanes, lanes_like
from rfdropo_bayes.simulators.commands import carried_out
from rfdropo_bayes.simulators.extended import Wound
from rfdropo_bayes.simulators.mechanisms import (
    ActuationMechanism,
    CommandedSensingMechanism,
    Mechanism,
    PushingMechanism,
    SensingMechanism,
    SignallingMechanism,
    SteppedMechanism,
    TimedSensingMechanism,
    Values,
    inside_drive,
    settled,
)
from rfdropo_bayes.simulators.parameters import check_names, check_value
from rfdropo_bayes.simulators.port_signals import BodySignals
from rfdropo_bayes.simulators.protocol import Observation
from rfdropo_bayes.simulators.robot_simulator import status_of

WHOLE = 1e-6  # how far a control period may be from a whole number of time steps, in time steps


class _Drives(NamedTuple):
    """State of the drives of a lane between two steps."""

    cables: tuple[Any, ...]  # memory of every mechanism between command and cables
    encoders: tuple[Any, ...]  # and mechanisms that an encoder shows, again: other mechanisms may lie between them
    wound: Wound
    # memory of mechanisms that act on the body or on the markers depending on the commands at the cables
    signals: tuple[Any, ...]


class _Past(NamedTuple):
    """The last commands of every lane, as far as drives still carry them out."""

    given: Float[np.ndarray, "lane command"]  # [s] since the lane was started
    value: Float[np.ndarray, "lane command channel"]
    periods: Int[np.ndarray, " lane"]


class Session:
    """Lanes of one robot, commanded once per control period.

    Args:
        simulator: simulator of the lanes.
        lanes: number of lanes.
        period: control period [s], a whole number of time steps.
        recording: recording whose drive limits apply, if they differ between recordings; by default the limits of all
            recordings.

    Raises:
        InputError: an invalid period, or a mechanism without a stepwise form.
    """

    def __init__(self, simulator: Any, lanes: int, period: float, recording: str = "") -> None:
        self.simulator, self.lanes, self.period, self.recording = simulator, lanes, float(period), recording
        self.robot = simulator.robot
        self.steps = round(period / simulator.time_step)
        if self.steps < 1 or abs(self.steps - period / simulator.time_step) > WHOLE:
            raise InputError(
                f"a control period of {period:g} s is not a whole number of time steps",
                remedy=f"give a multiple of {simulator.time_step:g} s",
            )
        self._check_mechanisms(simulator.mechanisms)
        self.bodies: BodyLanes = simulator.begin_lanes(lanes)
        self._specs = {spec.name: spec for spec in simulator.parameters}
        self._table = np.tile([spec.nominal for spec in self._specs.values()], (lanes, 1))
        self._values = jnp.asarray(self._table)
        kept = math.ceil(sum(simulator.command_timing) / self.period + WHOLE) + 2
        channels = len(self.robot.channel_names)
        self._past = _Past(np.full((lanes, kept), -np.inf), np.zeros((lanes, kept, channels)), np.zeros(lanes, int))
        self._travel = simulator.travel(recording, np.zeros(channels))
        if self._travel is not None:
            self._travel = Travel(*(np.tile(part, (lanes, 1)) for part in astuple(self._travel)))
        self._forgotten = np.zeros((lanes, channels))
        self._started = np.zeros(lanes, bool)
        self._drives, _, signals = self._first_drives(self._values, np.zeros((lanes, channels)))
        nowhere = np.zeros((lanes, len(self.robot.marker_names), 3))
        self._cameras = self._look(self._values, None, nowhere, np.zeros(lanes), signals)[0]

    @property
    def time(self) -> Float[np.ndarray, " lane"]:
        """Time of each lane since its start [s]."""
        return self.period * self._past.periods

    @property
    def nbytes(self) -> int:
        """Memory of the state of all lanes; scratch of the engine is not counted."""
        return sum(part.nbytes for part in self.save().values())

    @property
    def parameters(self) -> dict[str, Float[np.ndarray, " lane"]]:
        """Values of all parameters in every lane."""
        return {name: self._table[:, i].copy() for i, name in enumerate(self._specs)}

    def reset(
        self,
        rows: Int[np.ndarray, " row"],
        parameters: Mapping[str, Float[np.ndarray, " row"] | float],
        *,
        command: Float[np.ndarray, "row channel"] | None = None,
    ) -> Observation:
        """Start some lanes anew; the others continue.

        Args:
            rows: lanes.
            parameters: values by name, one per row or one for all of them; missing values are nominal.
            command: command before the start, to which the initial state belongs [m or rad]; zero by default.

        Returns:
            The first observation of these rows.

        Raises:
            InputError: no such lane or parameter, a value outside its hard bounds, a value that a mechanism cannot
                apply stepwise, or a command outside the travel of the drives.
        """
        rows = np.atleast_1d(np.asarray(rows, dtype=np.intp))
        if rows.size == 0 or rows.min() < 0 or rows.max() >= self.lanes or len(set(rows.tolist())) < len(rows):
            raise InputError(f"rows {rows.tolist()} of {self.lanes} lanes", where="reset", remedy="name each lane once")
        self._take_values(rows, parameters)
        first = np.zeros((len(rows), len(self.robot.channel_names))) if command is None else np.asarray(command, float)
        past = self._past
        past.given[rows], past.value[rows], past.periods[rows] = -np.inf, first[:, None], 0
        self._begin_travel(rows, first)
        fresh, angle, signals = self._first_drives(self._values, past.value[:, -1])
        chosen = np.zeros(self.lanes, bool)
        chosen[rows] = True
        self._drives = _chosen(chosen, fresh, self._drives)
        inputs = self._bodies_of(self._values, fresh.wound, signals)
        motion = self.bodies.reset(rows, jax.tree.map(lambda part: np.asarray(part)[rows], inputs))
        position = np.zeros((self.lanes, *motion.position.shape[1:]))
        position[rows] = motion.position
        cameras, seen = self._look(self._values, None, position, np.zeros(self.lanes), signals)
        self._cameras = _chosen(chosen, cameras, self._cameras)
        self._started |= chosen
        return self._observation(motion, np.asarray(seen)[rows], np.asarray(angle)[rows])

    def act(self, commands: Float[np.ndarray, "lane channel"]) -> Observation:
        """Let all lanes run for one control period with these commands [m or rad], in force from its start.

        Returns:
            The observation at the end of the period.

        Raises:
            InputError: lanes that were never reset, or commands of another shape or that are not finite.
        """
        if not self._started.all():
            raise InputError(f"lane {int(np.argmin(self._started))} was not started", remedy="reset all lanes first")
        commands = np.asarray(commands, float)
        expected = self.lanes, len(self.robot.channel_names)
        if commands.shape != expected or not np.isfinite(commands).all():
            raise InputError(
                f"commands of shape {commands.shape}, {int(np.sum(~np.isfinite(commands)))} of them not finite",
                where="act",
                remedy=f"give finite numbers of shape {expected}",
            )
        sent = self._sent(commands)
        self._drives, displacement, angle, signals, loads = self._move_drives(self._values, self._drives, sent)
        acting = {} if loads is None else {"loads": jax.tree.map(np.asarray, loads)}
        motion = self.bodies.advance(np.asarray(displacement), **acting)
        now = self.simulator.time_step * (self.steps * self._past.periods)
        self._cameras, seen = self._look(self._values, self._cameras, motion.position, now, signals)
        return self._observation(motion, np.asarray(seen), np.asarray(angle))

    def save(self) -> dict[str, np.ndarray]:
        """A copy of the state: arrays by name, one row a lane."""
        travel = {} if self._travel is None else {"low": self._travel.low.copy(), "high": self._travel.high.copy()}
        return {
            **travel,
            "forgotten": self._forgotten.copy(),
            "started": self._started.copy(),
            "parameters": self._table.copy(),
            "command_time": self._past.given.copy(),
            "command": self._past.value.copy(),
            "periods": self._past.periods.copy(),
            "drives": flat_lanes(self._drives, self.lanes),
            "cameras": flat_lanes(self._cameras, self.lanes),
            "bodies": self.bodies.save(),
        }

    def restore(self, state: Mapping[str, np.ndarray], rows: Int[np.ndarray, " row"] | None = None) -> None:
        """Set lanes to the rows of a state that `save` returned.

        Args:
            state: state of a session of the same robot, engine and mechanisms, with one row for each of ``rows``.
            rows: lanes; all by default.

        Raises:
            InputError: a state of something else.
        """
        chosen = np.arange(self.lanes) if rows is None else np.asarray(rows, dtype=np.intp)
        mine = self.save()
        for name, part in mine.items():
            if name not in state or state[name].shape != (len(chosen), *part.shape[1:]):
                raise InputError(f"the state's {name!r} does not fit this session", where="restore")
            if name != "bodies":
                part[chosen] = state[name]
        self.bodies.restore(chosen, state["bodies"])
        self._started, self._forgotten = mine["started"], mine["forgotten"]
        if self._travel is not None:
            self._travel = replace(self._travel, low=mine["low"], high=mine["high"])
        self._table, self._values = mine["parameters"], jnp.asarray(mine["parameters"])
        self._past = _Past(mine["command_time"], mine["command"], mine["periods"])
        self._drives, self._cameras = (
            lanes_like(self._drives, mine["drives"]),
            lanes_like(self._cameras, mine["cameras"]),
        )

    def _begin_travel(self, rows: np.ndarray, first: Float[np.ndarray, "row channel"]) -> None:
        """Limits of the drives of lanes that start from these commands."""
        self._forgotten[rows] = 0.0
        if self._travel is None:
            return
        for row, command in zip(rows, first, strict=True):
            travel = self.simulator.travel(self.recording, command)
            self._travel.low[row], self._travel.high[row] = travel.low, travel.high

    def _check_mechanisms(self, mechanisms: tuple[Mechanism, ...]) -> None:
        for mechanism in self._signalling:
            why = mechanism.whole_only if isinstance(mechanism, SignallingMechanism) else "it is not written by steps"
            carries = getattr(getattr(self.simulator, "engine", None), "carries_loads", False)
            if isinstance(mechanism, PushingMechanism) and not carries:
                why = "it acts on a rod without a cube only"
            if why:
                raise InputError(
                    f"{mechanism.name} does not step: {why}",
                    where="a session",
                    remedy=(
                        "train without it; laws at cables and on the body, and laws on measurements, support sessions"
                    ),
                )
        for mechanism in mechanisms:
            remembers = isinstance(mechanism, ActuationMechanism | TimedSensingMechanism)
            if remembers and not isinstance(mechanism, SteppedMechanism):
                raise InputError(
                    f"mechanism {mechanism.name!r} is written for whole rollouts only",
                    where="a session",
                    remedy="give it begin and advance, see docs/mechanisms.md",
                )

    def _take_values(self, rows: np.ndarray, parameters: Mapping[str, Float[np.ndarray, " row"] | float]) -> None:
        """Set the parameters of some lanes."""
        check_names(parameters, self._specs.values(), where="reset")
        given: dict[str, np.ndarray] = {}
        for name, spec in self._specs.items():
            value = np.asarray(parameters.get(name, spec.nominal), float)
            if value.shape not in ((), rows.shape):
                raise InputError(f"{name} has shape {value.shape} for {len(rows)} lanes", where="reset")
            for extreme in (np.min(value), np.max(value)):
                check_value(spec, float(extreme), where="reset")
            given[name] = np.broadcast_to(value, rows.shape)
        for mechanism in self.simulator.mechanisms:
            for name in getattr(mechanism, "shows_future", ()):
                if np.min(given[name]) < 0.0:
                    raise InputError(
                        f"{name} = {np.min(given[name]):g} {self._specs[name].unit} would show the future",
                        where="a session",
                        remedy=f"leave {name} out: it belongs to a recording, and a policy sees one clock",
                    )
        self._table[rows] = np.stack([given[name] for name in self._specs], axis=1)
        self._values = jnp.asarray(self._table)

    def _by_lane(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function of one lane's values by name, for all lanes' table of values."""

        def of_table(row: Float[Array, " parameter"], *others: Any) -> Any:
            return function(dict(zip(self._specs, row, strict=True)), *others)

        return jax.jit(jax.vmap(of_table))

    def _sent(self, commands: Float[np.ndarray, "lane channel"]) -> Float[np.ndarray, "lane step channel"]:
        """Commands carried out by the drives in every step of the period, ramps and dead time included.

        A change in less than a step takes the step that follows: recorded changes are half a step earlier, see
        `RobotSimulator.commands`, which a session cannot know ahead.
        """
        past, time_step, (ramp, dead_time) = self._past, self.simulator.time_step, self.simulator.command_timing
        if self._travel is not None:
            self._forgotten, commands = self._travel.advance(self._forgotten, past.value[:, -1], commands)
        past.given[:, :-1], past.value[:, :-1] = past.given[:, 1:].copy(), past.value[:, 1:].copy()
        past.given[:, -1], past.value[:, -1] = self.time, commands
        step = self.steps * past.periods[:, None] + np.arange(1, self.steps + 1)
        past.periods[:] += 1
        return carried_out(past.given[:, None], past.value[:, None], time_step * step - dead_time, ramp)

    @property
    def _drive_chains(self) -> tuple[list[Any], list[Any]]:
        """Mechanisms between command and cables, and the mechanisms visible to an encoder."""
        chain = [m for m in self.simulator.mechanisms if isinstance(m, ActuationMechanism)]
        return chain, [m for m in chain if inside_drive(m)]

    @property
    def _signalling(self) -> list[Any]:
        """Mechanisms that act on the body, or on the markers depending on commands."""
        kinds = PushingMechanism | CommandedSensingMechanism
        return [m for m in self.simulator.mechanisms if isinstance(m, kinds)]

    def _loads(self, signals: Float[Array, "row signal"]) -> BodySignals | None:
        """Loads on the body from the signals of the mechanisms of `_signalling`; None without loads."""
        acts = [(m.carried, w) for m, w in zip(self._signalling, signals.T, strict=True) if hasattr(m, "push")]
        loads = [carried(w) for carried, w in acts]
        return jax.tree.map(lambda *parts: sum(parts[1:], parts[0]), *loads) if loads else None

    @cached_property
    def _first_drives(self) -> Any:
        """Drives of all lanes before the first step, given the command before it, encoder positions, and signals."""
        chains, interval = self._drive_chains, self.simulator.time_step

        def through(chain: list[Any], values: Values, constant: Array) -> tuple[tuple, Array]:
            memories = []
            for mechanism in chain:
                memories.append(mechanism.begin(values, constant, interval))
                constant = settled(mechanism, values, constant)
            return tuple(memories), constant

        def first(values: Values, command: Float[Array, " channel"]) -> tuple[_Drives, Array, Array]:
            cables, reached = through(chains[0], values, command)
            encoders, angle = through(chains[1], values, command)
            begun = [mechanism.signal_before(values, reached) for mechanism in self._signalling]
            memories = tuple(memory for memory, _ in begun)
            return (
                _Drives(cables, encoders, self.simulator.unwound(values, reached), memories),
                angle,
                jnp.array([w for _, w in begun], float),
            )

        return self._by_lane(first)

    @cached_property
    def _move_drives(self) -> Any:
        """Drives of all lanes after a period, cable displacements [m] in its steps, encoder positions, the last
        signals, and loads on the body in the steps.
        """
        chains, time_step = self._drive_chains, self.simulator.time_step

        def through(chain: list[Any], values: Values, memory: tuple[Any, ...], sent: Array) -> tuple[tuple, Array]:
            after = []
            for mechanism, kept in zip(chain, memory, strict=True):
                kept, sent = mechanism.advance(values, kept, sent, time_step)
                after.append(kept)
            return tuple(after), sent

        def move(values: Values, drives: _Drives, commands: Float[Array, "step channel"]) -> tuple[Any, ...]:
            def one(before: _Drives, command: Float[Array, " channel"]) -> tuple[_Drives, tuple[Array, ...]]:
                cables, reached = through(chains[0], values, before.cables, command)
                encoders, angle = through(chains[1], values, before.encoders, command)
                wound, displacement = self.simulator.wind(values, before.wound, reached)
                pairs = zip(self._signalling, before.signals, strict=True)
                given = [m.signal_after(values, memory, reached, time_step) for m, memory in pairs]
                signals = jnp.array([w for _, w in given], float)
                return _Drives(cables, encoders, wound, tuple(m for m, _ in given)), (displacement, angle, signals)

            after, (displacement, angle, signals) = jax.lax.scan(one, drives, commands)
            return after, displacement, angle[-1], signals[-1], self._loads(signals)

        return self._by_lane(move)

    @cached_property
    def _bodies_of(self) -> Any:
        """Start of the bodies of all lanes."""

        def of(values: Values, wound: Wound, signals: Float[Array, " signal"]) -> LaneStart:
            return self.simulator.lane_start(values, wound)._replace(loads=self._loads(signals[None]))

        return self._by_lane(of)

    @cached_property
    def _look(self) -> Any:
        """States of the cameras after an observation, and the observed marker positions [m] under the last signals; the
        observation is the first if the earlier states are None.
        """
        cameras = SensingMechanism | TimedSensingMechanism | CommandedSensingMechanism
        chain: list[Any] = [m for m in self.simulator.mechanisms if isinstance(m, cameras)]

        def look(
            values: Values,
            before: tuple[Any, ...] | None,
            position: Float[Array, "marker 3"],
            now: Float[Array, ""],
            signals: Float[Array, " signal"],
        ) -> tuple[tuple[Any, ...], Float[Array, "marker 3"]]:
            after = []
            for k, mechanism in enumerate(chain):
                memory: Any = ()
                if mechanism in self._signalling:
                    w = signals[self._signalling.index(mechanism)]
                    position = mechanism.carried(w[None], position[None], jnp.asarray(now)[None])[0]
                elif isinstance(mechanism, SteppedMechanism):
                    memory = mechanism.begin(values, position, self.period) if before is None else before[k]
                    memory, position = mechanism.advance(values, memory, position, now)
                else:
                    position = mechanism.sense(values, position[None])[0]
                after.append(memory)
            return tuple(after), self.simulator.in_measuring_frame(values, position)

        return self._by_lane(look)

    def _observation(self, motion: Motion, position: np.ndarray, angle: np.ndarray) -> Observation:
        status = status_of(motion, self.simulator.unsolved, np)
        pose = motion.pose
        if pose is not None:
            pose = np.concatenate(
                [pose[:, :3], pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)], axis=1
            )
        return Observation(position, motion.tension, pose, status, angle, motion.peak)


@jax.jit
def _chosen(rows: Bool[Array, " lane"], new: Any, old: Any) -> Any:
    """Some lanes from one tree of arrays, the other lanes from another tree."""
    return jax.tree.map(lambda n, o: jnp.where(rows.reshape(-1, *(1,) * (n.ndim - 1)), n, o), new, old)
