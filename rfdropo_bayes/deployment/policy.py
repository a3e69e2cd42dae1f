"""Where commands come from: a policy as an ONNX file with its card, or the commands of an earlier session.

The card of a policy stands in the metadata of the ONNX file (`rfdropo.*`, JSON values): what it was made for and the
layout of what goes in and comes out. Normalisation, clipping and scaling are baked into the graph. A policy is refused
unless its card fits the robot and the session to the letter.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.deployment.causes import Cause, Stop
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.tables import parse_table

METADATA = "rfdropo."
"""Prefix of the keys in the metadata of the ONNX file."""


class PolicyCard(BaseModel):
    """What a policy was made for.

    Attributes:
        robot: name of the robot, or of one with the same channels and markers.
        rate_hz: how often it acts.
        unit: of its actions and of "command." entries, "m" or "rad".
        action: "increment" of the command per act, or the "command" itself.
        channels: in the order of its output.
        low, high: ends of its output; a value outside them means that something is broken.
        observation: names of its inputs, in order; see `FEATURES`.
        start: command that its episodes start from; zeros by default.
    """

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    robot: str
    rate_hz: float = Field(gt=0.0)
    unit: Literal["m", "rad"]
    action: Literal["increment", "command"]
    channels: tuple[str, ...] = Field(min_length=1)
    low: tuple[float, ...]
    high: tuple[float, ...]
    observation: tuple[str, ...] = Field(min_length=1)
    start: tuple[float, ...] | None = None

    def metadata(self) -> dict[str, str]:
        """Keys and values for the metadata of an ONNX file."""
        return {f"{METADATA}{key}": json.dumps(value) for key, value in self.model_dump().items() if value is not None}


class Scene(NamedTuple):
    """What a policy may see.

    Attributes:
        position: of the markers [m]; the newest known of each.
        velocity: of the markers [m/s], between the last two acts.
        command: in force [command unit].
        action: the policy's last output, as it is limited by its card.
        length: cable on each drum, measured [m].
        tension: of each cable [N].
    """

    position: Float[np.ndarray, "marker 3"]
    velocity: Float[np.ndarray, "marker 3"]
    command: Float[np.ndarray, " channel"]
    action: Float[np.ndarray, " channel"]
    length: Float[np.ndarray, " channel"]
    tension: Float[np.ndarray, " channel"]


FEATURES = (
    "marker.NAME.AXIS",
    "velocity.NAME.AXIS",
    "command.CHANNEL",
    "action.CHANNEL",
    "length.CHANNEL",
    "tension.CHANNEL",
    "goal.KEY",
)
"""Names that an observation may be made of; NAME a marker, AXIS one of x, y, z, KEY one of the deployment's [goal]."""


def observer(
    names: Sequence[str], robot: Robot, goal: Mapping[str, float]
) -> Callable[[Scene], Float[np.ndarray, " feature"]]:
    """The function from a scene to an observation of these features.

    Raises:
        InputError: for a name that means nothing for this robot.
    """
    channels, markers = list(robot.channel_names), list(robot.marker_names)
    size = {"marker": 3 * len(markers), "velocity": 3 * len(markers)}
    kinds = ("marker", "velocity", "command", "action", "length", "tension")
    start = dict(zip(kinds, np.cumsum([0, *(size.get(kind, len(channels)) for kind in kinds)])[:-1], strict=True))
    fixed = np.array([goal.get(name.removeprefix("goal."), 0.0) for name in names])
    column = np.zeros(len(names), dtype=int)
    for place, name in enumerate(names):
        kind, *rest = name.split(".")
        if kind in size and len(rest) == 2 and rest[0] in markers and rest[1] in ("x", "y", "z"):
            column[place] = start[kind] + 3 * markers.index(rest[0]) + "xyz".index(rest[1])
        elif kind in start and kind not in size and len(rest) == 1 and rest[0] in channels:
            column[place] = start[kind] + channels.index(rest[0])
        elif kind == "goal" and len(rest) == 1 and rest[0] in goal:
            column[place] = -1
        else:
            known = f"of {', '.join(FEATURES)}" if kind != "goal" else "in [goal] of the deployment file"
            raise InputError(
                f"the policy wants {name!r}, which is not known here",
                where="observation layout",
                remedy=f"give a policy for this robot: names are {known}",
            )

    def observe(scene: Scene) -> Float[np.ndarray, " feature"]:
        everything = np.concatenate([np.ravel(part) for part in scene])
        return np.where(column >= 0, everything[column], fixed).astype(np.float32)

    return observe


