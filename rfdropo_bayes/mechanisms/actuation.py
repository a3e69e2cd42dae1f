"""Mechanisms between the command that was sent and the displacement that reaches the cables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.mechanisms.default_priors import half_normal, log_normal, normal
from rfdropo_bayes.mechanisms.first_order import first_order
from rfdropo_bayes.mechanisms.sizes import USUAL, scaled
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.cable import Cable
from rfdropo_bayes.simulators.mechanisms import MemorylessActuation, SteppedActuation, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec

SPOOL = 0.02  # [m], radius of a usual spool, for motors of which no usual command is known
POWERS = {"m": 1, "m/s": 1, "1/m": -1, "s/m": -1}  # of a length in each unit
NUMBERED = tuple(str(k + 1) for k in range(8))
REST = 1e-9  # m or rad per step: less is the rounding of a command that is held
GRID = (5.0, 15.0, 30.0, 60.0, 85.0, 110.0, 150.0, 250.0, 500.0, 1000.0)  # of travels to a stop, inverted


class InCommandUnit:
    """Base of mechanisms whose parameters are in the unit of commands. A class states its parameters for metres of
    cable.

    Args:
        unit: unit of the commands.
        usual: size of usual commands, in their unit; a usual trunk's if unknown.
    """

    parameters: tuple[ParameterSpec, ...]
    in_metres: ClassVar[tuple[ParameterSpec, ...]]

    def __init__(self, unit: str = "m", usual: float | None = None) -> None:
        unknown = {"m": USUAL.pull, "rad": USUAL.pull / SPOOL}.get(unit, 1.0)
        per_metre = (unknown if usual is None else usual) / USUAL.pull
        self.parameters = tuple(in_unit(spec, unit, per_metre) for spec in self.in_metres)

    @classmethod
    def for_robot(cls, robot: Robot) -> InCommandUnit:
        """The mechanism with parameters in the unit of a robot's commands."""
        return cls(robot.command_unit, robot.usual_command)


def in_unit(spec: ParameterSpec, unit: str, per_metre: float) -> ParameterSpec:
    """A parameter given for metres of cable of a usual trunk, in another unit of commands: ``per_metre`` is the ratio
    of usual commands.
    """
    word = {"-": "1", "N m": "(N m)"}.get(unit, unit) if "/" in spec.unit else unit
    return scaled(spec, per_metre ** POWERS[spec.unit])._replace(unit=word.join(spec.unit.rsplit("m", 1)))


class PerChannel:
    """Base of mechanisms with a size of its own for each command channel.

    Args:
        channels: names of the command channels; numbers by default.

    Attributes:
        size: parameter of one channel, whose name and description the channel's name is added to.
    """

    size: ClassVar[ParameterSpec]
    parameters: tuple[ParameterSpec, ...]

    def __init__(self, channels: Sequence[str] = NUMBERED) -> None:
        one = self.size
        self.parameters = tuple(
            one._replace(name=f"{one.name}_{channel}", description=f"{one.description} of {channel}")
            for channel in channels
        )

    @classmethod
    def for_robot(cls, robot: Robot) -> Self:
        """One size for every command channel of a robot."""
        return cls(robot.channel_names)

    def sizes(self, values: Values, count: int) -> Float[Array, " channel"]:
        """The sizes of the first ``count`` channels."""
        return jnp.stack([values[spec.name] for spec in self.parameters[:count]])


