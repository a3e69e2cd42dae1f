"""Features: the inputs of a law at a port. A feature is a number per time step, from time, commands or motion.

A feature is written as a step with a memory, so that a whole rollout, which scans it, and a session give the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms.first_order import first_order
from rfdropo_bayes.tables import nearest

REST = 1e-9  # m or rad per step: less is the rounding of a command that is held
OWN = -1
"""Stands for the command of the cable on which a law acts, at a port of several cables."""
OWN_NAME = "own"
GAUGES = ("tip x", "tip y", "tip z", "tip distance")
"""Inputs of motion features [m]: displacement of the last marker since the first step, and its norm."""


class Kind(NamedTuple):
    """A kind of feature.

    Attributes:
        channels: number of commands that the feature uses.
        unit: exponents of the command's unit and of seconds.
        words: phrase with placeholders for commands and shape.
        formula: symbol with the same placeholders.
        shapes: tried values of its shape, as shares of the commands' stroke or in seconds; empty without a shape.
    """

    channels: int
    unit: tuple[int, int]
    words: str
    formula: str
    shapes: tuple[float, ...] = ()


KINDS: Mapping[str, Kind] = {
    "constant": Kind(0, (0, 0), "by a constant", "1"),
    "time": Kind(0, (0, 1), "with time", "t"),
    "command": Kind(1, (1, 0), "in proportion to {0}", "u_{0}"),
    "drift": Kind(1, (1, 1), "with time times {0}", "t u_{0}"),
    "product": Kind(2, (2, 0), "with {0} times {1}", "u_{0} u_{1}"),
    "magnitude": Kind(1, (1, 0), "with the size of {0}, whatever its sign", "|u_{0}|"),
    "rate": Kind(1, (1, -1), "with the speed of {0}", "du_{0}/dt"),
    "direction": Kind(1, (0, 0), "by the direction that {0} moved last", "sign(du_{0})"),
    "low_pass": Kind(1, (1, 0), "with {0} of the last {shape:.2g} s", "lowpass(u_{0}, {shape:.2g} s)", (0.3, 3.0)),
    "lag": Kind(
        1,
        (1, 0),
        "by how far {0} is ahead of its last {shape:.2g} s",
        "u_{0} - lowpass(u_{0}, {shape:.2g} s)",
        (0.1, 0.3),
    ),
    "play": Kind(
        1,
        (0, 0),
        "by the last motion of {0}, as with a play of {shape:.2g}",
        "play(u_{0}, {shape:.2g})",
        (0.05, 0.1, 0.2),
    ),
    "largest": Kind(1, (1, 0), "with the largest {0} so far", "max|u_{0}|"),
    "travelled": Kind(1, (1, 0), "with all the travel of {0} so far", "travel(u_{0})"),
    "position": Kind(1, (1, 0), "in proportion to {0}", "u_{0}"),
}
"""Shapes: of a low pass and of a lag the time constant [s]; of a play half its width, tried as a share of the commands'
stroke. A lag is the difference of two features, of which each alone brings little: a search that adds one term at a
time does not come to it."""

MOTION_KINDS = ("position", "rate", "largest")
"""Kinds of features of the motion; a position is of nothing else."""


class Feature(NamedTuple):
    """A feature of some commands, or of the motion.

    Attributes:
        kind: a key of `KINDS`.
        channels: indices of its commands, or of its `GAUGES`; `OWN` must be replaced before use, see `of`.
        shape: time constant [s] or width [m or rad]; None without a shape.
        of_motion: whether the feature depends on `GAUGES` instead of commands.
    """

    kind: str
    channels: tuple[int, ...] = ()
    shape: float | None = None
    of_motion: bool = False

    def of(self, channel: int) -> Feature:
        """The feature with a command in the place of `OWN`."""
        return self._replace(channels=tuple(channel if k == OWN else k for k in self.channels))

    def in_shape(self, shape: Any) -> Feature:
        """The feature with another shape, which may be traced."""
        return self._replace(shape=shape)

    def commands(self, names: Sequence[str]) -> list[str]:
        """Names of the feature's commands or gauges."""
        known = GAUGES if self.of_motion else names
        return [OWN_NAME if k == OWN else known[k] for k in self.channels]

    @property
    def in_time(self) -> bool:
        """Whether it depends on seconds, and not on the order of commands alone."""
        return bool(KINDS[self.kind].unit[1]) or self.kind in ("low_pass", "lag")

    def begin(self, first: Float[Array, " channel"]) -> Any:
        """Memory before the first step, given the command that was held before it."""
        own = [first[k] for k in self.channels]
        zero = jnp.zeros((), first.dtype)
        memories: dict[str, Any] = {
            "time": zero,
            "drift": zero,
            "rate": own,
            "direction": [*own, zero],
            "low_pass": [*own, *own],
            "lag": [*own, *own],
            "play": [*own, zero],
            "largest": [jnp.abs(u) for u in own],
            "travelled": [*own, zero],
        }
        return memories.get(self.kind, ())

    def at_rest(self, first: Float[Array, " channel"]) -> Float[Array, ""]:
        """Its value before the first step."""
        if self.kind in ("command", "position", "low_pass"):
            return first[self.channels[0]]
        if self.kind in ("magnitude", "largest"):
            return jnp.abs(first[self.channels[0]])
        if self.kind == "product":
            return first[self.channels[0]] * first[self.channels[1]]
        return jnp.ones((), first.dtype) if self.kind == "constant" else jnp.zeros((), first.dtype)

    def advance(self, memory: Any, given: Float[Array, " channel"], interval: float) -> tuple[Any, Float[Array, ""]]:
        """Memory and value at the end of a step of ``interval`` seconds, given the command reached."""
        own = [given[k] for k in self.channels]
        if self.kind not in ("time", "drift", "rate", "direction", "low_pass", "lag", "play", "largest", "travelled"):
            return memory, self.at_rest(given)
        return self._remembering(memory, own, interval)

    def _remembering(self, memory: Any, own: list[Array], interval: float) -> tuple[Any, Array]:
        if self.kind == "time":
            return memory + interval, memory + interval
        if self.kind == "drift":
            return memory + interval, (memory + interval) * own[0]
        u, before = own[0], memory[0]
        if self.kind == "rate":
            return own, (u - before) / interval
        if self.kind in ("low_pass", "lag"):
            assert self.shape is not None
            slow = first_order(before, memory[1], u, interval, self.shape)
            return [slow, u], slow if self.kind == "low_pass" else u - slow
        if self.kind == "largest":
            most = jnp.maximum(before, jnp.abs(u))
            return [most], most
        move = jnp.where(jnp.abs(u - before) > REST, u - before, 0.0)
        if self.kind == "travelled":
            way = memory[1] + jnp.abs(move)
            return [u, way], way
        if self.kind == "direction":
            sign = jnp.where(move != 0.0, jnp.sign(move), memory[1])
            return [u, sign], sign
        assert self.shape is not None
        lead = jnp.clip(memory[1] + move / self.shape, -1.0, 1.0)
        return [u, lead], lead

    def over(self, levels: Float[Array, "row channel"], interval: float) -> Float[Array, " row"]:
        """Its values over commands; row 0 is before the first step."""

        def one(memory: Any, given: Float[Array, " channel"]) -> tuple[Any, Float[Array, ""]]:
            return self.advance(memory, given, interval)

        rest = jax.lax.scan(one, self.begin(levels[0]), levels[1:])[1]
        return jnp.concatenate([self.at_rest(levels[0])[None], rest])

    def unit(self, command_unit: str) -> tuple[tuple[str, int], ...]:
        """Powers of units."""
        length, seconds = KINDS[self.kind].unit
        own = "m" if self.of_motion else command_unit
        return tuple((name, power) for name, power in ((own, length), ("s", seconds)) if power)

    def shape_unit(self, command_unit: str) -> str:
        """Unit of the feature's shape; "-" without a shape."""
        own = "m" if self.of_motion else command_unit
        return "-" if self.shape is None else own if self.kind == "play" else "s"

    def words(self, names: Sequence[str]) -> str:
        """In a sentence."""
        own = ["its own command" if name == OWN_NAME else name for name in self.commands(names)]
        return KINDS[self.kind].words.format(*own, shape=self.shape or 0.0)

    def formula(self, names: Sequence[str]) -> str:
        """As a symbol."""
        symbol = KINDS[self.kind].formula.replace("u_", "") if self.of_motion else KINDS[self.kind].formula
        return symbol.format(*self.commands(names), shape=self.shape or 0.0)


