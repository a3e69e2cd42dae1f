"""Any program that turns parameters and commands into marker positions, in the place of a robot's simulator."""

from __future__ import annotations

import hashlib
import inspect
import json
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots.parameter import Parameter
from rfdropo_bayes.simulators.body_lanes import BodyLanes, LaneStart
from rfdropo_bayes.simulators.callbacks import one_callback
from rfdropo_bayes.simulators.commands import Commands, commands_on_grid, observed_at, sample
from rfdropo_bayes.simulators.control_session import Session
from rfdropo_bayes.simulators.extended import ExtendedSimulator, Wound
from rfdropo_bayes.simulators.mechanisms import BLACK_BOX, Mechanism, Values, check_mechanisms, code_of, obstacle
from rfdropo_bayes.simulators.parameters import ParameterSpec, specs_of
from rfdropo_bayes.simulators.protocol import Observation, Result
from rfdropo_bayes.tables import nearest, parse_table

COMMAND_UNITS = ("m", "rad", "N", "N m", "Pa", "-")
APART = 0.005  # [m] between neighbours of markers whose undeformed positions are unknown
PROBED_ROWS = 3
ACTION = 0.05
"""Default change of a command by one action of a policy, as a share of the range of commands. Twenty actions cross the
range; eight do for a cable of the paper's trunk.
"""

Batch = Mapping[str, Float[np.ndarray, " n"]]