class CommandDelay:
    """Pure transport delay: the command acts ``command_delay`` seconds late; zero is the base simulator."""

    name = "command_delay"
    stage = "actuation"
    inside_drive = True
    cause = "communication and drive latency"
    remedy = "stamp commands at their execution, or shift the clock by this much"
    parameters: tuple[ParameterSpec, ...] = (
        ParameterSpec("command_delay", "s", 0.0, 2.0, 0.0, half_normal(0.1), "delay of every command"),
    )

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        """Read each command its delay earlier, linearly between steps."""
        history = jnp.concatenate([initial[None], command])
        return self._late(values, time_step, jnp.arange(1, len(history)), history)

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array]:
        """Commands of the last steps, as far back as a delay may reach, and the number of steps."""
        steps = math.ceil(self.parameters[0].high / interval) + 2
        return jnp.broadcast_to(first, (steps, *first.shape)), jnp.zeros((), int)

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array], Float[Array, " channel"]]:
        """Read each command its delay earlier; the oldest one is overwritten."""
        last, step = memory[0], memory[1] + 1
        last = last.at[step % len(last)].set(given)
        return (last, step), self._late(values, now, step, last)

    def _late(
        self, values: Values, interval: float, step: Int[Array, "*step"], history: Float[Array, "kept channel"]
    ) -> Float[Array, "*step channel"]:
        """Commands in force at steps, from a history whose places are reused in turn."""
        return _read_late(step, values["command_delay"] / interval, lambda at: history[at % len(history)])


class CableDelay(PerChannel, CommandDelay):
    """Each command acts by its own delay late; zero at null. Equal delays of all are `command_delay`'s."""

    name = "cable_delay"
    cause = "a drive that answers later than others: its bus, its controller, or its own filter"
    remedy = "command all drives at once, and compare the stamps of their first motion"
    size = ParameterSpec("cable_delay", "s", 0.0, 2.0, 0.0, half_normal(0.1), "delay")

    def _late(
        self, values: Values, interval: float, step: Int[Array, "*step"], history: Float[Array, "kept channel"]
    ) -> Float[Array, "*step channel"]:
        def own(late: Float[Array, ""], past: Float[Array, " kept"]) -> Float[Array, "*step"]:
            return _read_late(step, late, lambda at: past[at % len(past)][..., None])[..., 0]

        late = self.sizes(values, history.shape[1]) / interval
        return jax.vmap(own, in_axes=(0, 1), out_axes=-1)(late, history)


def _read_late(
    step: Int[Array, "*step"],
    late: Float[Array, ""],
    read: Callable[[Int[Array, "*step"]], Float[Array, "*step channel"]],
) -> Float[Array, "*step channel"]:
    """Value of ``read`` by ``late`` steps earlier, not before step 0, linear between steps."""
    at = step - late
    # Interpolation towards the past keeps the derivative right at zero delay, at which only later times count.
    after = jnp.maximum(jnp.ceil(at), 0).astype(int)
    weight = jnp.where(at > 0, after - at, 0.0)[..., None]
    newer = read(after)
    return newer - weight * (newer - read(jnp.maximum(after - 1, 0)))


class ActuatorLag(SteppedActuation):
    """First-order lag of the drives, ``tau y' = u - y``; tau = 0 is the base simulator."""

    name = "actuator_lag"
    stage = "actuation"
    inside_drive = True
    cause = "bandwidth of the position loop of the drives, or of valves and their lines"
    remedy = "stiffen the position loop, shorten the lines, or keep the lag in the model"
    parameters: tuple[ParameterSpec, ...] = (
        ParameterSpec("actuator_lag", "s", 0.0, 5.0, 0.0, half_normal(0.2), "time constant of the lag"),
    )

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array]:
        """Position of the drives, and the last command."""
        return first, first

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array], Float[Array, " channel"]]:
        """Follow the command, starting from rest at its initial value."""
        reached = first_order(*memory, given, now, self._times(values, len(given)))
        return (reached, given), reached

    def _times(self, values: Values, channels: int) -> Float[Array, "*channel"]:
        return values["actuator_lag"]


class CableLag(PerChannel, ActuatorLag):
    """Each drive follows with a first-order lag of its own; zero at null. Equal lags of all are `actuator_lag`'s."""

    name = "cable_lag"
    cause = "a drive that follows more slowly than others: its load, its gains, friction of its cable, or its valve"
    remedy = "step each drive alone, and compare the rise of their encoders"
    size = ParameterSpec("cable_lag", "s", 0.0, 5.0, 0.0, half_normal(0.2), "time constant")

    def _times(self, values: Values, channels: int) -> Float[Array, "*channel"]:
        return self.sizes(values, channels)


