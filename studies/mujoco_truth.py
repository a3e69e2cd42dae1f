"""A robot made anew in MuJoCo, a truth that this package's engine did not make: springs and links, tendons for cables.

Links are rigid. Between their middles lie joints that stretch along the axis, shear and bend in two planes and twist,
with the section's stiffness over a link's length. Cables are tendons through the guides' places, each drawn in by a
stiff servo that can only pull. What is hidden is hidden by means of that engine: masses, gravity, dry friction,
tendons, gains, sites.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Cable, Robot
from rfdropo_bayes.simulators.commands import commands_on_grid

LINKS = 40  # 80 move the tip by .037 mm, 20 by .19 (rms of 5 s); guides of smooth_arm lie in the middle of 20 or 40
STEP = 2e-4  # [s]: a quarter of it moves the tip by .007 mm
POISSON = 0.0  # of the arm: its sections are rigid, and twist with E / 2
SHEARED = 6.0 * (1.0 + POISSON) / (7.0 + 6.0 * POISSON)  # share of a solid round section that shears (Cowper 1966)
CONTROL = 1e-3  # [s] for which a command is held
CABLE = 5e4  # [N/m] of a servo
CABLE_DAMPING = 0.5  # [N s/m]: a damper is an effect that ours lacks; 5 moves a tip of PyElastica by .23 mm, .5 by .02
STILL = 1e-6  # m that a marker moves in a twentieth of a second, below which an arm rests
LONGEST = 60.0  # [s] that an arm may take to come to rest


@dataclass(frozen=True)
class EngineEffect:
    """An effect by means of MuJoCo.

    Attributes:
        right: mechanisms of the library that name it rightly.
        usual: a size of it, in ``unit``.
        model: changes a model for a size.
        command: changes cable displacements [m] for a size, and the time [s] between them.
        seen: later [s], for a size, the cameras see what was.
    """

    right: tuple[str, ...]
    usual: float
    unit: str
    model: Callable[[Any, float], None] | None = None
    command: Callable[[np.ndarray, float], np.ndarray] | None = None
    seen: Callable[[float], float] | None = None


def _payload(model: Any, size: float) -> None:
    last = model.nbody - 1
    own = model.body_mass[last]
    model.body_mass[last] = own + size
    model.body_ipos[last] = model.body_ipos[last] * own / (own + size) + model.site("tip").pos * size / (own + size)


def _tilt(model: Any, size: float) -> None:
    x, y, z = model.opt.gravity
    model.opt.gravity[:] = [x * np.cos(size) - y * np.sin(size), x * np.sin(size) + y * np.cos(size), z]


def _friction(model: Any, size: float) -> None:
    bends = np.flatnonzero((model.jnt_type == 3) & (model.jnt_axis[:, 2] == 0.0))  # hinges across the axis
    model.dof_frictionloss[model.jnt_dofadr[bends]] = size * model.jnt_stiffness[bends]
    # As it comes, friction is so soft a constraint that it creeps within 20 ms and moves nothing here by 0.05 mm.
    model.dof_solref[:], model.dof_solimp[:, :2] = [5.0 * STEP, 1.0], [0.99, 0.999]
    # Without these rounds it creeps all the same: 0.02 rad moves the markers by 0.05 mm (RMS), with them by 0.76 mm.
    model.opt.noslip_iterations = 10


def _soft_cables(model: Any, size: float) -> None:
    kept = 1.0 / (1.0 + size * model.actuator_gainprm[:, 0])
    model.actuator_gainprm[:, 0] *= kept
    model.actuator_biasprm[:, :2] *= kept[:, None]


def _moved_marker(model: Any, size: float) -> None:
    model.site("m3").pos[0] += size


def _softer_base(model: Any, size: float) -> None:
    joints = np.arange(model.njnt)
    share = 1.0 - joints / joints[-1]  # 1 at the base, 0 at the tip
    model.jnt_stiffness[:] *= 1.0 - size * share
    model.dof_damping[:] *= 1.0 - size * share


def _one_gain(model: Any, size: float) -> None:
    model.actuator_gainprm[0, 0] *= 1.0 + size


def _lag(levels: np.ndarray, size: float) -> np.ndarray:
    """A drive of first order, ``size`` [s] its time constant."""
    kept, found = np.exp(-CONTROL / size) if size > 0.0 else 0.0, [levels[0]]
    for row in levels[1:]:
        found.append(kept * found[-1] + (1.0 - kept) * row)
    return np.array(found)


ENGINE_EFFECTS: dict[str, EngineEffect] = {
    "payload at the tip": EngineEffect(("payload",), 0.005, "kg", model=_payload),
    "gravity tilted": EngineEffect(("base_tilt",), 0.05, "rad", model=_tilt),
    "joint frictionloss": EngineEffect(("coulomb_friction",), 0.001, "rad", model=_friction),
    "soft tendons": EngineEffect(("cable_compliance",), 1e-4, "m/N", model=_soft_cables),
    "site moved": EngineEffect(("marker_offset",), 2e-3, "m", model=_moved_marker),
    "softer base": EngineEffect(("stiffness_gradient",), 0.3, "-", model=_softer_base),
    "gain of one actuator": EngineEffect(("cable_gain",), 0.1, "-", model=_one_gain),
    "actuators of first order": EngineEffect(("actuator_lag",), 0.05, "s", command=_lag),
    "late camera": EngineEffect(("clock_offset",), 0.03, "s", seen=lambda size: size),
}
"""By name; which mechanism of the library each is."""


class _Section(NamedTuple):
    """A joint in the middle of a piece of the body, and the link from there to the next.

    Attributes:
        at: height of the joint [m].
        stretch, shear: [N/m]; bend: about x and y, twist: [N m].
        mass: of the link [kg]; centre: of it above the joint [m]; turn: moments of inertia about that [kg m2].
    """

    at: float
    stretch: float
    shear: float
    bend: tuple[float, float]
    twist: float
    mass: float
    centre: float
    turn: tuple[float, float, float]


def arm_xml(
    robot: Robot, values: Mapping[str, float], links: int = LINKS, step: float = STEP, cable_stiffness: float = CABLE
) -> str:
    """MJCF of a robot with a body of layers, a channel for each cable, and markers on its axis. Actuators take
    displacements.

    Args:
        robot: its file.
        values: ``young_modulus`` [Pa], ``trunk_mass`` [kg] and ``rayleigh_stiffness`` [s].
        links: pieces of the body.
        step: of time [s].
        cable_stiffness: of a cable with its servo [N/m].
    """
    root = ElementTree.Element("mujoco")
    gravity = " ".join(map(str, robot.gravity_m_s2))
    ElementTree.SubElement(
        root, "option", timestep=str(step), gravity=gravity, integrator="implicitfast", solver="Newton"
    )
    ElementTree.SubElement(root, "size", memory="64M")
    body, low = ElementTree.SubElement(root, "worldbody"), 0.0
    sections = _sections(robot, values, links)
    guides = sorted(_guides(robot), key=lambda each: each[1][2])
    marks = sorted(
        (*((m.name, m.point_m) for m in robot.markers), ("tip", robot.markers[-1].point_m)), key=lambda m: m[1][2]
    )
    for number, section in enumerate([None, *sections]):
        if section is not None:
            body = ElementTree.SubElement(body, "body", name=f"link{number}", pos=f"0 0 {section.at - low:.9g}")
            low = section.at
            _link(body, section, values["rayleigh_stiffness"], mirrored=number % 2 == 0)
        high = sections[number].at if number < len(sections) else np.inf
        for name, (x, y, z) in (*guides, *marks):
            if (low <= z < high) or (section is None and z < high):
                ElementTree.SubElement(body, "site", name=name, pos=f"{x:.9g} {y:.9g} {z - low:.9g}", size="0.001")
    tendons, actuators = ElementTree.SubElement(root, "tendon"), ElementTree.SubElement(root, "actuator")
    for cable, least, most in zip(robot.cables, *robot.command_limits(), strict=True):
        path = ElementTree.SubElement(tendons, "spatial", name=cable.name)
        for k in range(1 + len(cable.guide_z_m)):
            ElementTree.SubElement(path, "site", site=f"{cable.name}{k}")
        rest = float(np.linalg.norm(np.diff(_path(cable), axis=0), axis=1).sum())
        # The tension is the stiffness times (displacement + length - length at rest), and not below zero. A
        # transmission of -1 turns the length's sign.
        ElementTree.SubElement(
            actuators,
            "general",
            name=cable.name,
            tendon=cable.name,
            gear="-1",
            gainprm=f"{cable_stiffness}",
            biastype="affine",
            biasprm=f"{-cable_stiffness * rest:.12g} {-cable_stiffness} {-CABLE_DAMPING}",
            forcelimited="true",
            forcerange="0 1e5",
            ctrllimited="true",
            ctrlrange=f"{least:.9g} {most:.9g}",
        )
    return ElementTree.tostring(root, encoding="unicode")


def write_arm(path: Path, xml: str, effects: Mapping[str, float]) -> None:
    """Write an arm with effects in it.

    Args:
        path: of the MJCF file.
        xml: of `arm_xml`.
        effects: sizes of some of `ENGINE_EFFECTS` that change the model.

    Raises:
        InputError: MuJoCo is not installed.
    """
    mujoco = engine()
    model = mujoco.MjModel.from_xml_string(xml)
    for name, size in effects.items():
        change = ENGINE_EFFECTS[name].model
        assert change is not None, f"{name} is no property of the model"
        change(model, size)
    mujoco.mj_saveLastXML(str(path), model)


def engine() -> Any:
    """The module of MuJoCo.

    Raises:
        InputError: it is not installed.
    """
    try:
        import mujoco
    except ImportError:
        remedy = 'install it: pip install "rfdropo_bayes[mujoco]"'
        raise InputError("MuJoCo is not installed", where="an arm that it moves", remedy=remedy) from None
    return mujoco


def integral(robot: Robot, table: Any, low: float, high: float) -> float:
    """Of a profile of the robot's body between two heights [m]; it is uniform in each layer, and none lies outside."""
    station = np.asarray(robot.body.station_m)
    total = np.concatenate([[0.0], np.cumsum(np.asarray(table) * np.diff(station))])
    return float(np.interp(high, station, total) - np.interp(low, station, total))