@dataclass(frozen=True)
class BlackBox:
    """A user's simulator; mechanisms of actuation and sensing act around it.

    ``function(parameters, command)`` gets a dictionary of numbers and an array (row, channel). Row 0 of the command is
    in force before the first step; row k is reached at the end of step k. It returns the marker positions [m] of the
    same rows, (row, marker, 3); or a dictionary with ``position`` and, if ``cables`` are named, ``tension`` [N], (row,
    cable). With ``batched`` it gets arrays (n,) and (n, row, channel) and returns (n, row, marker, 3). A list of words
    in place of the function is a command line; `ProcessSimulation` has its protocol.

    A rollout that raises, or returns a number that is not finite, counts as diverged. The same arguments must give the
    same answer.

    Args:
        function: function that simulates.
        parameters: parameters by name, each a `Parameter` or its fields. ``low`` and ``high`` must be there; ``unit``
            is "-",
            ``nominal`` the middle and ``prior`` uniform between the bounds by default.
        markers, channels, cables: names of the markers, of the command channels, and of the cables with a tension.
        time_step: time between rows of the command [s].
        command_unit: "m" of cable, "rad" of a motor, "N", "N m", "Pa", or "-" for a unit of its own.
        name: name of the simulator in reports.
        batched: whether the function takes many parameter sets at once.
        lanes: number of parameter sets per call.
        one_shape: whether a batched function always gets arrays of the same shape: ``lanes`` sets, padded by repeats,
            and whole commands. JAX then compiles it once for recordings of equal length.
        usual_command: size of usual commands, in their unit; by default a usual trunk's.
        limits: least and greatest command of each channel for policies; none by default.
        families: parameters that are not inferred unless they have a prior, each with the quantity of which it is a
            local value; an audit tests whether they differ from their nominal values.

    Raises:
        InputError: an invalid description of a parameter, no marker or channel, or a time step that is not positive.
    """

    function: Callable[..., Any] | Sequence[str]
    parameters: Mapping[str, Any]
    markers: Sequence[str]
    channels: Sequence[str]
    time_step: float
    command_unit: str = "m"
    cables: Sequence[str] = ()
    name: str = "black box"
    batched: bool = False
    lanes: int = 64
    one_shape: bool = False
    usual_command: float | None = None
    families: Mapping[str, str] = field(default_factory=dict)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.markers or not self.channels or not self.time_step > 0.0:
            raise InputError("needs a marker, a channel and a positive time step", where=self.name)
        if self.one_shape and not self.batched:
            remedy = "give batched=True, and a function of many parameter sets"
            raise InputError("one_shape needs batched = true", where=self.name, remedy=remedy)
        if self.command_unit not in COMMAND_UNITS:
            remedy = nearest(self.command_unit, COMMAND_UNITS)
            raise InputError(f"unknown command_unit {self.command_unit!r}", where=self.name, remedy=remedy)
        for name, ends in self.limits.items():
            if name not in self.channels:
                raise InputError(f"limits of {name!r}", where=self.name, remedy=nearest(name, self.channels))
            if len(ends) != 2 or not -np.inf < ends[0] < ends[1] < np.inf:
                remedy = "give two finite numbers, the lower first"
                raise InputError(f"limits {ends!r} of {name!r}", where=self.name, remedy=remedy)
        tables = {name: _parameter(name, table) for name, table in self.parameters.items()}
        object.__setattr__(self, "parameters", tables)

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Markers, as mechanisms ask a robot for them."""
        return tuple(self.markers)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Command channels, as mechanisms ask a robot for them."""
        return tuple(self.channels)

    @property
    def cable_names(self) -> tuple[str, ...]:
        """Cables whose tension is returned."""
        return tuple(self.cables)

    @property
    def gravity(self) -> Float[np.ndarray, "3"]:
        """Along z, for mechanisms of the body, which ask any robot for it; none of them acts on a black box."""
        return np.array([0.0, 0.0, -9.81])

    @property
    def push(self) -> None:
        """No cube stands before the robot."""

    @property
    def body(self) -> None:
        """Unknown."""

    def command_of(self, pull: float) -> Float[np.ndarray, " channel"]:
        """The pull [m] itself if commands are lengths, else `ACTION` of each range.

        Raises:
            InputError: a channel without limits.
        """
        low, high = self.command_limits()
        return np.full(len(low), pull) if self.command_unit == "m" else ACTION * (high - low)

    def markers_near(self, heights: Sequence[float]) -> tuple[int, ...]:
        """All markers, since the undeformed body is unknown."""
        return tuple(range(len(self.markers)))

    def command_limits(self) -> tuple[Float[np.ndarray, " channel"], Float[np.ndarray, " channel"]]:
        """Least and greatest command of each channel, in their unit.

        Raises:
            InputError: a channel without limits.
        """
        for name in self.channels:
            if name not in self.limits:
                remedy = "give BlackBox limits, or the model's actuators a ctrlrange"
                raise InputError(f"nothing limits the command {name!r}", where=self.name, remedy=remedy)
        low, high = zip(*(self.limits[name] for name in self.channels), strict=True)
        return np.array(low, float), np.array(high, float)

    @property
    def specs(self) -> tuple[ParameterSpec, ...]:
        """Its parameters."""
        return tuple(spec._replace(family=self.families.get(spec.name, "")) for spec in specs_of(self.parameters))

    @cached_property
    def simulate(self) -> Callable[[Batch, np.ndarray], list[Any]]:
        """Simulate a batch: the function's result for each parameter set; None if it raised."""
        own = self.function
        function: Any = own if callable(own) else ProcessSimulation(tuple(own), self.time_step)

        def single(values: Mapping[str, float], command: np.ndarray) -> Any:
            try:
                return function(values, command)
            except Exception:  # whatever a user's program raises for parameters that it cannot handle
                return None

        def one_by_one(values: Batch, commands: np.ndarray) -> list[Any]:
            sets = [{name: float(column[k]) for name, column in values.items()} for k in range(len(commands))]
            return [single(given, command) for given, command in zip(sets, commands, strict=True)]

        def together(values: Batch, commands: np.ndarray) -> list[Any]:
            count = len(commands)
            size = self.lanes if self.one_shape else count
            blocks = [np.arange(first, min(first + size, count)) for first in range(0, count, size)]
            return [answer for rows in blocks for answer in attempted(values, commands, rows)]

        def attempted(values: Batch, commands: np.ndarray, rows: np.ndarray) -> list[Any]:
            try:
                return self.answers(values, commands, rows)
            except Exception:
                alone = [rows[k : k + 1] for k in range(len(rows))]
                return [None] if len(rows) == 1 else [a for row in alone for a in attempted(values, commands, row)]

        return together if self.batched else one_by_one

    def answers(
        self, values: Batch, commands: Float[np.ndarray, "n row channel"], rows: Int[np.ndarray, " few"]
    ) -> list[dict[str, np.ndarray]]:
        """Results of a batched function for some rows of a batch, at most `lanes` with `one_shape`."""
        taken = np.resize(rows, self.lanes) if self.one_shape else rows
        function: Any = self.function
        result = function({name: column[taken] for name, column in values.items()}, commands[taken])
        parts = result if isinstance(result, Mapping) else {"position": result}
        arrays = {name: np.asarray(part) for name, part in parts.items()}
        return [{name: part[k] for name, part in arrays.items()} for k in range(len(rows))]

    @property
    def engine(self) -> str:
        """Name of the engine: the function's attribute ``engine`` if it has one."""
        return getattr(self.function, "engine", "function") if callable(self.function) else "process"

    @property
    def digest(self) -> str:
        """Digest of the readable source, of the parameters, and of the function's attribute ``digest``."""
        try:
            source = getattr(self.function, "digest", None)
            source = (
                source or inspect.getsource(self.function) if callable(self.function) else repr(tuple(self.function))
            )
        except (OSError, TypeError):
            source = repr(getattr(self.function, "__qualname__", type(self.function).__qualname__))
        return hashlib.sha256(repr((source, self.specs, self.time_step)).encode()).hexdigest()