class Act(NamedTuple):
    """What is commanded: the raw output, and the command it asks for, both before the motors' limits."""

    raw: Float[np.ndarray, " channel"]
    command: Float[np.ndarray, " channel"]


class CommandSource(Protocol):
    """Where commands come from."""

    rate_hz: float
    start: Float[np.ndarray, " channel"]
    sees_markers: bool
    """Whether lost markers make its commands worthless."""

    def act(self, scene: Scene) -> Act | None:
        """The next command [command unit]; None where there is no more.

        Raises:
            Stop: if it has none that can be followed.
        """
        ...


class OnnxPolicy:
    """A policy from an ONNX file.

    Args:
        path: of the file.
        robot: that it is to drive.
        goal: values of its "goal." inputs.
        sha256: hash that the file must have; None accepts any.

    Raises:
        InputError: if the file cannot be read, or its card, hash or shapes do not fit.
    """

    def __init__(self, path: Path, robot: Robot, goal: Mapping[str, float], sha256: str | None = None) -> None:
        where = f"policy {path}"
        content = read_file(path)
        self.sha256 = hashlib.sha256(content).hexdigest()
        if sha256 is not None and sha256 != self.sha256:
            raise InputError(
                f"its hash is {self.sha256}", where=where, remedy="this is another policy than [policy] sha256 names"
            )
        self._session, self.card = _open(content, where)
        _check_card(self.card, robot, where)
        self._observe = observer(self.card.observation, robot, goal)
        self._input, self._output = self._session.get_inputs()[0], self._session.get_outputs()[0]
        order = [self.card.channels.index(channel) for channel in robot.channel_names]
        self._order = np.array(order)
        self._low, self._high = np.array(self.card.low)[order], np.array(self.card.high)[order]
        self.rate_hz = self.card.rate_hz
        self.sees_markers = any(name.startswith(("marker.", "velocity.")) for name in self.card.observation)
        start = self.card.start or (0.0,) * len(order)
        self.start = np.array(start)[order]
        self._check_shapes(where)

    def act(self, scene: Scene) -> Act:
        """Run the network.

        Raises:
            Stop: if its output is not finite, or outside the ends that its card states.
        """
        observation = self._observe(scene)
        if not np.all(np.isfinite(observation)):
            bad = self.card.observation[int(np.argmax(~np.isfinite(observation)))]
            raise Stop(Cause.MARKERS_LOST, f"observation {bad} is not finite")
        raw = self._run(observation)[self._order]
        if not np.all(np.isfinite(raw)):
            raise Stop(Cause.ACTION_NOT_FINITE, f"the policy's output is {raw.tolist()}")
        slack = 1e-4 * (self._high - self._low)  # single precision
        if np.any(raw < self._low - slack) or np.any(raw > self._high + slack):
            raise Stop(Cause.ACTION_OUTSIDE, f"the policy's output {raw.tolist()} is outside what its card states")
        return Act(raw, scene.command + raw if self.card.action == "increment" else raw)

    def _run(self, observation: Float[np.ndarray, " feature"]) -> Float[np.ndarray, " channel"]:
        try:
            answer = self._session.run([self._output.name], {self._input.name: observation[None]})[0]
        except Exception as error:  # onnxruntime raises many types, none of them documented
            raise Stop(Cause.POLICY_FAILED, f"{type(error).__name__}: {error}") from None
        return np.asarray(answer, dtype=float).reshape(-1)

    def _check_shapes(self, where: str) -> None:
        wanted, kind = len(self.card.observation), self._input.type
        width = self._input.shape[-1] if self._input.shape else None
        if kind != "tensor(float)" or (isinstance(width, int) and width != wanted):
            raise InputError(
                f"takes {kind} of width {width}; its card lists {wanted} observations",
                where=where,
                remedy="export it again with its card",
            )
        given = self._run(np.zeros(wanted, dtype=np.float32))
        if given.shape != (len(self._order),):
            raise InputError(f"gives {given.size} values for {len(self._order)} channels", where=where)