def _sections(robot: Robot, values: Mapping[str, float], links: int) -> list[_Section]:
    """Joints and links from base to tip."""
    shape, modulus = robot.body, values["young_modulus"]
    station = np.asarray(shape.station_m)
    length, within = station[-1] / links, partial(integral, robot)

    def spring(own: float, table: Any, at: float) -> float:
        """Of the piece with this middle: its parts yield one after the other."""
        return own / within(1.0 / np.asarray(table), at - 0.5 * length, at + 0.5 * length)

    moment, area = np.asarray(shape.bending_moment_area_m4), shape.axial_area_m2
    shear = modulus / (2.0 * (1.0 + POISSON))
    density = values["trunk_mass"] / within(shape.mass_area_m2, 0.0, station[-1])
    found = []
    for k in range(links):
        at = (k + 0.5) * length
        # The layer's plane x bends by forces along x, that is about y.
        bends = [spring(modulus, moment[:, axis], at) for axis in (1, 0)]
        rest = (bends[0], bends[1]), spring(shear, shape.torsion_constant_m4, at)
        springs = (spring(modulus, area, at), spring(SHEARED * shear, area, at), *rest)
        found.append(_Section(at, *springs, *_inertia(within, robot, density, at, length)))
    return found


def _inertia(
    within: Callable[[Any, float, float], float], robot: Robot, density: float, at: float, length: float
) -> tuple[float, float, tuple[float, float, float]]:
    """Mass [kg] of the link that begins at a joint, its centre above it [m] and its moments of inertia [kg m2]."""
    shape = robot.body
    middle, end = at + 0.5 * length, min(at + length, shape.station_m[-1])
    halves = np.array([density * within(shape.mass_area_m2, *part) for part in ((at, middle), (middle, end))])
    mass, extent = float(np.sum(halves)), end - at
    moments = np.asarray(shape.mass_moment_area_m4)
    by_x, by_y = (density * within(moments[:, axis], at, end) for axis in (0, 1))
    along = mass * extent**2 / 12.0
    centre = float(length * (halves @ np.array([0.25, 0.75])) / mass)
    return mass, centre, (by_y + along, by_x + along, by_x + by_y)


