"""A robot from a few answers: shape, cables or chambers, markers, mass; written as a commented robot file."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots.sections import Cone, Cylinder, Disks, Tube, body_tables, section_profile

SILICONE = 1070.0  # density [kg/m3] if no mass is given; typical of silicone rubbers
GRAVITY = 9.81
DIRECTIONS = {f"{sign}{axis}": (sign, "xyz".index(axis)) for sign in "+-" for axis in "xyz"}
SHAPES = ("cylinder", "cone", "tube", "disks")
CABLES_AT = 0.75  # distance of cables from the axis over the body's radius, if it is not given
DISKS = 10  # disks of a body if their number is not given, or the next number that shares out over the segments
LEAST_GUIDES, GUIDES_PER_SEGMENT = 8, 4
"""Heights of guides, and layers of a body that does not taper: their elements are within .2 % of the limit if four
cables bend a silicone arm by up to 1.5 rad, and .6 % for a body five times softer. A cone with a tip of .6 of its
base's radius has twice this number (.6 %), and at .3 four times this number (.4 % up to half a radian).
"""
DRIVES = {"Pa": ("chamber", "pressure")}  # words for a drive and its command, if they are not a cable and its pull
COMMANDS = ("m", "rad", "N", "N m", "Pa", "-")
DISK_THICKNESS = 0.003  # [m]
CHAMBER_RADIUS = 0.2  # radius of a chamber over the body's, if it is not given
VACUUM = -101325.0  # [Pa] Least pressure above the surroundings
USUAL_PULL = 0.15  # usual pull of a cable over the body's length
FORCE_LIMIT = 5.0  # ratio of a drive's largest tension to the tension of a usual command
KNOWN, ASSUMED = 0.3, 1.0  # standard deviation of the logarithm in the prior of a given value, and of a default


@dataclass(frozen=True)
class RobotOutline:
    """Answers that make a robot; lengths in m, in the frame of the base: z along the body, away from the clamp."""

    name: str  # name of the robot and of its file
    # length, radius: length of the body, and radius at its base
    length: float
    radius: float
    markers: Mapping[str, float]  # heights along the axis by name
    # "cylinder", "cone" (with ``tip_radius``), "tube" (with ``inner_radius``), or "disks" on a backbone
    shape: Literal["cylinder", "cone", "tube", "disks"] = "cylinder"
    tip_radius: float | None = None
    inner_radius: float | None = None
    disks: int | None = None
    segments: int = 1  # number of segments, each with cables that end at its end
    cables: int = 4  # number of cables, or of chambers, per segment, evenly around it
    # distance of the cables from the axis at the base, which follow the taper; or of the chambers
    cable_radius: float | None = None
    pairs: bool = False  # opposite cables share a motor: one cable is wound as the other is released
    # "m" of cable, "rad" or "N m" of a motor, whose spool then has ``spool_radius``, "N" of tension, "-" of other
    # drives of cables, or "Pa": the body then has chambers in place of cables
    command_unit: Literal["m", "rad", "N", "N m", "Pa", "-"] = "m"
    spool_radius: float = 0.01
    area: float | None = None  # area of a chamber across the axis [m2]; by default in proportion to the body's
    gravity: str = "+z"  # direction of gravity, such as "+z" for a robot that hangs
    mass: float | None = None  # mass of the body [kg]; None for silicone of its volume
    young_modulus: float = 1e6  # Young's modulus [Pa]
    segment_lengths: tuple[float, ...] | None = None  # lengths of the segments, base to tip; equal by default
    # azimuth of the first cable of each segment [deg]; cables of all segments are spread evenly by default
    segment_azimuths: tuple[float, ...] | None = None
    # azimuth_evidence, size_evidence: reasons for azimuths, and for sizes, that were found from a recording
    azimuth_evidence: str = ""
    size_evidence: str = ""
    usual_command: float | None = None  # size of usual commands, in their unit
    assumed: frozenset[str] = frozenset()  # names of attributes that have default values

    def __post_init__(self) -> None:
        where = "robot outline"
        if self.gravity not in DIRECTIONS:
            remedy = f"use one of {', '.join(DIRECTIONS)}: the direction of gravity, with z away from the clamp"
            raise InputError(f"gravity = {self.gravity!r} is not a direction", where=where, remedy=remedy)
        if self.command_unit not in COMMANDS:
            remedy = '"m" of cable or "rad" of a motor; recordings in mm or deg are converted when they are read'
            raise InputError(
                f"command_unit = {self.command_unit!r} is not a unit of a robot", where=where, remedy=remedy
            )
        if self.shape not in SHAPES:
            raise InputError(f"unknown shape {self.shape!r}", where=where, remedy=f"use one of {', '.join(SHAPES)}")
        for key in ("length", "radius", "young_modulus", "spool_radius", "area"):
            if (size := getattr(self, key)) is not None and not size > 0.0:
                raise InputError(f"{key} = {size:g} is not positive", where=where)
        if self.segments < 1 or self.cables < 1:
            raise InputError("an arm has one segment and one cable at least", where=where)
        given = self.segment_lengths
        if given is not None and (len(given) != self.segments or abs(sum(given) - self.length) > 1e-3 * self.length):
            said = ", ".join(f"{1e3 * part:g}" for part in given)
            remedy = f"give {self.segments} lengths whose sum is {1e3 * self.length:g} mm"
            raise InputError(f"segments of {said} mm do not make up the body", where=where, remedy=remedy)
        if self.shape == "disks" and len({self.end_of_cables(k) for k in range(self.segments)}) < self.segments:
            raise InputError("two segments end at one disk", where=where, remedy="give more disks")
        if self.pairs and self.command_unit == "Pa":
            raise InputError(
                "pairs of chambers are not possible", where=where, remedy="give each chamber its own command"
            )
        if self.pairs and self.cables % 2:
            raise InputError(f"{self.cables} cables make no pairs", where=where, remedy="give an even number")
        if self.shape == "disks" and self.number_of_disks % self.segments:
            remedy = f"give a multiple of {self.segments}"
            raise InputError(
                f"{self.disks} disks do not share out over {self.segments} segments", where=where, remedy=remedy
            )
        if not self.markers:
            raise InputError("no markers", where=where, remedy="give at least the tip's")

    @property
    def section(self) -> Cylinder | Cone | Tube | Disks:
        """The body's shape; layers end at the ends of segments and at guides."""
        tip = self.radius if self.tip_radius is None else self.tip_radius
        layers = self.levels * max(1, int(np.ceil(self.radius / tip - 1e-9)))
        if self.shape == "cone":
            return Cone(length_m=self.length, layers=layers, radius_m=(self.radius, tip))
        if self.shape == "tube":
            inner = self.inner_radius or 0.5 * min(self.radius, tip)
            return Tube(length_m=self.length, layers=layers, radius_m=(self.radius, tip), inner_radius_m=inner)
        if self.shape == "disks":
            return Disks(
                length_m=self.length,
                disks=self.number_of_disks,
                radius_m=self.radius,
                thickness_m=DISK_THICKNESS,
                backbone_radius_m=self.inner_radius or 0.2 * self.radius,
            )
        return Cylinder(length_m=self.length, layers=layers, radius_m=self.radius)

    @property
    def trunk_mass(self) -> float:
        """Mass [kg], given or assumed."""
        return SILICONE * section_profile([self.section]).volume_m3 if self.mass is None else self.mass

    @property
    def levels(self) -> int:
        """Heights at which a body without disks guides cables."""
        return self.segments * max(GUIDES_PER_SEGMENT, -(-LEAST_GUIDES // self.segments))

    def guide_heights(self) -> np.ndarray:
        """Heights of the cable guides: in the middle of the disks, or evenly along the body, up to its tip."""
        if self.shape != "disks":
            share = np.arange(1, self.levels // self.segments + 1) * self.segments / self.levels
            starts = [0.0, *self.segment_ends()[:-1]]
            return np.concatenate(
                [start + (end - start) * share for start, end in zip(starts, self.segment_ends(), strict=True)]
            )
        station = np.array(section_profile([self.section]).station_m)
        return 0.5 * (station[1::2] + station[2::2])

    def first_azimuths(self) -> list[float]:
        """Azimuth of the first cable of each segment [deg]."""
        even = [360.0 / self.cables * segment / self.segments for segment in range(self.segments)]
        return list(self.segment_azimuths or even)

    def segment_ends(self) -> list[float]:
        """Height at which each segment ends [m]."""
        lengths = self.segment_lengths or (self.length / self.segments,) * self.segments
        return np.cumsum(lengths).tolist()

    def end_of_cables(self, segment: int) -> float:
        """Height at which the cables of a segment end [m]: the segment's end, or the nearest disk."""
        end = self.segment_ends()[segment]
        if self.shape != "disks":
            return end
        heights = self.guide_heights()
        return float(heights[np.argmin(np.abs(heights - end))])

    @property
    def arm(self) -> float:
        """Distance of the cables at the base, or of the chambers, from the axis [m]."""
        return CABLES_AT * self.inside if self.cable_radius is None else self.cable_radius

    @property
    def inside(self) -> float:
        """Radius of the body at the base [m], or if chambers run straight through it, where it is narrowest."""
        tip = self.radius if self.tip_radius is None else self.tip_radius
        return min(self.radius, tip) if self.command_unit == "Pa" else self.radius

    @property
    def bending_force(self) -> float:
        """Tension, or thrust of a chamber, that bends the body by a usual pull [N], see `mechanisms.sizes`."""
        ends = np.array([[self.arm, 0.0, 0.0], [self.arm, 0.0, self.length]])
        give = section_profile([self.section]).shortening(ends)
        return self.young_modulus * USUAL_PULL * self.length / give

    @property
    def sets_bend(self) -> str | None:
        """The assumed attribute that sets how far a command bends the body; None if all that do were given."""
        names = {"m": ("cable_radius",), "rad": ("spool_radius", "cable_radius"), "Pa": ("young_modulus", "area")}.get(
            self.command_unit, ("young_modulus",)
        )
        return next((name for name in names if name in self.assumed), None)

    def resized(self, scale: float, bend: float, softness: float, evidence: str) -> RobotOutline:
        """The robot in the size that a recording shows.

        Args:
            scale: factor of the lengths that were assumed.
            bend: factor of the bend of a command, by the attribute that `sets_bend`.
            softness: factor of the body's compliance.
            evidence: reason for length and radius, in words.
        """
        lengths = ("length", "radius", "tip_radius", "inner_radius")
        changes: dict[str, Any] = {
            name: _rounded(scale * value)
            for name in lengths
            if name in self.assumed and (value := getattr(self, name)) is not None
        }
        if "markers" in self.assumed:
            changes["markers"] = {name: _rounded(scale * height) for name, height in self.markers.items()}
        if {"radius", "cable_radius"} <= self.assumed:
            changes["cable_radius"] = None  # it follows the body
        if softness != 1.0 and self.sets_bend != "young_modulus":
            changes["young_modulus"] = _rounded(self.young_modulus * scale / softness)
        sized = replace(self, **changes, size_evidence=evidence)
        if self.sets_bend == "spool_radius":
            return replace(sized, spool_radius=_rounded(self.spool_radius * bend * sized.arm / self.arm))
        if self.sets_bend == "cable_radius":
            arm = self.arm / bend
            if "radius" not in self.assumed:
                return replace(sized, cable_radius=_rounded(min(arm, sized.radius)))
            wider = arm / sized.arm
            tip = None if sized.tip_radius is None else _rounded(wider * sized.tip_radius)
            return replace(sized, radius=_rounded(wider * sized.radius), tip_radius=tip)
        before, after = (o.bending_force / o.force_of_unit / o.young_modulus * o.arm / o.length for o in (self, sized))
        if self.sets_bend == "young_modulus":
            return replace(sized, young_modulus=_rounded(self.young_modulus / softness * before / after))
        if self.sets_bend == "area":
            return replace(sized, area=_rounded(bend * sized.chamber_area * after / before))
        return sized

    @property
    def force_of_unit(self) -> float:
        """Force of a unit command as far as the body's size sets it: the area of a chamber [m2], else 1."""
        return self.chamber_area if self.command_unit == "Pa" else 1.0

    @property
    def chamber_area(self) -> float:
        """Area of a chamber across the axis [m2]."""
        return np.pi * (CHAMBER_RADIUS * self.inside) ** 2 if self.area is None else self.area

    @property
    def newtons(self) -> float:
        """Tension under a command of one [N], of drives that hold tensions; 1 for others."""
        if self.command_unit == "N m":
            return 1.0 / self.spool_radius
        return self.bending_force / (self.usual_command or 1.0) if self.command_unit == "-" else 1.0

    def channel_names(self) -> list[str]:
        """One per cable, or one per pair of cables."""
        count = self.cables // 2 if self.pairs else self.cables
        word = "motor" if self.command_unit == "rad" or self.pairs else DRIVES.get(self.command_unit, ("", "pull"))[1]
        if self.segments == 1:
            return [f"{word}_{k + 1}" for k in range(count)]
        return [f"s{s + 1}_{word}_{k + 1}" for s in range(self.segments) for k in range(count)]

    def cable_names(self) -> list[str]:
        """Names of the cables, or chambers, of all segments, base to tip."""
        word = DRIVES.get(self.command_unit, ("cable",))[0]
        if self.segments == 1:
            return [f"{word}_{k + 1}" for k in range(self.cables)]
        return [f"s{s + 1}_{word}_{k + 1}" for s in range(self.segments) for k in range(self.cables)]

    @property
    def number_of_disks(self) -> int:
        """As given, or the first number from `DISKS` on that shares out over the segments."""
        return self.segments * -(-DISKS // self.segments) if self.disks is None else self.disks


def not_given(answers: Mapping[str, Any]) -> frozenset[str]:
    """Names of the answers of a `RobotOutline` that are taken as defaults, and that its shape needs."""
    needless = {"assumed", "usual_command", "azimuth_evidence", "size_evidence"} | (
        {"disks"} if answers.get("shape") != "disks" else set()
    )
    needless |= {"segment_lengths"} if answers.get("segments", 1) == 1 else set()
    lies = not answers.get("gravity", "+z").endswith("z")
    needless |= {"segment_azimuths"} if answers.get("segments", 1) == 1 and not lies else set()
    return frozenset(field.name for field in fields(RobotOutline) if field.name not in answers) - needless


def robot_text(outline: RobotOutline) -> str:
    """A commented robot file."""
    drives = _chambers(outline) if outline.command_unit == "Pa" else _cables(outline)
    return "\n".join([*_head(outline), *_channels(outline), *drives, *_markers(outline), *_parameters(outline)])


def outlined_tables(outline: RobotOutline) -> dict[str, Any]:
    """The tables of a robot file that these answers make, its body as a section profile."""
    tables = tomllib.loads(robot_text(outline))
    return tables | {"body": body_tables(tables["body"], "outline")}


def _head(o: RobotOutline) -> list[str]:
    sign, axis = DIRECTIONS[o.gravity]
    gravity = [0.0, 0.0, 0.0]
    gravity[axis] = GRAVITY if sign == "+" else -GRAVITY
    section, kind = o.section.model_dump(), DRIVES.get(o.command_unit, ("cable",))[0]
    return [
        "# Written by rfdropo init; docs/reference/robot.md has every key. SI units, in the frame of the base: z along",
        "# the undeformed body, away from the clamp. Values marked ASSUMED are defaults: measure them, or let them be",
        "# inferred.",
        f'name = "{o.name}"',
        f'description = "{o.segments} segment{"s" if o.segments > 1 else ""}, {o.segments * o.cables} {kind}s"',
        f"gravity_m_s2 = {gravity}{_mark(o, 'gravity')}",
        "time_step_s = 0.01             # rfdropo check measures its error",
        'integrator = "sdirk2"          # or "euler": half the work, and ten times the error',
        'initial_state = "equilibrium"  # or "rest": undeformed',
        "",
        "[command]",
        f'unit = "{o.command_unit}"' + _mark(o, "command_unit"),
        "ramp_s = 0.0                   # a change of command is carried out linearly over this time",
        "dead_time_s = 0.0              # delay after which it begins",
        *([] if o.usual_command is None else [f"usual = {o.usual_command:.3g}  # size of the recorded commands"]),
        "",
        "# Shapes one after the other from the clamp to the tip: cylinder, cone, tube, disks. In their place six lists",
        "# of areas and moments may stand, for sections of any form.",
        "[[body.section]]" + _mark(o, "shape", "length", "radius", "tip_radius", "disks"),
        *([f"# ASSUMED sizes: {o.size_evidence}."] if o.size_evidence else []),
        *(f"{key} = {_toml(value)}" for key, value in section.items()),
        "",
    ]


def _channels(o: RobotOutline) -> list[str]:
    names = o.channel_names()
    gain = np.zeros((o.segments * o.cables, len(names)))
    for row in range(len(gain)):
        segment, cable = divmod(row, o.cables)
        half = o.cables // 2
        column = segment * half + cable % half if o.pairs else row
        gain[row, column] = -1.0 if o.pairs and cable >= half else 1.0
    gain *= o.newtons
    words = {
        "rad": "# Cable displacement = gain @ command, times the spool's radius; pull > 0.",
        "N m": "# Tension = gain @ command: one over the spool's radius." + _mark(o, "spool_radius"),
        "Pa": "# Pressure = gain @ command.",
        "-": "# Tension = gain @ command. ASSUMED: the usual command bends the body by a usual pull; "
        "the inferred stiffness is relative to it.",
    }
    lines = [
        words.get(o.command_unit, "# Cable displacement, or tension, = gain @ command; pull > 0."),
        "[channels]",
        f"names = {_toml(names)}",
        "gain = [",
        *(f"    {_toml(row.tolist())}," for row in gain),
        "]",
    ]
    return [*lines, *(['radius_parameter = "spool_radius"'] if o.command_unit == "rad" else []), ""]


def _cables(o: RobotOutline) -> list[str]:
    heights = o.guide_heights()
    tip = o.radius if o.tip_radius is None or o.shape in ("cylinder", "disks") else o.tip_radius
    radius = o.arm * (1.0 + (tip / o.radius - 1.0) * heights / o.length)
    lines = [
        "# Cables at their azimuth, from +x towards +y, through guides up to their ends."
        + _mark(o, "cables", "cable_radius", "segment_lengths", "segment_azimuths"),
        *([f"# ASSUMED azimuths: {o.azimuth_evidence}."] if o.azimuth_evidence else []),
    ]
    names = o.cable_names()
    for row in range(o.segments * o.cables):
        segment, cable = divmod(row, o.cables)
        azimuth = (360.0 / o.cables * cable + o.first_azimuths()[segment]) % 360.0
        inside = heights <= o.end_of_cables(segment) + 1e-9
        lines += [
            "[[cables]]",
            f'name = "{names[row]}"',
            f"azimuth_deg = {azimuth:g}",
            "anchor_z_m = 0.0",
            f"anchor_radius_m = {_toml(o.arm)}",
            f"guide_z_m = {_toml(heights[inside].tolist())}",
            f"guide_radius_m = {_toml(radius[inside].tolist())}",
            *_limits(o),
            "",
        ]
    return lines


def _chambers(o: RobotOutline) -> list[str]:
    usual = o.bending_force / o.chamber_area if o.usual_command is None else o.usual_command
    lines = [
        "# Chambers beside the axis, from +x towards +y. ASSUMED: that they reach along their segment. The inferred",
        "# stiffness is relative to their area." + _mark(o, "area", "cables", "cable_radius", "segment_lengths"),
        *([f"# ASSUMED azimuths: {o.azimuth_evidence}."] if o.azimuth_evidence else []),
    ]
    names, ends = o.cable_names(), [0.0, *o.segment_ends()]
    for row in range(o.segments * o.cables):
        segment, chamber = divmod(row, o.cables)
        lines += [
            "[[chambers]]",
            f'name = "{names[row]}"',
            f"azimuth_deg = {360.0 / o.cables * chamber + o.first_azimuths()[segment]:g}",
            f"radius_m = {_toml(o.arm)}",
            f"z_m = {_toml(list(ends[segment : segment + 2]))}",
            f"area_m2 = {o.chamber_area:.6g}",
            f"pressure_limit_pa = [{VACUUM:g}, {FORCE_LIMIT * usual:.6g}]  # ASSUMED",
            "",
        ]
    return lines


def _limits(o: RobotOutline) -> list[str]:
    """Kind and limits of a cable's drive."""
    if o.command_unit in ("m", "rad"):
        return [f"displacement_limit_m = [{-o.length:.6g}, {0.5 * o.length:.6g}]"]
    usual = o.bending_force if o.usual_command is None else o.newtons * o.usual_command
    return ['drive = "tension"', f"tension_limit_n = [0.0, {FORCE_LIMIT * usual:.6g}]  # ASSUMED"]


def _markers(o: RobotOutline) -> list[str]:
    lines = ["# Measured points in the undeformed body: x, y, z." + _mark(o, "markers")]
    for name, height in o.markers.items():
        lines += ["[[markers]]", f'name = "{name}"', f"point_m = [0.0, 0.0, {_toml(float(height))}]", ""]
    return lines


def _parameters(o: RobotOutline) -> list[str]:
    modulus, mass = o.young_modulus, o.trunk_mass
    lines = ["# Parameters: hard bounds, and the prior that an experiment asks for with {}."]

    def add(name: str, unit: str, nominal: float, bounds: tuple[float, float], prior: str, words: str) -> None:
        lines.extend(
            [
                f"[parameters.{name}]" + _mark(o, name),
                f'unit = "{unit}"',
                f"nominal = {nominal:.6g}",
                f"low = {bounds[0]:.6g}",
                f"high = {bounds[1]:.6g}",
                f"prior = {{ {prior} }}",
                f'description = "{words}"',
                *(['each = "cable"'] if name == "initial_displacement" else []),
                "",
            ]
        )

    def log_normal(name: str, median: float, spread: float | None = None) -> str:
        sigma = spread or (ASSUMED if name in o.assumed else KNOWN)
        return f'distribution = "LogNormal", median = {median:.6g}, sigma = {sigma:g}'

    spread = log_normal("young_modulus", modulus, ASSUMED)
    add("young_modulus", "Pa", modulus, (modulus / 1e3, modulus * 1e3), spread, "Young's modulus of the body")
    ratio = 'distribution = "Uniform", low = 0.4, high = 0.499'
    add("poisson_ratio", "-", 0.45, (0.1, 0.499), ratio, "Poisson's ratio; rubber is near 0.5")
    prior = log_normal("mass" if "mass" in o.assumed else "trunk_mass", mass)
    add("trunk_mass", "kg", mass, (mass / 100.0, mass * 100.0), prior, "mass of the body")
    prior = log_normal("rayleigh_mass", 0.1, ASSUMED)
    add("rayleigh_mass", "1/s", 0.1, (0.0, 20.0), prior, "damping proportional to mass")
    prior = log_normal("rayleigh_stiffness", 0.05, ASSUMED)
    add("rayleigh_stiffness", "s", 0.05, (0.0, 2.0), prior, "damping proportional to stiffness")
    if o.command_unit == "rad":
        prior = log_normal("spool_radius", o.spool_radius)
        bounds = (o.spool_radius / 10.0, o.spool_radius * 10.0)
        add("spool_radius", "m", o.spool_radius, bounds, prior, "cable wound up per angle of the motor")
    if o.command_unit in ("m", "rad"):
        prior = f'distribution = "Normal", loc = 0.0, scale = {0.005 * o.length:.6g}'
        half = 0.5 * o.length
        add("initial_displacement", "m", 0.0, (-half, half), prior, "cable displacement at zero command")
    prior = f'distribution = "Normal", loc = 0.0, scale = {0.025 * o.length:.6g}'
    for axis in "xyz":
        words = f"shift of the measured positions along {axis}"
        add(f"offset_{axis}", "m", 0.0, (-5.0 * o.length, 5.0 * o.length), prior, words)
    return lines


def _mark(o: RobotOutline, *names: str) -> str:
    """A comment that marks default values."""
    also = {"trunk_mass": "mass"}
    missing = [name for name in names if name in o.assumed or also.get(name) in o.assumed]
    return f"  # ASSUMED: {', '.join(missing)}" if missing else ""


def _rounded(value: float) -> float:
    """Three digits: more are not found."""
    return float(f"{value:.3g}")


def _toml(value: object) -> str:
    """A string, a number or a list of these as TOML writes it."""
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return repr(float(f"{value:.9g}")) if isinstance(value, float) else str(value)