def read_file(path: Path) -> bytes:
    """Content of a policy file.

    Raises:
        InputError: if it cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror})", where=f"policy {path}", remedy="correct the path"
        ) from None


def _open(content: bytes, where: str) -> tuple[Any, PolicyCard]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # a pool of threads costs more than the network
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise InputError(f"is no ONNX model ({type(error).__name__})", where=where, remedy="export it again") from None
    table: dict[str, Any] = {}
    for key, text in session.get_modelmeta().custom_metadata_map.items():
        if key.startswith(METADATA):
            try:
                table[key.removeprefix(METADATA)] = json.loads(text)
            except json.JSONDecodeError:
                raise InputError(f"{key} = {text!r} is no JSON", where=where, remedy="export it again") from None
    if not table:
        raise InputError("has no card in its metadata", where=where, remedy="export it with `rfdropo train`")
    return session, parse_table(PolicyCard, table, where=where)


def _check_card(card: PolicyCard, robot: Robot, where: str) -> None:
    if card.robot != robot.name:
        raise InputError(
            f"was made for robot {card.robot!r}, not {robot.name!r}", where=where, remedy="give a policy for this robot"
        )
    if sorted(card.channels) != sorted(robot.channel_names):
        raise InputError(
            f"drives {', '.join(card.channels)}; the robot has {', '.join(robot.channel_names)}",
            where=where,
            remedy="give a policy for this robot",
        )
    if card.unit != robot.command_unit:
        raise InputError(
            f"acts in {card.unit}, the robot's commands are in {robot.command_unit}",
            where=where,
            remedy="give a policy for this robot",
        )
    lengths = [len(card.low), len(card.high), len(card.start or card.channels)]
    if lengths != [len(card.channels)] * 3 or not np.all(np.array(card.low) < np.array(card.high)):
        raise InputError("low, high and start do not fit its channels", where=where, remedy="export it again")


class RecordedCommands:
    """The commands of a recording, sent again.

    Args:
        recording: of an earlier session, or any trajectory of this robot.
        robot: that is to be driven.
        rate_hz: how often the command in force is looked up.

    Raises:
        InputError: if channels or unit do not fit.
    """

    sees_markers = False

    def __init__(self, recording: Trajectory, robot: Robot, rate_hz: float) -> None:
        if recording.cable_names != robot.channel_names or recording.command_unit != robot.command_unit:
            raise InputError(
                f"drives {', '.join(recording.cable_names)} in {recording.command_unit}; the robot has "
                f"{', '.join(robot.channel_names)} in {robot.command_unit}",
                where=recording.name,
                remedy="replay it on the robot it was recorded on",
            )
        self.rate_hz, self.start = rate_hz, np.array(recording.initial_command)
        end = max(float(recording.time[-1]), float(recording.command_time[-1]) + 1.0 / rate_hz)
        self._commands = recording.command_at(np.arange(0.0, end, 1.0 / rate_hz))
        self._next = 0

    def act(self, scene: Scene) -> Act | None:
        """The command in force at the next instant of the recording."""
        if self._next >= len(self._commands):
            return None
        command = self._commands[self._next]
        self._next += 1
        return Act(command, command)
