"""A robot: body, mount, cables, chambers, commands, markers, parameters and, for pushing, an object on a plate.

Implausible numbers in a robot's description, such as millimetres given as metres.

Bounds lie far beyond existing robots: they catch wrong units (factors of a thousand), not bad guesses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, PrivateAttr, model_validator

from rfdropo_bayes.cautions import Caution
from rfdropo_bayes.groups import Patterns, group_of, whole
from rfdropo_bayes.robots.body import Body
from rfdropo_bayes.robots.cable import Cable, Channels
from rfdropo_bayes.robots.catalogue import find_robot_file, robot_tables
from rfdropo_bayes.robots.chamber import Chamber
from rfdropo_bayes.robots.drive_travel import DriveTravel, Travel, travel_in, unstated_travel
from rfdropo_bayes.robots.motor import Motor
from rfdropo_bayes.robots.outline import RobotOutline, not_given, outlined_tables
from rfdropo_bayes.robots.parameter import Parameter
from rfdropo_bayes.robots.table import Name, Positive, RobotTable, Vector
from rfdropo_bayes.signatures import see_keywords, with_keywords_of
from rfdropo_bayes.tables import changed, nearest, parse_table

ASIDE = 20.0
"""Largest plausible anchor radius, half width or spool radius, in body lengths. The bundled robots reach 0.08 of it;
millimetres given as metres are fifty times the length or more.
"""
LONGEST, SHORTEST = 20.0, 1e-3  # [m], of a body
STRONGEST = 100.0  # [m/s2], ten times the Earth's gravity; that in mm/s2 is a hundred times as much
SLOWEST = 1.0  # [s], of a time step
DENSITIES = 1.0, 3e4  # [kg/m3]: less than any foam has, and more than any metal
MODULI = 10.0, 1e13  # [Pa]: softer than any gel, and stiffer than diamond

REQUIRED = (
    "young_modulus",
    "poisson_ratio",
    "trunk_mass",
    "rayleigh_mass",
    "rayleigh_stiffness",
    "offset_x",
    "offset_y",
    "offset_z",
)
"""Parameters every robot has."""
ZEROS = "initial_displacement"  # parameter of every cable that is driven by a displacement
DRIVEN = {"m": "m", "rad": "m", "N": "N", "N m": "N", "Pa": ("Pa",), "-": ("N", "Pa")}
"""Units of the drives of cables and chambers, by the unit of the commands."""
USUAL_SHARE = 0.4  # usual commands over the largest command: recordings seldom use the whole travel


class CommandTiming(RobotTable):
    """Timing of commands."""

    unit: Literal["m", "rad", "N", "N m", "Pa", "-"] = Field(
        description='unit of the commands: "m" of cable, "rad" of a motor, "N" of tension, "N m" of torque, "Pa" of '
        'pressure, or "-" for drives with commands in volts or shares of their supply; channels.gain converts '
        'torques to newtons, and commands of "-" to newtons or pascals'
    )
    ramp_s: float = Field(
        ge=0.0, description="a change of command is carried out linearly over this time, or a time step"
    )
    dead_time_s: float = Field(ge=0.0, description="time between a command and the start of its effect")
    usual: Positive | None = Field(
        default=None,
        description="size of usual commands, in the unit of commands, which scales the priors of mechanisms; by "
        f"default {USUAL_SHARE} of the largest command",
    )


class Marker(RobotTable):
    """A measured point of the body, given by its position in the undeformed body."""

    name: Name = Field(description="name, as in the recordings")
    point_m: Vector = Field(
        description="position beside the undeformed body: x, y, z; a ball on a stalk moves with its section"
    )


class OrientedSection(RobotTable):
    """A section of the body whose orientation is measured."""

    name: Name = Field(description="name, as in the recordings")
    z_m: float = Field(description="axial coordinate in the undeformed body")


OBJECT = ("cube_mass", "friction", "cube_side", "cube_x", "cube_y", "cube_z", "cube_yaw")
"""Parameters of a cube on a plate."""


class PushScene(RobotTable):
    """A cube on a plate across gravity, for pushing."""

    plate_height_m: float = Field(description="coordinate of the plate's top against gravity")
    contact_distance_m: float = Field(ge=0.0, description="smallest distance between surfaces")
    parameters: dict[Name, Parameter] = Field(
        description="the cube: mass [kg], Coulomb friction, edge [m], and the pose at the start: centre [m], and "
        "turn about the vertical [rad], zero if the edges are parallel to the axes"
    )

    @model_validator(mode="after")
    def _consistent(self) -> PushScene:
        if set(self.parameters) != set(OBJECT):
            raise ValueError(f"the parameters of an object are {', '.join(OBJECT)}")
        for name in ("cube_mass", "cube_side"):
            if self.parameters[name].low <= 0:
                raise ValueError(f"the bounds of {name} let it be zero or negative")
        if self.parameters["friction"].low < 0:
            raise ValueError("the bounds of friction let it be negative")
        return self


class Robot(RobotTable):
    """A soft robot, in the frame of its base: z along the body, away from the clamp; SI units."""

    name: Name = Field(description="name of the robot")
    description: str = Field(description="one line")
    gravity_m_s2: Vector = Field(description="gravity in the frame of the base: x, y, z")
    time_step_s: Positive = Field(description="time step of the simulation")
    integrator: Literal["euler", "sdirk2"] = Field(
        default="sdirk2",
        description='scheme of a time step: "sdirk2" has order 2 (1.6 with taut cables) and two solves a step; '
        '"euler", the scheme of SOFA, has one solve and about ten times the error',
    )
    initial_state: Literal["rest", "equilibrium"] = Field(
        description='"rest" starts undeformed, "equilibrium" in the static equilibrium of the first command'
    )
    command: CommandTiming = Field(description="unit and timing of commands")
    channels: Channels = Field(description="map from commands to the drives of cables and chambers")
    cables: tuple[Cable, ...] = Field(default=(), description="the cables")
    chambers: tuple[Chamber, ...] = Field(default=(), description="the chambers under pressure")
    body: Body = Field(description="geometry: a section profile, or shapes that make one up")
    markers: tuple[Marker, ...] = Field(min_length=1, description="measured points of the body")
    orientations: tuple[OrientedSection, ...] = Field(default=(), description="sections whose orientation is measured")
    push: PushScene | None = Field(default=None, description="object on a plate, if the robot has one")
    motors: tuple[Motor, ...] = Field(
        default=(), description="drives of the channels, in their order; none if the robot is only recorded"
    )
    drives: tuple[DriveTravel, ...] = Field(
        default=(), description="known limits of travel of the drives, and the effect of commands beyond them"
    )
    parameters: dict[Name, Parameter] = Field(description="physical parameters with bounds and default priors, by name")
    _groups: Patterns = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> Robot:
        kinds = "cables and chambers" if self.chambers else "cables"
        driven = tuple(each.name for each in self.actuators)
        for named, names in ((kinds, driven), ("markers", self.marker_names), ("sections", self.section_names)):
            if len(set(names)) != len(names):
                raise ValueError(f"two of its {named} share a name")
        if not self.actuators:
            raise ValueError("the robot has neither cables nor chambers")
        if len(self.channels.gain) != len(self.actuators):
            raise ValueError(f"channels.gain has {len(self.channels.gain)} rows for {len(self.actuators)} {kinds}")
        for each in self.actuators:
            if each.unit not in DRIVEN[self.command.unit]:
                raise ValueError(f"{each.name} is driven in {each.unit}, and commands are in {self.command.unit}")
        if (self.command.unit == "rad") != (self.channels.radius_parameter is not None):
            raise ValueError("channels.radius_parameter is needed for commands in rad, and allowed only for them")
        masses = [mass.parameter for mass in self.body.point_masses]
        radius = [self.channels.radius_parameter] if self.channels.radius_parameter else []
        zeros = [ZEROS] if self.initial_displacement_names else []
        used = {*REQUIRED, *zeros, *masses, *radius}
        for name, parameter in self.parameters.items():
            if name not in used:
                raise ValueError(f"nothing uses the table [parameters.{name}]; {nearest(name, used)}")
            if (parameter.each == "cable") != (name == ZEROS):
                raise ValueError(f'each = "cable" belongs to {ZEROS} alone; mend [parameters.{name}]')
        for name in sorted(used):
            if name not in self.parameters:
                raise ValueError(f"the parameter {name!r} has no table [parameters.{name}]")
        if self.parameters["poisson_ratio"].high > 0.499:
            raise ValueError("poisson_ratio may not exceed 0.499, the limit of incompressible material")
        if self.parameters["trunk_mass"].low <= 0 or any(self.parameters[name].low < 0 for name in masses):
            raise ValueError("the bounds of a mass let it be negative, or the trunk massless")
        if found := implausible(self):
            raise ValueError(found)
        self._check_inside()
        self._check_motors()
        for table in self.drives:
            table.columns(self.channel_names)
        return self

    def _check_motors(self) -> None:
        driven = tuple(motor.channel for motor in self.motors)
        if driven and driven != self.channels.names:
            raise ValueError(f"motors drive {', '.join(driven)}; the channels are {', '.join(self.channels.names)}")
        at: dict[tuple[int, int], str] = {}
        for motor in self.motors:
            if motor.place in at:
                raise ValueError(
                    f"two motors share a node and an axis: {at[motor.place]} and {motor.channel} are on axis "
                    f"{motor.axis} of node {motor.node}"
                )
            at[motor.place] = motor.channel

    def _check_inside(self) -> None:
        station = np.array(self.body.station_m)
        half = np.array(self.body.half_width_m)
        points = {f"guide of {cable.name}": cable.guides() for cable in self.cables}
        points |= {f"end of {each.name}": each.ends() for each in self.chambers}
        points |= {f"section {each.name}": np.array([[0.0, 0.0, each.z_m]]) for each in self.orientations}
        points |= {f"marker {marker.name}": np.array([marker.point_m]) for marker in self.markers}
        for name, place in points.items():
            width = np.stack([np.interp(place[:, 2], station, half[:, axis]) for axis in (0, 1)], axis=1)
            marker = name.startswith("marker")  # it may stand on a stalk, which moves with its section
            beyond = 0.5 * (station[-1] - station[0]) if marker else 1e-9
            outside = (place[:, 2] < station[0] - beyond) | (place[:, 2] > station[-1] + beyond)
            if not marker:
                outside |= np.any(np.abs(place[:, :2]) > width + 1e-9, axis=1)
            if np.any(outside):
                row = int(np.argmax(outside))
                x, y, z = place[row]
                raise ValueError(
                    f"a {name} lies outside the body: it is at x, y, z = {x:.4g}, {y:.4g}, {z:.4g} m, and the body "
                    f"reaches {width[row, 0]:.4g} and {width[row, 1]:.4g} m across, and z from {station[0]:.4g} to "
                    f"{station[-1]:.4g} m"
                )

    @classmethod
    def load(cls, name_or_path: str | Path) -> Robot:
        """Read and validate a robot description.

        Its body is a section profile, or shapes that make one up (`sections`). A file with a key ``base`` describes a
        variant of that robot: its tables replace tables of the base with the same name.

        Args:
            name_or_path: name of a robot that comes with the package, or path of a TOML file.

        Raises:
            InputError: an unknown robot (the known robots are listed), an unreadable file, or a description that does
                not hold together.
        """
        path = find_robot_file(name_or_path)
        return parse_table(cls, robot_tables(path), where=str(path))

    @classmethod
    @with_keywords_of(RobotOutline, without=("assumed",))
    def outline(cls, **answers: Any) -> Robot:
        """A robot from a few answers, in SI units and in the frame of the base: z along the body, away from the clamp.

        Defaults are assumptions: mass and spool radius have wide priors unless they are given, and so has Young's
        modulus in any case. ``rfdropo init`` asks the same, and writes the robot as a file to go on from.

        Args:
            answers: ``name``; ``length`` and ``radius`` (at the base) of the body; ``markers``, heights along the axis
                by name. These four are required. ``shape``: "cylinder", "cone" (with ``tip_radius``), "tube" (with
                ``inner_radius``), or "disks" on a backbone of ``inner_radius`` (``disks`` of 3 mm).
                ``segments`` of ``segment_lengths`` (equal by default), each with its own ``cables`` evenly around it,
                from ``segment_azimuths`` [deg] on (``azimuth_evidence`` and ``size_evidence``: reasons for these, and
                for the sizes), at ``cable_radius`` from the axis at the base; with ``pairs`` opposite cables share a
                motor. ``command_unit``: "m" of cable, "rad" or "N m" of a motor with ``spool_radius``, "N" of tension,
                "Pa" of chambers of ``area`` [m2], or "-" of other drives; ``usual_command``: the size of usual
                commands. ``gravity``: its direction, "+z" for a robot that hangs. ``mass`` [kg], silicone by default;
                ``young_modulus`` [Pa].

        Raises:
            InputError: an unknown answer, a missing answer, or answers that make no robot.
        """
        see_keywords(answers, RobotOutline, "outline", without=("assumed",))
        outlined = RobotOutline(**answers, assumed=not_given(answers))
        return parse_table(cls, outlined_tables(outlined), where="outline")

    def __repr__(self) -> str:
        long = 1e3 * self.length
        commands = f"{len(self.channel_names)} commands [{self.command_unit}] ({', '.join(self.channel_names)})"
        markers = f"markers {', '.join(marker.name for marker in self.markers)}"
        kinds = (("cable", self.cables), ("chamber", self.chambers))
        drives = ", ".join(f"{len(each)} {kind}{'s' if len(each) > 1 else ''}" for kind, each in kinds if each)
        return f"<Robot {self.name}: {long:.4g} mm long, {drives}, {commands}, {markers}>"

    def without_command_timing(self) -> Robot:
        """The same robot, carrying every command out at once: no ramp, no dead time."""
        timing = CommandTiming(unit=self.command.unit, ramp_s=0.0, dead_time_s=0.0, usual=self.command.usual)
        return self.with_changes(command=timing)

    def with_changes(self, **values: Any) -> Robot:
        """The same robot with other values of some fields, validated anew.

        Raises:
            InputError: values that do not fit together.
        """
        found = changed(self, where=f"robot {self.name}", **values)
        found._groups = self._groups
        return found

    def travel(self, recording: str, initial: Float[np.ndarray, " channel"]) -> Travel | None:
        """Stated limits of the drives in a recording that begins at this command [m or rad]; see `travel_in`."""
        group = group_of(recording, self._groups)
        return travel_in(self.drives, self.channel_names, recording, initial, group)

    def unstated(self, recordings: Iterable[str]) -> list[Caution]:
        """A caution if the travel of drives is stated for other recordings only; see `unstated_travel`."""
        belonging = {name: group_of(name, self._groups) for name in map(whole, recordings)}
        return unstated_travel(self.drives, self.channel_names, belonging)

    def grouped(self, groups: Patterns) -> Robot:
        """The same robot, whose drives may be stated by groups of recordings."""
        found = self.with_changes()
        found._groups = groups
        return found

    @property
    def gravity(self) -> Float[np.ndarray, "3"]:
        """Gravity in the frame of the base [m/s2]."""
        return np.array(self.gravity_m_s2)

    @property
    def command_unit(self) -> str:
        return self.command.unit

    @property
    def cable_names(self) -> tuple[str, ...]:
        """Names of the cables."""
        return tuple(cable.name for cable in self.cables)

    @property
    def stroke(self) -> float:
        """Largest command of any channel at nominal parameters, in its unit."""
        return float(np.max(np.abs(self.command_limits())))

    @property
    def held_by_force(self) -> bool:
        """Whether the drives hold tensions of cables or pressures, and not lengths."""
        return self.command_unit not in ("m", "rad")

    @property
    def usual_command(self) -> float:
        """Size of usual commands, in their unit."""
        return self.command.usual or USUAL_SHARE * self.stroke

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the command channels."""
        return self.channels.names

    @property
    def marker_names(self) -> tuple[str, ...]:
        return tuple(marker.name for marker in self.markers)

    @property
    def section_names(self) -> tuple[str, ...]:
        """Names of the sections whose orientation is measured."""
        return tuple(each.name for each in self.orientations)

    def rod_arrays(self) -> dict[str, np.ndarray]:
        """The sections of the finite-element engine's rod: ``profile_rod(**robot.rod_arrays())``."""
        return self.body.arrays()

    def marker_points(self) -> Float[np.ndarray, "marker 3"]:
        """Markers in the undeformed body [m]."""
        return np.array([marker.point_m for marker in self.markers])

    def anchors(self) -> Float[np.ndarray, "cable 3"]:
        """Points fixed to the base from which the cables start [m]."""
        return np.array([cable.anchor() for cable in self.cables]).reshape(-1, 3)

    def guides(self) -> list[Float[np.ndarray, "guide 3"]]:
        """Guide points of each cable in the undeformed body [m]; cables may have different numbers of them."""
        return [cable.guides() for cable in self.cables]

    @property
    def length(self) -> float:
        """Length of the body along its axis [m]."""
        return float(self.body.station_m[-1] - self.body.station_m[0])

    @property
    def actuators(self) -> tuple[Cable | Chamber, ...]:
        """The cables, then the chambers."""
        return self.cables + self.chambers

    def drive_limits(self) -> Float[np.ndarray, "drive 2"]:
        """Least and greatest drive of each cable, a displacement [m], pull > 0, or a tension [N], and then of each
        chamber, a pressure [Pa]."""
        return np.array([each.limit for each in self.actuators])

    def command_limits(self) -> tuple[Float[np.ndarray, " channel"], Float[np.ndarray, " channel"]]:
        """Least and greatest command of each channel [m or rad] at nominal parameters.

        A cable may be released as far as it may be pulled, or to its release limit if that is nearer. Otherwise a
        policy could release slack that takes hundreds of actions to wind up.
        """
        limits = self.drive_limits()
        pull, release = limits[:, 1], np.maximum(limits[:, 0], -limits[:, 1])
        matrix = np.asarray(self.channel_matrix(self.nominal()), dtype=float)
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([release[:, None] / matrix, pull[:, None] / matrix])
        none = np.stack([np.full_like(matrix, -np.inf), np.full_like(matrix, np.inf)])
        ends = np.where(matrix == 0.0, none, ends)
        low, high = np.min(ends, axis=0), np.max(ends, axis=0)
        return low.max(axis=0), high.min(axis=0)

    def command_of(self, pull: float) -> Float[np.ndarray, " channel"]:
        """Size of each channel's command for a given pull of a cable [m]: the pull, or the angle (at nominal
        parameters) that moves one of the channel's cables by the pull and the others by less.
        """
        if self.command_unit == "m":
            return np.full(len(self.channel_names), pull)
        return pull / np.abs(np.asarray(self.channel_matrix(self.nominal()), dtype=float)).max(axis=0)

    def markers_near(self, heights: Sequence[float]) -> tuple[int, ...]:
        """Indices of the markers nearest to these heights [m] along the axis of the undeformed body."""
        own = self.marker_points()[:, 2]
        return tuple(dict.fromkeys(int(np.argmin(np.abs(own - wanted))) for wanted in heights))

    def channel_matrix(self, parameters: Mapping[str, Any]) -> Any:
        """Matrix (drive, channel) from commands to the drives of cables and chambers, for these parameter values.

        Values may be JAX tracers; the matrix is then also a tracer.
        """
        gain = np.array(self.channels.gain)
        radius = self.channels.radius_parameter
        return gain if radius is None else parameters.get(radius, self.parameters[radius].nominal) * gain

    def parameter_table(self) -> dict[str, Parameter]:
        """Every base parameter by name, with parameters per cable written out."""
        table: dict[str, Parameter] = {}
        for name, parameter in self.parameters.items():
            if parameter.each == "cable":
                for cable in (each.name for each in self.cables if each.unit == "m"):
                    described = f"{parameter.description} (cable {cable})"
                    table[f"{name}_{cable}"] = parameter.model_copy(update={"description": described, "each": None})
            else:
                table[name] = parameter
        return table

    @property
    def initial_displacement_names(self) -> tuple[str, ...]:
        """Parameters that hold the displacement of each cable at zero command, in the order of the cables that are
        driven by one."""
        return tuple(f"{ZEROS}_{cable.name}" for cable in self.cables if cable.unit == "m")

    def nominal(self) -> dict[str, float]:
        """Nominal value of every base parameter."""
        return {name: parameter.nominal for name, parameter in self.parameter_table().items()}

    def density(self, trunk_mass: Any) -> Any:
        """Density [kg/m3] of the body when the trunk, clamped part included, has this mass [kg]."""
        return trunk_mass / self.body.volume_m3

    def stiffness_scale(self, poisson_ratio: Any) -> Any:
        """Factor (layer,) on the stiffness of each layer at this Poisson ratio; see `Body.poisson_stiffening`."""
        return self.body.stiffness_scale(poisson_ratio)

    def point_masses(self, parameters: Mapping[str, Any]) -> Any:
        """Masses lumped at the stations [kg], for these parameter values (JAX tracers welcome)."""
        names, placement = self.body.point_mass_placement()
        values = [parameters.get(name, self.parameters[name].nominal) for name in names]
        return sum((placement[:, i] * value for i, value in enumerate(values)), np.zeros(len(placement)))