class CommandGain(MemorylessActuation):
    """All commands scaled by ``1 + command_gain_error``; zero is the base simulator."""

    name = "command_gain"
    stage = "actuation"
    inside_drive = True
    cause = (
        "wrong spool radius or transmission ratio, cable stretch proportional to travel, wrong area of chambers, or "
        "load cells of wrong gain"
    )
    remedy = (
        "measure the cable travel of one motor turn, the pressure in the chambers, or hang weights on the load cells"
    )
    parameters = (
        ParameterSpec(
            "command_gain_error", "-", -0.9, 2.0, 0.0, normal(0.2), "relative error of the commanded displacement"
        ),
    )

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Scale the whole command."""
        return (1.0 + values["command_gain_error"]) * sent


class CableGain(PerChannel, MemorylessActuation):
    """Each command scaled by its own ``1 + error``; zero at null. Equal errors of all are `command_gain`'s."""

    name = "cable_gain"
    stage = "actuation"
    inside_drive = False
    cause = (
        "spools of different radius, cables that stretch, slip or are torn, chambers that leak or differ in area, or "
        "load cells of wrong gain"
    )
    remedy = (
        "measure how far each cable travels, or the pressure in each chamber, for the same command, or hang the same "
        "weight on each load cell"
    )
    # At -1 a cable does not pull at all.
    size = ParameterSpec("cable_gain_error", "-", -1.0, 2.0, 0.0, normal(0.2), "relative error of the displacement")

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Scale each command, from zero on."""
        return (1.0 + self.sizes(values, sent.shape[-1])) * sent


class CableSlack(InCommandUnit, MemorylessActuation):
    """The first part of every pull only takes up slack (a dead zone around zero); none at null."""

    name = "cable_slack"
    stage = "actuation"
    inside_drive = False
    cause = "cables that are not taut at zero command, or a dead zone of the drives"
    remedy = "tension the cables until each just moves the body, and set zero there"
    in_metres = (
        ParameterSpec(
            "cable_slack", "m", 0.0, 0.1, 0.0, half_normal(0.003), "command that is lost before a cable is taut"
        ),
    )

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Shrink the command towards zero by the slack."""
        slack = values["cable_slack"]
        return jnp.where(sent > slack, sent - slack, jnp.where(sent < -slack, sent + slack, 0.0))


class Backlash(InCommandUnit, SteppedActuation):
    """At each reversal a drive moves by twice ``backlash`` before the cable follows (play operator); none at null."""

    name = "backlash"
    stage = "actuation"
    inside_drive = False
    cause = "play in gears, couplings or spools"
    remedy = "reverse each drive by hand and measure the play; preload the transmission"
    in_metres = (
        ParameterSpec("backlash", "m", 0.0, 0.1, 0.0, half_normal(0.0005), "half of the play between drive and cable"),
    )

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array]:
        """Lead of the drive over the cable, and its last command; starts in the middle of the play."""
        return jnp.zeros_like(first), first

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array], Float[Array, " channel"]]:
        """Drag the cable's end along with the drive."""
        half, (lead, last) = values["backlash"], memory
        move = given - last
        # Strict comparisons keep the derivative of the last move without play.
        ahead = lead + jnp.where(jnp.abs(move) > REST, move, 0.0)
        lead = jnp.where(ahead > half, half, jnp.where(ahead < -half, -half, ahead))
        return (lead, given), given - lead


