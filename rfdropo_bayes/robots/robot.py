"""A robot: body, mount, cables, commands, markers, parameters and, for pushing, an object on a plate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from rfdropo_bayes.robots.body import Body
from rfdropo_bayes.robots.cable import Cable, Channels
from rfdropo_bayes.robots.parameter import Parameter
from rfdropo_bayes.robots.table import Name, Positive, Table, Vector
from rfdropo_bayes.tables import nearest

REQUIRED = (
    "young_modulus",
    "poisson_ratio",
    "trunk_mass",
    "rayleigh_mass",
    "rayleigh_stiffness",
    "initial_displacement",
    "offset_x",
    "offset_y",
    "offset_z",
)
"""Parameters every robot has."""


class Command(Table):
    """Timing of commands.

    Attributes:
        unit: of the recorded commands: "m" of cable, or "rad" of a motor.
        ramp_s: a change of command is carried out linearly over this time.
        dead_time_s: a command starts to act so much later than it was given.
    """

    unit: Literal["m", "rad"]
    ramp_s: float = Field(ge=0.0)
    dead_time_s: float = Field(ge=0.0)


class Marker(Table):
    """A measured point of the body, given where it lies in the undeformed body."""

    name: Name
    point_m: Vector


OBJECT = ("cube_mass", "friction", "cube_side", "cube_x", "cube_y", "cube_z", "cube_yaw")
"""Parameters of a cube on a plate."""


class PushScene(Table):
    """A cube on a plate across gravity, for pushing.

    Attributes:
        plate_height_m: coordinate of the plate's top against gravity.
        contact_distance_m: distance that surfaces keep from each other.
        parameters: mass [kg], Coulomb friction, edge [m], and the pose at the start: centre [m] and turn about the
            vertical [rad] from where the edges are parallel to the axes.
    """

    plate_height_m: float
    contact_distance_m: float = Field(ge=0.0)
    parameters: dict[Name, Parameter]

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


class Robot(Table):
    """A soft robot, in the frame of its base: z along the body, away from the clamp; SI units.

    Attributes:
        name: name of the robot and of its file.
        description: one line.
        gravity_m_s2: in the frame of the base.
        time_step_s: of the simulation.
        initial_state: "rest" starts undeformed, "equilibrium" in the static equilibrium of the first command.
        command, channels, cables: from recorded commands to cable displacements.
        body: geometry and section profile.
        markers: measured points.
        push: object and plate, if the robot has one.
        parameters: physical parameters with bounds and default priors.
    """

    name: Name
    description: str
    gravity_m_s2: Vector
    time_step_s: Positive
    initial_state: Literal["rest", "equilibrium"]
    command: Command
    channels: Channels
    cables: tuple[Cable, ...] = Field(min_length=1)
    body: Body
    markers: tuple[Marker, ...] = Field(min_length=1)
    push: PushScene | None = None
    parameters: dict[Name, Parameter]

    @model_validator(mode="after")
    def _consistent(self) -> Robot:
        for kind, names in (("cable", self.cable_names), ("marker", self.marker_names)):
            if len(set(names)) != len(names):
                raise ValueError(f"two of its {kind}s share a name")
        if len(self.channels.gain) != len(self.cables):
            raise ValueError(f"channels.gain has {len(self.channels.gain)} rows for {len(self.cables)} cables")
        if (self.command.unit == "rad") != (self.channels.radius_parameter is not None):
            raise ValueError("channels.radius_parameter is needed for commands in rad, and only for those")
        masses = [mass.parameter for mass in self.body.point_masses]
        radius = [self.channels.radius_parameter] if self.channels.radius_parameter else []
        used = {*REQUIRED, *masses, *radius}
        for name, parameter in self.parameters.items():
            if name not in used:
                raise ValueError(f"nothing uses the table [parameters.{name}]; {nearest(name, used)}")
            if (parameter.each == "cable") != (name == "initial_displacement"):
                raise ValueError(f'each = "cable" belongs to initial_displacement alone; mend [parameters.{name}]')
        for name in sorted(used):
            if name not in self.parameters:
                raise ValueError(f"the parameter {name!r} has no table [parameters.{name}]")
        if self.parameters["poisson_ratio"].high > 0.499:
            raise ValueError("poisson_ratio may not exceed 0.499, where the material is incompressible")
        if self.parameters["trunk_mass"].low <= 0 or any(self.parameters[name].low < 0 for name in masses):
            raise ValueError("the bounds of a mass let it be negative, or the trunk massless")
        self._check_inside()
        return self

    def _check_inside(self) -> None:
        station = np.array(self.body.station_m)
        half = np.array(self.body.half_width_m)
        points = {f"guide of {cable.name}": cable.guides() for cable in self.cables}
        points |= {f"marker {marker.name}": np.array([marker.point_m]) for marker in self.markers}
        for name, place in points.items():
            width = np.stack([np.interp(place[:, 2], station, half[:, axis]) for axis in (0, 1)], axis=1)
            outside = (place[:, 2] < station[0] - 1e-9) | (place[:, 2] > station[-1] + 1e-9)
            if np.any(outside) or np.any(np.abs(place[:, :2]) > width + 1e-9):
                raise ValueError(f"a {name} lies outside the body")

    def without_command_timing(self) -> Robot:
        """The same robot, carrying every command out at once: no ramp, no dead time."""
        return self.model_copy(update={"command": Command(unit=self.command.unit, ramp_s=0.0, dead_time_s=0.0)})

    @property
    def gravity(self) -> Float[np.ndarray, "3"]:
        """Gravity in the frame of the base [m/s2]."""
        return np.array(self.gravity_m_s2)

    @property
    def command_unit(self) -> str:
        """Unit of the recorded commands, "m" or "rad"."""
        return self.command.unit

    @property
    def cable_names(self) -> tuple[str, ...]:
        """Names of the cables."""
        return tuple(cable.name for cable in self.cables)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the command channels."""
        return self.channels.names

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Names of the markers."""
        return tuple(marker.name for marker in self.markers)

    def layered_arrays(self) -> dict[str, np.ndarray | int | bool]:
        """The fields of the finite-element engine's layered body: ``LayeredBody(**robot.layered_arrays())``."""
        return self.body.arrays()

    def marker_points(self) -> Float[np.ndarray, "marker 3"]:
        """Markers in the undeformed body [m]."""
        return np.array([marker.point_m for marker in self.markers])

    def anchors(self) -> Float[np.ndarray, "cable 3"]:
        """Points fixed to the base where the cables start [m]."""
        return np.stack([cable.anchor() for cable in self.cables])

    def guides(self) -> list[Float[np.ndarray, "guide 3"]]:
        """Guide points of each cable in the undeformed body [m]; cables may have different numbers of them."""
        return [cable.guides() for cable in self.cables]

    def displacement_limits(self) -> Float[np.ndarray, "cable 2"]:
        """Least and greatest displacement of each cable [m], pull > 0."""
        return np.array([cable.displacement_limit_m for cable in self.cables])

    def channel_matrix(self, parameters: Mapping[str, Any]) -> Any:
        """Matrix (cable, channel) from commands to cable displacements [m], for these parameter values.

        Values may be JAX tracers: the matrix is then one too.
        """
        gain = np.array(self.channels.gain)
        radius = self.channels.radius_parameter
        return gain if radius is None else parameters.get(radius, self.parameters[radius].nominal) * gain

    def parameter_table(self) -> dict[str, Parameter]:
        """Every base parameter by name, with those given per cable written out."""
        table: dict[str, Parameter] = {}
        for name, parameter in self.parameters.items():
            if parameter.each == "cable":
                for cable in self.cable_names:
                    described = f"{parameter.description} (cable {cable})"
                    table[f"{name}_{cable}"] = parameter.model_copy(update={"description": described, "each": None})
            else:
                table[name] = parameter
        return table

    @property
    def initial_displacement_names(self) -> tuple[str, ...]:
        """Parameters that hold the displacement of each cable at zero command, in the order of the cables."""
        return tuple(f"initial_displacement_{cable}" for cable in self.cable_names)

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