def implausible(robot: Robot) -> str | None:
    """Description of a value in an implausible unit; None if all are plausible."""
    station, half = np.array(robot.body.station_m), np.array(robot.body.half_width_m)
    length = float(station[-1] - station[0])
    if not SHORTEST <= length <= LONGEST:
        return f"the body is {length:.4g} m long: are lengths in metres?"
    sizes = {"half_width_m of the body": float(half.max())}
    for cable in robot.cables:
        sizes[f"anchor_radius_m of the cable {cable.name}"] = cable.anchor_radius_m
        sizes[f"distance of anchor_z_m of the cable {cable.name} from the body"] = station[0] - cable.anchor_z_m
    sizes |= {f"radius_m of the chamber {chamber.name}": chamber.radius_m for chamber in robot.chambers}
    if robot.channels.radius_parameter is not None:
        sizes[robot.channels.radius_parameter] = robot.parameters[robot.channels.radius_parameter].nominal
    for name, size in sizes.items():
        if size > ASIDE * length:
            return f"the {name} is {size:.4g} m, and the body is {length:.4g} m long: are all lengths in metres?"
    gravity = float(np.linalg.norm(robot.gravity_m_s2))
    if gravity > STRONGEST:
        return f"gravity_m_s2 is {gravity:.4g} m/s2: is it in metres?"
    if robot.time_step_s > SLOWEST:
        return f"time_step_s is {robot.time_step_s:.4g} s: is it in seconds?"
    nominal = {name: (parameter.nominal, parameter.nominal) for name, parameter in robot.parameters.items()}
    return implausible_values(robot, nominal)


def implausible_values(robot: Robot, ranges: Mapping[str, tuple[float, float]]) -> str | None:
    """Description of an implausible mass or stiffness of the body; None if all are plausible.

    Args:
        robot: robot with this body.
        ranges: least and largest likely value of each parameter [SI], by name; a range is implausible only if it lies
            entirely outside the plausible values.
    """
    for name, (low, high) in ranges.items():
        if name == "trunk_mass" and (found := _beyond(robot.density(low), robot.density(high), DENSITIES)):
            volume = f"a volume of {robot.body.volume_m3:.4g} m3"
            return (
                f"trunk_mass is {_words(low, high)} kg in {volume}, or {found:.3g} kg/m3: are they in kilograms and "
                "cubic metres?"
            )
        if name == "young_modulus" and _beyond(low, high, MODULI):
            return f"young_modulus is {_words(low, high)} Pa: is it in pascals?"
    return None


def _beyond(low: float, high: float, ends: tuple[float, float]) -> float | None:
    """The end of a range nearest to the plausible values, if the range is entirely outside them; None otherwise."""
    if high < ends[0]:
        return float(high)
    return float(low) if low > ends[1] else None


def _words(low: float, high: float) -> str:
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