class EndStop(InCommandUnit, MemorylessActuation):
    """Commands beyond a limit are cut off on either side; the limit is infinite, its inverse zero, at null."""

    name = "end_stop"
    stage = "actuation"
    inside_drive = True
    cause = "a mechanical end stop, a software limit or the largest torque of a drive"
    remedy = "read the drives' limits and their measured positions at the largest command"
    in_metres = (
        ParameterSpec(
            "inverse_travel_limit",
            "1/m",
            0.0,
            1e5,
            0.0,
            half_normal(100.0),
            "one over the largest command that is carried out",
            grid=(5.0, 15.0, 30.0, 55.0, 60.0, 70.0, 85.0, 110.0, 150.0, 250.0),
        ),
    )

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Cut the command off at the limit."""
        inverse = values["inverse_travel_limit"]
        limit = jnp.sign(sent) / jnp.maximum(inverse, 1e-12)
        return jnp.where(jnp.abs(sent) * inverse > 1.0, limit, sent)


class TravelStop(InCommandUnit, SteppedActuation):
    """Commands beyond a stop have no effect: a drive at its stop moves with the first command away from the stop.

    In contrast to `EndStop`, which cuts off the accumulated command and has to be commanded all the way back. Travel is
    counted from the initial command. Both limits are infinite, their inverses zero, at null.
    """

    name = "travel_stop"
    stage = "actuation"
    inside_drive = True
    cause = (
        "a drive that moves relative to its position, and ignores moves beyond its stop or a limit of its controller"
    )
    remedy = "record the positions of the drives beside their commands; command absolute positions"
    in_metres = (
        ParameterSpec(
            "inverse_release_travel",
            "1/m",
            0.0,
            1e5,
            0.0,
            half_normal(200.0),
            "one over the travel from the initial command to the stop on the side of release",
            grid=GRID,
        ),
        ParameterSpec(
            "inverse_pull_travel",
            "1/m",
            0.0,
            1e5,
            0.0,
            half_normal(200.0),
            "one over the travel from the initial command to the stop on the side of pull",
            grid=GRID,
        ),
    )

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array]:
        """Motion lost at the stops, and the command from which travel is counted."""
        return jnp.zeros_like(first), first

    def advance(
        self, values: Values, memory: tuple[Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array], Float[Array, " channel"]]:
        """Follow the command, minus all motion lost at the stops."""
        release, pull = values["inverse_release_travel"], values["inverse_pull_travel"]
        lost, start = memory
        travel = given - start - lost
        over = jnp.where(travel * pull > 1.0, travel - 1.0 / jnp.maximum(pull, 1e-12), 0.0)
        under = jnp.where(-travel * release > 1.0, travel + 1.0 / jnp.maximum(release, 1e-12), 0.0)
        lost = lost + over + under
        return (lost, start), given - lost


class RateLimit(InCommandUnit, SteppedActuation):
    """Drives follow at a limited speed; the speed is infinite, its inverse zero, at null."""

    name = "rate_limit"
    stage = "actuation"
    inside_drive = True
    cause = "the speed or current limit of the drives, or a trajectory generator between command and drive"
    remedy = "read the drives' speed limit, or record their positions during a large step"
    in_metres = (
        ParameterSpec(
            "inverse_speed_limit",
            "s/m",
            0.0,
            1e4,
            0.0,
            half_normal(30.0),
            "one over the largest speed of a drive",
            grid=(3.0, 12.0, 20.0, 40.0, 100.0),
        ),
    )

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> Float[Array, " channel"]:
        """Position of the drives."""
        return first

    def advance(
        self, values: Values, memory: Float[Array, " channel"], given: Float[Array, " channel"], now: float
    ) -> tuple[Float[Array, " channel"], Float[Array, " channel"]]:
        """Follow the command as fast as the limit allows."""
        inverse = values["inverse_speed_limit"]
        longest = now / jnp.maximum(inverse, 1e-12)
        move = given - memory
        reached = jnp.where(jnp.abs(move) * inverse > now, memory + jnp.sign(move) * longest, given)
        return reached, reached


class SpoolGrowth(InCommandUnit, MemorylessActuation):
    """Displacement grows with the square of the command, ``u (1 + k u)``; k is zero at null."""

    name = "spool_growth"
    stage = "actuation"
    inside_drive = False
    cause = "cable wound in layers, a conical spool, or a lever whose arm changes with its angle"
    remedy = "measure the travel of a cable turn by turn; use a grooved spool of one layer"
    in_metres = (
        ParameterSpec(
            "spool_growth", "1/m", -1e3, 1e3, 0.0, normal(5.0), "relative change of the displacement per command"
        ),
    )

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Add the square of the command, from zero command on."""
        return sent + values["spool_growth"] * sent**2