def _link(body: Any, section: _Section, damping: float, mirrored: bool) -> None:
    """Joints and inertia of a link; ``mirrored`` are joints in the order from tip to base.

    A link that bends about one axis before the other is turned about the third, and one that is compressed along the
    link below is moved sideways. Where every other link is mirrored, both are of second order in their length.
    """
    kinds = (
        ("slide", "0 0 1", section.stretch),
        ("slide", "1 0 0", section.shear),
        ("slide", "0 1 0", section.shear),
        ("hinge", "1 0 0", section.bend[0]),
        ("hinge", "0 1 0", section.bend[1]),
        ("hinge", "0 0 1", section.twist),
    )
    for kind, axis, stiffness in reversed(kinds) if mirrored else kinds:
        given = {"type": kind, "axis": axis, "stiffness": f"{stiffness:.9g}", "damping": f"{damping * stiffness:.9g}"}
        ElementTree.SubElement(body, "joint", given)
    about = {"mass": f"{section.mass:.9g}", "diaginertia": " ".join(f"{part:.9g}" for part in section.turn)}
    ElementTree.SubElement(body, "inertial", {"pos": f"0 0 {section.centre:.9g}", **about})


def _guides(robot: Robot) -> list[tuple[str, tuple[float, float, float]]]:
    """Names and places of anchors and guides of all cables."""
    return [(f"{cable.name}{k}", place) for cable in robot.cables for k, place in enumerate(_path(cable))]


def _path(cable: Cable) -> list[tuple[float, float, float]]:
    """Places of a cable's anchor and guides [m]."""
    turn = np.deg2rad(cable.azimuth_deg)
    heights = (cable.anchor_z_m, *cable.guide_z_m)
    radii = (cable.anchor_radius_m, *cable.guide_radius_m)
    return [(r * np.cos(turn), r * np.sin(turn), z) for r, z in zip(radii, heights, strict=True)]


