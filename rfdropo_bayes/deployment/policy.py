"""Sources of commands: a policy as an ONNX file with its layout, or the commands of an earlier session.

The metadata of the ONNX file hold the layout that training and motors share (`robots.policy_layout`): inputs, outputs,
their order and units, and the rate. Normalisation, clipping and scaling are baked into the graph. A policy is refused
unless its layout fits the robot and the session to the letter.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.deployment.causes import Cause, Stop
from rfdropo_bayes.deployment.sensors import POSE
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Motor, Robot
from rfdropo_bayes.robots.policy_layout import (
    EVALUATED_EPISODES,
    PEAK_TENSION,
    STOPPED_EPISODES,
    TENSION_LIMIT,
    PolicyLayout,
)

METADATA = "rfdropo_layout"  # key of the layout in the metadata of the ONNX file


class PolicyScene(NamedTuple):
    """Inputs that a policy may see."""

    position: Float[np.ndarray, "marker 3"]  # newest known position of each marker [m]
    moved: Float[np.ndarray, "marker 3"]  # displacement of each marker since the last act [m]
    command: Float[np.ndarray, " channel"]  # present command [command unit]
    length: Float[np.ndarray, " channel"]  # measured cable length on each drum [m]
    tension: Float[np.ndarray, " channel"]  # tension of each cable [N]
    object_pose: Float[np.ndarray, "7"]  # newest known centre [m] and unit quaternion x, y, z, w of the pushed object


class Pull(NamedTuple):
    """Tensions in the evaluation for which a policy was selected."""

    peak: float  # largest tension of a cable, including the overshoot over the limit [N]; NaN if not recorded
    limit: float  # tension at which an episode is stopped [N]; infinite without a limit
    stopped: int  # number of stopped episodes
    episodes: int  # number of episodes

    @classmethod
    def told(cls, facts: Mapping[str, str]) -> Pull:
        """The tension limits in the metadata of a policy."""
        peak, limit = float(facts.get(PEAK_TENSION, "nan")), float(facts.get(TENSION_LIMIT, "inf"))
        return cls(peak, limit, int(facts.get(STOPPED_EPISODES, "0")), int(facts.get(EVALUATED_EPISODES, "0")))


class Act(NamedTuple):
    """Raw output of a policy and the requested command, both before the motors' limits."""

    raw: Float[np.ndarray, " channel"]
    command: Float[np.ndarray, " channel"]


class CommandSource(Protocol):
    """A source of commands."""

    rate_hz: float
    start: Float[np.ndarray, " channel"]
    sees_markers: bool
    """Whether lost markers make its commands worthless."""
    sees_object: bool
    """Whether a lost object does."""

    def act(self, scene: PolicyScene) -> Act | None:
        """The next command [command unit]; None after the last command.

        Raises:
            Stop: if no command can be followed.
        """
        ...

    def rehearse(self) -> None:
        """Do the work of an act, to no effect, shortly before it: then code and weights are in the caches.

        Others use the processor between two acts. A policy of 128 x 128 takes 0.35 ms from memory, 0.06 ms from caches.
        """