def gauges_of(path: Float[Array, "row 3"]) -> Float[Array, "row 4"]:
    """`GAUGES` of the last marker's path [m]; row 0 is before the first step."""
    way = path - path[0]
    square = jnp.sum(way**2, axis=1)
    moved = square > 0.0  # the slope of a root has no value at 0
    distance = jnp.where(moved, jnp.sqrt(jnp.where(moved, square, 1.0)), 0.0)
    return jnp.concatenate([way, distance[:, None]], axis=1)


def motion_dictionary() -> list[Feature]:
    """All features of the motion: position and velocity of the last marker, and its largest distance so far."""
    last = len(GAUGES) - 1
    features = [Feature("position", (k,), of_motion=True) for k in range(len(GAUGES))]
    features += [Feature("rate", (k,), of_motion=True) for k in range(last)]
    return [*features, Feature("largest", (last,), of_motion=True)]


def dictionary(channels: int, stroke: float) -> list[Feature]:
    """All features of time and of ``channels`` commands, whose largest change is ``stroke`` [m or rad]."""
    return _of_channels(range(channels), stroke)


def own_dictionary(stroke: float) -> list[Feature]:
    """All features of a cable's own command, see `OWN`."""
    return _of_channels([OWN], stroke)


def _of_channels(channels: Sequence[int], stroke: float) -> list[Feature]:
    features = []
    for name, kind in KINDS.items():
        if name == "position":
            continue
        shapes: list[float | None] = [*kind.shapes] or [None]
        if name == "play":
            shapes = [share * stroke for share in kind.shapes]
        places = combinations_with_replacement(channels, kind.channels)
        features += [Feature(name, place, shape) for place in places for shape in shapes]
    return features