class DriveCreep(SteppedActuation):
    """A share of every displacement is given back with a time constant, as by a creeping cable; no share at null."""

    name = "drive_creep"
    stage = "actuation"
    inside_drive = False
    cause = "creep of the cables or of their anchorage under load"
    remedy = "hold one command for minutes and watch the pose; stretch new cables before use"
    parameters = (
        ParameterSpec(
            "drive_creep", "-", -0.9, 0.9, 0.0, normal(0.1), "share of a displacement that is lost in the end"
        ),
        ParameterSpec(
            "drive_creep_time",
            "s",
            1e-2,
            1e3,
            1.0,
            log_normal(1.0, 1.2),
            "time constant of the loss",
            grid=(0.2, 0.5, 1.5, 5.0, 20.0),
        ),
    )

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Array, Array, Array]:
        """The slowly following command, the last command, and the first."""
        return first, first, first

    def advance(
        self, values: Values, memory: tuple[Array, Array, Array], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Array, Array, Array], Float[Array, " channel"]]:
        """Take away a share of the slowly following command."""
        slow, last, start = memory
        followed = first_order(slow, last, given, now, values["drive_creep_time"])
        return (followed, given, start), given - values["drive_creep"] * (followed - start)


class GuideAzimuth(MemorylessActuation):
    """Guides of each cable turned about the body's axis by an angle; zero is the base simulator.

    The cable then has the length of one at another azimuth. A body of constant curvature with lengths imposed at the
    turned azimuths bends as the drawn one does with other lengths, which are a mixture of the commanded lengths.

    Args:
        channels: names of the command channels; numbers by default.
        rows: what a unit of each strain of the body (bending about two axes and stretch, of every segment) winds in of
            each channel, and the same per angle of its cables.
    """

    name = "guide_azimuth"
    stage = "actuation"
    inside_drive = False
    cause = "guides or channels of a cable that do not sit at the azimuth of the drawing"
    remedy = "measure the azimuth of the guides of each cable"

    def __init__(
        self,
        channels: Sequence[str] = (),
        rows: tuple[Float[np.ndarray, "channel strain"], Float[np.ndarray, "channel strain"]] | None = None,
    ) -> None:
        self.rows = rows
        self.parameters = tuple(
            ParameterSpec(
                f"guide_azimuth_error_{channel}", "rad", -1.0, 1.0, 0.0, normal(0.1), f"turn of the guides of {channel}"
            )
            for channel in channels
        )

    @classmethod
    def for_robot(cls, robot: Robot) -> GuideAzimuth:
        """One angle for every channel that drives one cable; no angles if channels share cables, for drives that hold
        tensions, or for a black box."""
        if not isinstance(robot, Robot) or robot.held_by_force:
            return cls()
        gain = np.array(robot.channels.gain)
        if any(np.count_nonzero(line) != 1 for line in (*gain, *gain.T)):
            return cls()
        order = [int(np.flatnonzero(column)[0]) for column in gain.T]
        cables = [robot.cables[index] for index in order]
        ends = sorted({cable.guide_z_m[-1] for cable in cables})
        straight, turned = ([_strains(cable, ends, turn) for cable in cables] for turn in (0.0, 0.5 * np.pi))
        return cls(robot.channel_names, (np.array(straight), np.array(turned)))

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Give the lengths at the drawn azimuths that bend the body as the sent ones do at the turned azimuths."""
        if self.rows is None:
            return sent
        straight, turned = self.rows
        angle = jnp.stack([values[spec.name] for spec in self.parameters])[:, None]
        stretch = jnp.arange(straight.shape[1]) % 3 == 2
        rows = jnp.where(stretch, straight, jnp.cos(angle) * straight + jnp.sin(angle) * turned)
        change = (straight - rows) @ jnp.linalg.pinv(rows)
        return sent + sent @ change.T


def _strains(cable: Cable, ends: Sequence[float], turn: float) -> Float[np.ndarray, " strain"]:
    """Shortening of a cable by bending about both axes and by stretch of each segment, relative to its length."""
    azimuth, radius, strains, begin = math.radians(cable.azimuth_deg) + turn, cable.guide_radius_m[-1], [], 0.0
    for end in ends:
        length = max(min(end, cable.guide_z_m[-1]) - begin, 0.0)
        strains += [length * radius * math.cos(azimuth), length * radius * math.sin(azimuth), length * radius]
        begin = end
    return np.array(strains)