class OnnxPolicy:
    """A policy from an ONNX file, as `rfdropo train` exports it.

    Args:
        path: path of the file.
        robot: robot to drive.
        goal: position of the goal [m].
        sha256: hash that the file must have; None accepts any.
        markers: names of observed markers; all markers of the robot by default.

    Attributes:
        pull: tensions of the policy in its best evaluation.

    Raises:
        InputError: if the file cannot be read, or its layout, hash or shapes do not fit.
    """

    def __init__(
        self,
        path: Path,
        robot: Robot,
        goal: Mapping[str, float],
        sha256: str | None = None,
        markers: Sequence[str] | None = None,
    ) -> None:
        where = f"policy {path}"
        content = read_file(path)
        self.sha256 = hashlib.sha256(content).hexdigest()
        if sha256 is not None and sha256 != self.sha256:
            raise InputError(
                f"its hash is {self.sha256}", where=where, remedy="this is another policy than [policy] sha256 names"
            )
        self._session, self.layout = _open(content, where)
        self._markers = _markers_seen(robot, markers)
        self._goal = np.array([goal.get(axis, np.nan) for axis in "xyz"])
        _check_layout(self.layout, robot, 3 * len(self._markers), where)
        self.pull = Pull.told(self._session.get_modelmeta().custom_metadata_map)
        names = [part.name for part in self.layout.observation]
        if "goal" in names and not np.all(np.isfinite(self._goal)):
            raise InputError("the policy needs a goal", where="[goal]", remedy="give x, y and z in metres")
        self.rate_hz = 1.0 / self.layout.period_s
        self.sees_markers = bool({"markers", "moved"} & set(names))
        self.sees_object = "object" in names
        self.start = np.zeros(len(robot.channel_names))
        moves = np.array(self.layout.moves)
        self._reach = np.abs(moves).max(axis=0)
        self._low, self._high = np.array(self.layout.low), np.array(self.layout.high)
        self._input = self._session.get_inputs()[0]
        self._check_shapes(where)
        self._network = _bound(self._session, self.layout.size, len(self._reach))
        nowhere, still = np.zeros((len(robot.marker_names), 3)), np.zeros(len(robot.channel_names))
        self._last = PolicyScene(nowhere, nowhere, still, still, still, np.zeros(POSE))

    def rehearse(self) -> None:
        """Use the last scene again; see `CommandSource.rehearse`."""
        self._answer(self._last)

    def act(self, scene: PolicyScene) -> Act:
        """Run the network. Its output is the change of the command, clipped to the layout's limits.

        Raises:
            Stop: the output of the policy is not finite, or exceeds the largest action.
        """
        self._last = scene
        observation, raw = self._answer(scene)
        if not np.all(np.isfinite(observation)):
            raise Stop(Cause.MARKERS_LOST, "the observation is not finite")
        if not np.all(np.isfinite(raw)):
            raise Stop(Cause.ACTION_NOT_FINITE, f"the policy's output is {raw.tolist()}")
        if np.any(np.abs(raw) > self._reach * (1.0 + 1e-4)):  # single precision
            raise Stop(Cause.ACTION_OUTSIDE, f"the policy's output {raw.tolist()} is outside the range of its layout")
        return Act(raw, np.clip(scene.command + raw, self._low, self._high))

    def _observe(self, scene: PolicyScene) -> Float[np.ndarray, " feature"]:
        parts = {
            "markers": scene.position[self._markers].ravel(),
            "moved": scene.moved[self._markers].ravel(),
            "goal": self._goal,
            "object": scene.object_pose,
            "commands": scene.command,
            "lengths": scene.length,
            "tensions": scene.tension,
        }
        return self.layout.assemble(parts)

    def _run(self, observation: Float[np.ndarray, " feature"]) -> Float[np.ndarray, " channel"]:
        return self._network(observation)

    def _answer(self, scene: PolicyScene) -> tuple[Float[np.ndarray, " feature"], Float[np.ndarray, " channel"]]:
        """Observation, and the network's output for it."""
        observation = self._observe(scene)
        try:
            return observation, self._run(observation)
        except Exception as error:  # onnxruntime raises many types, none of them documented
            raise Stop(Cause.POLICY_FAILED, f"{type(error).__name__}: {error}") from None

    def _check_shapes(self, where: str) -> None:
        wanted, kind = self.layout.size, self._input.type
        width = self._input.shape[-1] if self._input.shape else None
        outputs = {output.name for output in self._session.get_outputs()}
        if kind != "tensor(float)" or (isinstance(width, int) and width != wanted) or "action" not in outputs:
            raise InputError(
                f"takes {kind} of width {width}, its layout {wanted} numbers; it gives {', '.join(sorted(outputs))}",
                where=where,
                remedy="export it again with its layout",
            )
        given = self._session.run(["action"], {self._input.name: np.zeros((1, wanted), np.float32)})[0]
        if np.size(given) != len(self._reach):
            raise InputError(f"gives {np.size(given)} values for {len(self._reach)} channels", where=where)


def pulls_too_hard(pull: Pull, motors: Sequence[Motor]) -> str | None:
    """A warning if a policy's tensions in its evaluation exceed a motor's limit; None otherwise."""
    weakest = min(motors, key=lambda motor: motor.tension_limit_n[1])
    limit = weakest.tension_limit_n[1]
    if not pull.peak > limit:
        return None
    words = f"in simulation the policy pulled up to {pull.peak:.3g} N, and {weakest.channel} stops at {limit:g} N"
    if pull.limit <= limit:
        counts = f"{pull.stopped} of {pull.episodes} evaluation episodes"
        return f"{words}: {counts} were stopped by the training's limit of {pull.limit:g} N: train longer"
    return f"{words}: train with [training] tension_limit = {limit:g}"


def _bound(session: Any, size: int, channels: int) -> Callable[[np.ndarray], Float[np.ndarray, " channel"]]:
    """A network with fixed input and output buffers, as a function from observation to output."""
    import onnxruntime

    seen, given = np.zeros((1, size), np.float32), np.zeros((1, channels), np.float32)
    binding = session.io_binding()
    kept = onnxruntime.OrtValue.ortvalue_from_numpy(seen), onnxruntime.OrtValue.ortvalue_from_numpy(given)
    binding.bind_ortvalue_input(session.get_inputs()[0].name, kept[0])
    binding.bind_ortvalue_output("action", kept[1])

    def run(observation: np.ndarray) -> np.ndarray:
        seen[0] = observation
        session.run_with_iobinding(binding)
        return given[0].astype(float)

    return run


def _markers_seen(robot: Robot, names: Sequence[str] | None) -> list[int]:
    known = list(robot.marker_names)
    unknown = [name for name in names or () if name not in known]
    if unknown:
        raise InputError(f"no marker {unknown[0]!r}", where="policy.markers", remedy=f"known: {', '.join(known)}")
    return list(range(len(known))) if names is None else [known.index(name) for name in names]