def feature_named(
    kind: str,
    commands: Sequence[str],
    shape: float | None,
    names: Sequence[str],
    where: str,
    *,
    of_motion: bool = False,
) -> Feature:
    """A feature as a file has it.

    Args:
        kind: key of `KINDS`.
        commands: names of its commands, including `OWN_NAME` if ``names`` has it; or of its gauges.
        shape: time constant or width; None without a shape.
        names: names of the commands, in their order; `OWN_NAME`, if it may be used, comes last. Or `GAUGES`.
        where: location in the file.
        of_motion: whether the feature depends on gauges.

    Raises:
        InputError: an unknown kind or command, or a shape that is missing or has no meaning.
    """
    if kind not in KINDS:
        raise InputError(f"unknown feature {kind!r}", where=where, remedy=nearest(kind, KINDS))
    if of_motion != (kind in MOTION_KINDS) and (of_motion or kind == "position"):
        raise InputError(
            f"the feature {kind!r} is not made of {'the motion' if of_motion else 'commands'}",
            where=where,
            remedy=f"features of the motion are {', '.join(MOTION_KINDS)}; see docs/mechanisms.md",
        )
    for command in commands:
        if command not in names:
            what = "part of the motion" if of_motion else "command"
            raise InputError(f"unknown {what} {command!r}", where=where, remedy=nearest(command, names))
    wanted = KINDS[kind]
    if len(commands) != wanted.channels:
        raise InputError(
            f"the feature {kind!r} is made of {wanted.channels} commands, not {len(commands)}",
            where=where,
            remedy="name the same number in commands = [...]",
        )
    if bool(wanted.shapes) != (shape is not None) or (shape is not None and not shape > 0.0):
        needs = "a positive shape" if wanted.shapes else "no shape"
        raise InputError(f"the feature {kind!r} takes {needs}", where=where, remedy="see docs/mechanisms.md")
    places = tuple(OWN if command == OWN_NAME else names.index(command) for command in commands)
    return Feature(kind, places, shape, of_motion)