def _parameter(name: str, table: Parameter | Mapping[str, Any]) -> Parameter:
    if isinstance(table, Parameter):
        return table
    fields = {"unit": "-", "description": name.replace("_", " "), **table}
    where = f"parameter {name!r} of a black box"
    for key in ("low", "high"):
        if key not in fields:
            raise InputError(f"the key {key!r} is missing", where=where, remedy="give both hard bounds")
    fields.setdefault("nominal", 0.5 * (fields["low"] + fields["high"]))
    fields.setdefault("prior", {"distribution": "Uniform", "low": fields["low"], "high": fields["high"]})
    return parse_table(Parameter, fields, where=where)


class Moved(NamedTuple):
    """Result of a rollout, one row per row of the command."""

    position: Float[Any, "row marker 3"]
    tension: Float[Any, "row cable"]
    failed: Bool[Any, ""]


@dataclass(frozen=True)
class BlackBoxSimulator(ExtendedSimulator):
    """A `BlackBox` behind the `Simulator` protocol.

    Attributes:
        box: the simulator.
        mechanisms: extensions of actuation and sensing, applied in the given order within each stage.

    Raises:
        InputError: a mechanism that acts on a body.
    """

    box: BlackBox
    mechanisms: Sequence[Mechanism] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mechanisms", check_mechanisms(self.mechanisms))
        for mechanism in self.mechanisms:
            why = obstacle(mechanism, BLACK_BOX, BLACK_BOX)
            if why is not None:
                raise InputError(f"{mechanism.name} does not run here: {why}", where=self.box.name)

    @property
    def robot(self) -> BlackBox:
        """The box, in the robot's place."""
        return self.box

    @property
    def time_step(self) -> float:  # type: ignore[override]
        return self.box.time_step

    @property
    def lanes(self) -> int:
        """Number of parameter sets in a call of the function."""
        return self.box.lanes

    @property
    def command_unit(self) -> str:
        return self.box.command_unit

    @cached_property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """Parameters of the box, then of the mechanisms."""
        return self.box.specs + tuple(spec for mechanism in self.mechanisms for spec in mechanism.parameters)

    @property
    def description(self) -> dict[str, object]:
        """Engine, time step and mechanisms, with a digest of the source."""
        return {
            "engine": self.box.engine,
            "precision": "float64",
            "robot": self.box.name,
            "time_step_s": self.time_step,
            "mechanisms": [mechanism.name for mechanism in self.mechanisms],
            "content_sha256": hashlib.sha256(self.box.digest.encode() + code_of(self.mechanisms)).hexdigest(),
        }

    def marker_points(self) -> Float[np.ndarray, "marker 3"]:
        """Places in sequence along z: the marker positions of an undeformed black box are unknown."""
        return np.arange(1.0, len(self.marker_names) + 1.0)[:, None] * np.array([0.0, 0.0, APART])

    def commands(
        self,
        time: Float[np.ndarray, " command"],
        value: Float[np.ndarray, "command channel"],
        initial: Float[np.ndarray, " channel"],
        observation_time: Float[np.ndarray, " time"],
    ) -> Commands:
        """Recorded commands on the box's clock.

        Raises:
            InputError: the function fails on the first rows of them, at the nominal parameters.
        """
        commands = commands_on_grid(time, value, initial, observation_time, time_step=self.time_step)
        rows = None if self.box.one_shape else PROBED_ROWS
        self._probe(np.concatenate([np.asarray(commands.initial)[None], commands.step])[:rows])
        return commands

    def _probe(self, command: Float[np.ndarray, "row channel"]) -> None:
        """Raise InputError if the function violates the contract of a box."""
        values = {spec.name: spec.nominal for spec in self.box.specs}
        remedy = "return positions (row, marker, 3) [m]; see BlackBox"
        try:
            columns = {name: np.array([value]) for name, value in values.items()}
            if not callable(self.box.function):
                result = self.box.simulate(columns, command[None])[0]
            elif self.box.batched:
                # On the device of callbacks, which also runs the programs compiled now.
                with jax.default_device(jax.local_devices(backend="cpu")[0]):
                    result = self.box.answers(columns, command[None], np.zeros(1, int))[0]
            else:
                result = self.box.function(values, command)
        except Exception as error:
            raise InputError(f"raises {type(error).__name__}: {error}", where=self.box.name, remedy=remedy) from error
        if result is None:
            raise InputError("fails at its nominal parameters", where=self.box.name, remedy=remedy)
        position, tension = self._parts(result)
        wanted = (len(command), len(self.marker_names), 3), (len(command), len(self.cable_names))
        if (position.shape, tension.shape) != wanted:
            shapes = f"positions {position.shape}" + (f", tensions {tension.shape}" if self.cable_names else "")
            raise InputError(f"returned {shapes}, and not {wanted}", where=self.box.name, remedy=remedy)

    def _parts(self, result: Any) -> tuple[np.ndarray, np.ndarray]:
        parts = result if isinstance(result, Mapping) else {"position": result}
        position = np.asarray(parts["position"], dtype=float)
        none = np.zeros((len(position), 0)) if not self.cable_names else np.zeros((0, 0))
        return position, np.asarray(parts.get("tension", none), dtype=float)

    def rollout(self, parameters: Values, commands: Commands, steps: Int[Array, ""] | None = None) -> Observation:
        """Simulate from the initial state to the last observation, or ``steps`` time steps.

        Raises:
            InputError: a name that is not a parameter of this simulator.
        """
        values = self.complete(parameters)
        steps = self.steps_seen(values, commands, self.time_step, steps)
        own = {spec.name: jnp.asarray(values[spec.name], jnp.float64) for spec in self.box.specs}
        initial, reached = self.actuated(values, commands, self.time_step)
        command = jnp.concatenate([initial[None], reached]).astype(jnp.float64)
        limit = jnp.asarray(len(command) - 1 if steps is None else steps, jnp.float64)
        moved = self._call((own, command), limit)
        true, at = sample(moved.position, commands), observed_at(commands, self.time_step)
        position = self.measured(values, true, at, self.meanwhile(values, commands))
        status = jnp.where(moved.failed, int(Result.DIVERGED), int(Result.OK))
        angle = self.driven(values, commands, self.time_step)
        return Observation(position, sample(moved.tension, commands), None, status, angle)

    def lane_start(self, values: Values, drives: Wound) -> LaneStart:
        return LaneStart({spec.name: values[spec.name] for spec in self.box.specs}, drives.level, None)

    def begin_lanes(self, count: int) -> BodyLanes:
        """See `ExtendedSimulator.begin_lanes`; the function's own method of this name makes them.

        Raises:
            InputError: the function has no `begin_lanes`.
        """
        begin = getattr(self.box.function, "begin_lanes", None)
        if begin is None:
            remedy = "give the function a method begin_lanes, see docs/your_simulator.md"
            raise InputError(
                "the simulator has no begin_lanes: only whole rollouts are possible", where=self.box.name, remedy=remedy
            )
        return begin(count)

    def session(self, lanes: int, period: float) -> Session:
        """A session of ``lanes`` lanes, commanded once per control ``period`` [s]; see `Session`."""
        return Session(self, lanes, period)

    def _call(self, inputs: tuple[dict[str, Array], Array], limit: Array) -> Moved:
        rows = inputs[1].shape[0]
        shapes = Moved(
            jax.ShapeDtypeStruct((rows, len(self.marker_names), 3), jnp.float64),
            jax.ShapeDtypeStruct((rows, len(self.cable_names)), jnp.float64),
            jax.ShapeDtypeStruct((), jnp.bool_),
        )
        return one_callback(self._rolled, shapes, inputs, limit)

    def _rolled(self, inputs: tuple[Batch, Float[np.ndarray, "n row channel"]], steps: int) -> Moved:
        """Rollouts of a batch; zero for failed rollouts."""
        values, command = inputs[0], inputs[1] if self.box.one_shape else inputs[1][:, : steps + 1]
        count, rows = command.shape[:2]
        position = np.zeros((count, rows, len(self.marker_names), 3))
        tension, failed = np.zeros((count, rows, len(self.cable_names))), np.zeros(count, dtype=bool)
        for k, result in enumerate(self.box.simulate(values, command)):
            own, pull = self._parts(result) if result is not None else (np.full(1, np.nan), np.zeros(0))
            failed[k] = not (own.shape == position[k].shape and np.isfinite(own).all() and np.isfinite(pull).all())
            if not failed[k]:
                position[k], tension[k] = own, pull
        return Moved(position, tension, failed)