def _check_layout(layout: PolicyLayout, robot: Robot, seen: int, where: str) -> None:
    """Channels, unit, and the size of every part of the observation.

    Raises:
        InputError: the policy does not fit this robot.
    """
    remedy = "give a policy for this robot"
    if layout.channels != robot.channel_names:
        raise InputError(
            f"drives {', '.join(layout.channels)}; the robot has {', '.join(robot.channel_names)}",
            where=where,
            remedy=remedy,
        )
    if layout.unit != robot.command_unit:
        raise InputError(
            f"acts in {layout.unit}, the robot's commands are in {robot.command_unit}", where=where, remedy=remedy
        )
    channels = len(robot.channel_names)
    sizes = {"markers": seen, "moved": seen, "goal": 3, "object": POSE}
    sizes |= {"commands": channels, "lengths": channels, "tensions": channels}
    for part in layout.observation:
        if part.name not in sizes:
            known = ", ".join(sizes)
            raise InputError(f"needs {part.name!r}, which no sensor measures", where=where, remedy=f"known: {known}")
        if part.size != sizes[part.name]:
            raise InputError(
                f"needs {part.size} numbers of {part.name!r}; there are {sizes[part.name]}",
                where=where,
                remedy="name the markers that it sees: [policy] markers"
                if part.name in ("markers", "moved")
                else remedy,
            )


def read_file(path: Path) -> bytes:
    """Content of a policy file.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror})", where=f"policy {path}", remedy="correct the path"
        ) from None


def _open(content: bytes, where: str) -> tuple[Any, PolicyLayout]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # a pool of threads costs more than the network
    options.log_severity_level = 3
    options.enable_cpu_mem_arena = options.enable_mem_pattern = False  # buffers of a small network are soon found
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise InputError(
            f"is not an ONNX model ({type(error).__name__})", where=where, remedy="export it again"
        ) from None
    text = session.get_modelmeta().custom_metadata_map.get(METADATA)
    if text is None:
        raise InputError("has no layout in its metadata", where=where, remedy="export it with `rfdropo train`")
    return session, PolicyLayout.from_json(text, where=where)


EVEN = 0.01
"""Share of a period by which half of a recording's commands may come beside it. The commands of the physical trunk are
1e-5 of theirs off; commands at 30 Hz are 0.1 of the nearest period of a loop at 100 Hz off."""


_INSTANT = 1e-6  # periods: a command that comes half a period late belongs to the next, whatever is rounded


def replay_rate(recording: Trajectory, rate_hz: float) -> float:
    """Rate at which commands are sent again [Hz].

    The rate is a divisor of the loop's ``rate_hz``: the divisor nearest to the rate of the commands if they are evenly
    spaced, otherwise ``rate_hz``.
    """
    gaps = np.diff(recording.command_time)
    nearest = rate_hz / max(1, round(rate_hz * (float(np.median(gaps)) if gaps.size else 0.1)))
    return nearest if _evenly(gaps * nearest) else rate_hz


def _evenly(periods: Float[np.ndarray, " gap"]) -> bool:
    """Whether most times between commands are whole periods."""
    whole = np.maximum(1.0, np.round(periods))
    return periods.size == 0 or float(np.median(np.abs(periods - whole))) <= EVEN


class RecordedCommands:
    """The commands of a recording, sent again, including the commands before its first row.

    Evenly spaced commands each stay in force for whole periods: a missed cycle of the recorded session
    must not repeat or drop a command. Others are sent in the period that is nearest to their own time, and the last
    command wins if several fall into one period.

    Args:
        recording: recording of an earlier session, or any trajectory of this robot.
        robot: robot to drive.
        rate_hz: rate of the periods; see `replay_rate`.

    Raises:
        InputError: if channels or unit do not fit.
    """

    sees_markers = sees_object = False

    def __init__(self, recording: Trajectory, robot: Robot, rate_hz: float) -> None:
        if recording.cable_names != robot.channel_names or recording.command_unit != robot.command_unit:
            raise InputError(
                f"drives {', '.join(recording.cable_names)} in {recording.command_unit}; the robot has "
                f"{', '.join(robot.channel_names)} in {robot.command_unit}",
                where=recording.name,
                remedy="replay it on the robot it was recorded on",
            )
        self.rate_hz, self.start = rate_hz, np.array(recording.initial_command)
        times = np.append(recording.command_time, max(recording.time[-1], recording.command_time[-1] + 1.0 / rate_hz))
        periods = (times - min(0.0, times[0])) * rate_hz  # since the recording or its first command began
        apart, place = np.diff(periods), np.floor(periods + 0.5 + _INSTANT)
        cycles = np.maximum(1, np.round(apart)) if _evenly(apart[:-1]) else np.diff(place)
        commands = np.concatenate([recording.initial_command[None], recording.command])
        self._commands = np.repeat(commands, np.append(place[0], cycles).astype(int), axis=0)
        self.last_s = float(len(self._commands) - cycles[-1]) / rate_hz
        """After how long the last command is sent [s]."""
        self._next = 0

    def rehearse(self) -> None:
        """Nothing to prepare."""

    def act(self, scene: PolicyScene) -> Act | None:
        """The command in force at the next instant of the recording."""
        if self._next >= len(self._commands):
            return None
        command = self._commands[self._next]
        self._next += 1
        return Act(command, command)