@dataclass(frozen=True)
class EngineArm(ABC):
    """The robot in another engine with an effect, as it is recorded.

    Attributes:
        robot: its file.
        values: of its parameters, by name.
        effect: None for nothing.
    """

    robot: Robot
    values: Mapping[str, float]
    effect: EngineEffect | None = None
    _seen: dict[Any, np.ndarray] = field(default_factory=dict, repr=False, compare=False, kw_only=True)

    def positions(self, recordings: Sequence[Trajectory], size: float) -> Float[np.ndarray, "recording time marker 3"]:
        """Noise-free positions [m] of recordings of one length under their commands, for a size of the effect.

        Raises:
            InputError: the engine is not installed, or does not hold the motion.
        """
        found = []
        for recording in recordings:
            key = (recording.command.tobytes(), recording.time.tobytes(), size)
            if key not in self._seen:
                self._seen[key] = self._recorded(recording, size)
            found.append(self._seen[key])
        return np.stack(found)

    @abstractmethod
    def _recorded(self, recording: Trajectory, size: float) -> Float[np.ndarray, "time marker 3"]:
        """Positions of one recording."""


@dataclass(frozen=True)
class MuJoCoArm(EngineArm):
    """The robot in MuJoCo; values, links, step, a part of `CONTROL`, and stiffness are those of `arm_xml`. It starts
    undeformed, or ``settled`` at rest under its first command.
    """

    links: int = LINKS
    step: float = STEP
    cable_stiffness: float = CABLE
    settled: bool = False

    def _recorded(self, recording: Trajectory, size: float) -> Float[np.ndarray, "time marker 3"]:
        mujoco = engine()
        model = mujoco.MjModel.from_xml_string(
            arm_xml(self.robot, self.values, self.links, self.step, self.cable_stiffness)
        )
        effect = self.effect
        if effect is not None and effect.model is not None:
            effect.model(model, size)
        data = mujoco.MjData(model)
        clock, held = commanded(self.robot, recording, effect, size)
        markers = [model.site(name).id for name in self.robot.marker_names]
        path = np.empty((len(clock), len(markers), 3))
        data.ctrl[:] = held[0]
        for _ in range(round(20 * LONGEST) if self.settled else 0):
            mujoco.mj_kinematics(model, data)
            before = data.site_xpos[markers].copy()
            mujoco.mj_step(model, data, nstep=round(0.05 / self.step))
            if np.abs(data.site_xpos[markers] - before).max() < STILL:
                break
        else:
            if self.settled:
                raise InputError(f"no rest within {LONGEST:g} s", where=recording.name, remedy="damp the arm more")
        for row, level in enumerate(held):
            mujoco.mj_kinematics(model, data)
            path[row] = data.site_xpos[markers]
            data.ctrl[:] = level
            mujoco.mj_step(model, data, nstep=round(CONTROL / self.step))
        if any(warning.number for warning in data.warning) or not np.isfinite(path).all():
            raise InputError("MuJoCo warns of the motion", where=recording.name, remedy="make the effect smaller")
        return seen_at(recording, clock, path, effect, size)


def commanded(
    robot: Robot, recording: Trajectory, effect: EngineEffect | None, size: float
) -> tuple[Float[np.ndarray, " period"], Float[np.ndarray, "period channel"]]:
    """When control periods begin, from the first row on [s], and the cable displacements [m] that are held for them.

    A command held at the value of its period's start would come half a period late; the value of its middle is held.
    """
    clock = np.arange(0.0, recording.time[-1] - recording.time[0] + 0.5 * CONTROL, CONTROL)
    grid = commands_on_grid(
        recording.command_time,
        recording.command,
        recording.initial_command,
        recording.time[0] + clock,
        time_step=CONTROL,
        ramp=robot.command.ramp_s,
        dead_time=robot.command.dead_time_s,
    )
    levels = np.concatenate([grid.initial[None], grid.step])[-len(clock) :]
    if effect is not None and effect.command is not None:
        levels = effect.command(levels, size)
    return clock, 0.5 * (levels + np.concatenate([levels[1:], levels[-1:]]))


def seen_at(
    recording: Trajectory,
    clock: Float[np.ndarray, " period"],
    path: Float[np.ndarray, "period marker 3"],
    effect: EngineEffect | None,
    size: float,
) -> Float[np.ndarray, "time marker 3"]:
    """Markers [m] at the rows of a recording."""
    late = 0.0 if effect is None or effect.seen is None else effect.seen(size)
    at = np.clip(recording.time - recording.time[0] - late, 0.0, None)
    seen = np.stack([np.interp(at, clock, column) for column in path.reshape(len(clock), -1).T], axis=1)
    return seen.reshape(len(at), *path.shape[1:])
