"""Ports by name: places at which a signal may act on a simulated robot, and its action.

A port of actuation or of the body acts on a rollout (`simulators.ports`); one of sensing is a map of the markers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.mechanisms.sensing import direction_along, read_at
from rfdropo_bayes.mechanisms.sizes import USUAL, scales_of
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import BLACK_BOX, BODIES
from rfdropo_bayes.simulators.port_signals import BodySignals, PortSignals

AXES = "xyz"
SIZES = {"m": 1e-3, "rad": 0.05}
"""Size of an effect on a command, by unit."""
FORCE, LENGTH = 5e-3, 5e-3
"""Sizes of a force over the tension that bends the robot by a usual pull, and of a shift over its length."""
SHARE = 0.05
"""Size of an effect in other units, as a share of usual commands."""
EVERY_CABLE, EVERY_ACTUATOR = "every cable", "every actuator"
PLACES = ("base", "middle", "tip")
"""Names of the places that forces may act on, one per place of the engine; see `simulators.engine.LOAD_PLACES`."""


class Port(NamedTuple):
    """A place at which a signal w(t) may act."""

    name: str  # name in files, such as "cable left" or "marker m3 along"
    stage: str  # "actuation", "body" or "sensing"
    kind: str  # kind of place
    number: int  # index within its kind: a channel, a place or a marker; for "cables" the number of cables
    axis: int  # 0 to 2, and 3 along the body; -1 without an axis
    unit: str  # unit of the signal
    size: float  # size of a typical effect: the scale of priors and of differences
    look: str  # check to make at the robot
    spoken: str = ""  # its name in sentences, tables and figures, if it differs from the name in files; see `words`

    @property
    def words(self) -> str:
        """Its name in sentences, tables and figures: a simulator without cables has actuators."""
        return self.spoken or self.name


class PortMap(NamedTuple):
    """The ports of a robot on an engine, and the sum of signals at ports."""

    ports: tuple[Port, ...]  # all of them
    left_out: dict[str, str]  # ports that the body cannot carry, with the reason
    channels: int  # number of commands
    places: int  # number of stations for forces, 0 if none
    gravity: tuple[float, float, float]  # acceleration [m/s2]

    def named(self, name: str) -> Port | None:
        """A port by its name in files or in sentences; None if there is none."""
        return next((port for port in self.ports if name in (port.name, port.words)), None)

    def members(self, port: Port) -> tuple[Port, ...]:
        """The ports at which a law of this port acts: every cable for "cables", each as a function of its command."""
        if port.kind == "cables":
            return tuple(each for each in self.ports if each.kind == "cable")
        return (port,)

    def silent(self, rows: int) -> PortSignals:
        """Signals of zeros."""
        return PortSignals(jnp.zeros((rows, self.channels)), jnp.zeros(rows), self.no_push(rows))

    def no_push(self, rows: int) -> BodySignals | None:
        """Signals of zeros on the body; None if it cannot carry signals."""
        if not self.places:
            return None
        return BodySignals(jnp.zeros((rows, self.places, 3)), *(jnp.zeros(rows),) * 2, jnp.zeros((rows, 3)))

    def signals(self, port: Port, w: Float[Array, " row"]) -> PortSignals:
        """A signal at a port of actuation or of the body, as input of a rollout; None for several members."""
        none = self.silent(len(w))
        if port.kind == "cable":
            return none._replace(command=none.command.at[:, port.number].set(w))
        if port.kind == "delay":
            return none._replace(delay=w)
        assert none.body is not None
        return none._replace(body=self.push(port, w))

    def push(self, port: Port, w: Float[Array, " row"]) -> BodySignals:
        """A signal at a port of the body."""
        none = self.no_push(len(w))
        assert none is not None
        if port.kind == "stiffness":
            return none._replace(stiffness=w)
        if port.kind == "damping":
            return none._replace(damping=w)
        if port.kind == "force":
            return none._replace(force=none.force.at[:, port.number, port.axis].set(w))
        axis = jnp.eye(3)[port.axis]
        return none._replace(gravity=w[:, None] * jnp.cross(axis, jnp.asarray(self.gravity)))


def sensed(
    port: Port, w: Float[Array, " time"], position: Float[Array, "time marker 3"], time: Float[Array, " time"]
) -> Float[Array, "time marker 3"]:
    """Measured positions [m] with a signal at a port of sensing, from positions without the signal."""
    if port.kind == "observation":
        return read_at(position, time, time - w)
    axis, w = jnp.eye(3)[min(max(port.axis, 0), 2)], w[:, None]
    if port.kind == "marker":
        moved = w * (direction_along(position)[:, port.number] if port.axis == 3 else axis)
        return position.at[:, port.number].add(moved)
    if port.kind == "camera":
        return position + w[:, None] * axis
    if port.kind == "turn":
        return position + w[:, None] * jnp.cross(axis, position)
    return position * (1.0 + w[:, None])


def port_map(simulator: Any, markers: Sequence[str]) -> PortMap:
    """The ports of a simulator, for the measured ``markers``.

    A simulator without signal inputs has ports of sensing only.
    """
    left_out: dict[str, str] = {}
    ports: list[Port] = []
    channels = tuple(simulator.channel_names)
    engine, robot = getattr(simulator, "engine", None), getattr(simulator, "robot", None)
    scales = scales_of(robot) if isinstance(robot, Robot) else USUAL
    if robot is None:
        left_out["cables, command delay"] = "the simulator takes no signals"
    else:
        unit = getattr(simulator, "command_unit", "m")
        ports += _of_actuation(channels, unit, robot.usual_command, wound=engine is not None)
    gravity, places = (0.0, 0.0, 0.0), 0
    if engine is not None and robot is not None and engine.carries_loads:
        places = len(engine.load_stations)
        gravity = (float(robot.gravity[0]), float(robot.gravity[1]), float(robot.gravity[2]))
        force = FORCE * scales.force
        ports += [port for port in _of_body(places, gravity, force) if not (engine.at_rest and port.kind == "damping")]
    else:
        body = BLACK_BOX if engine is None else f"a body of {BODIES[1]}, or one before a cube,"
        left_out["forces, stiffness, damping, base tilt"] = f"{body} takes no signals"
    ports += _of_sensing(markers, LENGTH * scales.length)
    return PortMap(tuple(ports), left_out, len(channels), places, gravity)


def _of_actuation(channels: Sequence[str], unit: str, usual: float | None, *, wound: bool) -> list[Port]:
    """Ports of drives that wind cables, or of the commands of your own simulator; metres are cable lengths. Effects
    are scaled by the size of usual commands, if it is known.
    """
    cables, size = wound or unit == "m", SIZES.get(unit, SHARE) if usual is None else SHARE * usual
    look = "guide, spool and tension of cable {0}, and all parts shared with other cables"
    look = look if wound else "the drive of {0}, its load, and all parts shared with other drives"
    ports = []
    for k, name in enumerate(channels):
        words = f"cable {name}" if cables else f"actuator {name}"
        ports.append(Port(f"cable {name}", "actuation", "cable", k, -1, unit, size, look.format(name), words))
    if len(ports) > 1:
        look_at = "all parts shared by drives and cables: gears, spools, guides, and the material of the cables"
        look_at = look_at if wound else "what all drives share"
        words = EVERY_CABLE if cables else EVERY_ACTUATOR
        ports.append(Port(EVERY_CABLE, "actuation", "cables", len(ports), -1, unit, size, look_at, words))
    look = "the way of commands to the drives: queues, buses, and clocks"
    return [*ports, Port("command delay", "actuation", "delay", 0, -1, "s", 0.02, look)]


def _of_body(places: int, gravity: tuple[float, float, float], force: float) -> list[Port]:
    look = "anything that pulls, pushes or touches the body near its {0}"
    ports = [
        Port(f"force {AXES[i]} at the {name}", "body", "force", k, i, "N", force, look.format(name))
        for k, name in enumerate(PLACES[3 - places :] if places <= 3 else PLACES)
        for i in range(3)
    ]
    ports.append(Port("stiffness", "body", "stiffness", 0, -1, "-", 0.1, "warmth, use and age of the body's material"))
    ports.append(Port("damping", "body", "damping", 0, -1, "-", 0.3, "friction or flow in the body and along it"))
    for i in range(3):
        if any(abs(g) > 0.0 for k, g in enumerate(gravity) if k != i):
            ports.append(Port(f"base tilt {AXES[i]}", "body", "tilt", 0, i, "rad", 0.05, "whether the base moves"))
    return ports


def _of_sensing(markers: Sequence[str], length: float) -> list[Port]:
    ports: list[Port] = []
    for k, name in enumerate(markers):
        look = f"whether marker {name} slides, comes loose or is confused with another marker"
        ends = [*enumerate(AXES), (3, "along the body")] if len(markers) > 1 else list(enumerate(AXES))
        ports += [Port(f"marker {name} {way}", "sensing", "marker", k, i, "m", length, look) for i, way in ends]
    look = "whether the cameras move against the base"
    ports += [Port(f"camera {a}", "sensing", "camera", 0, i, "m", length, look) for i, a in enumerate(AXES)]
    ports += [Port(f"camera turn {a}", "sensing", "turn", 0, i, "rad", 0.01, look) for i, a in enumerate(AXES)]
    look = "the cameras' calibration of lengths"
    ports.append(Port("camera scale", "sensing", "scale", 0, -1, "-", 0.01, look))
    look = "the cameras' clock against the drives' clock"
    return [*ports, Port("observation delay", "sensing", "observation", 0, -1, "s", 0.02, look)]