class ProcessSimulation:
    """A process that is started once and simulates a line at a time.

    It reads ``{"parameters": {name: number}, "command": [[...], ...], "time_step": s}`` and answers with ``{"position":
    [[[x, y, z], ...], ...]}``, in metres and one entry per row of the command, perhaps with ``"tension": [[...],
    ...]``. The answer ``{"error": "..."}`` means that these parameters cannot be simulated. The process's stderr stays
    visible.

    Args:
        words: command line.
        time_step: time between rows of the command [s].
    """

    def __init__(self, words: Sequence[str], time_step: float) -> None:
        self.words, self.time_step = tuple(words), time_step
        self._process: subprocess.Popen[str] | None = None

    def __call__(self, parameters: Mapping[str, float], command: Float[np.ndarray, "row channel"]) -> dict[str, Any]:
        """Simulate one parameter set.

        Raises:
            ArithmeticError: the process answers with an error.
            ConnectionError: the process has ended, or does not answer in JSON.
        """
        process = self._running()
        request = {"parameters": dict(parameters), "command": command.tolist(), "time_step": self.time_step}
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(request) + "\n")
            process.stdin.flush()
            answer = json.loads(process.stdout.readline())
        except (OSError, ValueError) as error:
            self.close()
            raise ConnectionError(f"{self.words[0]} does not answer in JSON ({error})") from None
        if "error" in answer:
            raise ArithmeticError(answer["error"])
        return {name: np.asarray(answer[name], dtype=float) for name in ("position", "tension") if name in answer}

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(self.words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        return self._process

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def __del__(self) -> None:
        self.close()
