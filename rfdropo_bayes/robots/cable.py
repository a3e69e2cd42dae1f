"""Cables through guide points, and the channels that command them.

Chambers under pressure along part of the body, beside its axis. Motors that wind the cables: from length to counts,
from torque to tension, and the limits of a motor.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from rfdropo_bayes.robots.parameter import Name, Pair, Positive, RobotTable

_LEAST_LIMIT = 10.0  # [per mille]: drives report and limit torque in whole per mille, a tenth of this limit


class Motor(RobotTable):
    """The drive of one command channel: a motor with encoder, gear and drum, and its limits.

    Lengths are cable wound up by the drum [m], pull > 0, from the zero of homing. Counts rise with the length if
    ``sign`` is +1.
    """

    channel: Name = Field(description="command channel of the motor")
    node: int = Field(ge=1, le=127, description="CANopen node of the drive")
    axis: int = Field(default=1, ge=1, le=8, description="axis of the node, for drives of several motors")
    sign: int = Field(description="+1 if counts rise as the cable is pulled, else -1")
    drum_radius_m: Positive = Field(description="radius at which the cable is wound")
    gear: Positive = Field(description="turns of the motor per turn of the drum")
    counts_per_turn: Positive = Field(description="counts of the encoder per turn of the motor")
    offset_counts: int = Field(default=0, description="counts at length zero, used before the first homing")
    rated_torque_n_m: Positive = Field(description="torque of the motor that the drive reports as 1000 per mille")
    length_limit_m: Pair = Field(description="least and greatest length of cable wound up")
    rate_limit_m_s: Positive = Field(description="greatest rate of the set-points")
    acceleration_limit_m_s2: Positive = Field(description="greatest acceleration of the set-points")
    tension_limit_n: Pair = Field(description="least tension to hold, and the greatest, at which everything stops")
    homing_tension_n: Positive = Field(description="tension at which homing sets length zero")

    @model_validator(mode="after")
    def _consistent(self) -> Motor:
        if self.sign not in (-1, 1):
            raise ValueError(f"sign of {self.channel} is {self.sign}, neither 1 nor -1")
        low, high = self.length_limit_m
        if not low < high:
            raise ValueError(f"length_limit_m of {self.channel} is empty")
        if not 0.0 <= self.tension_limit_n[0] < self.tension_limit_n[1]:
            raise ValueError(f"tension_limit_n of {self.channel} is not 0 <= least < greatest")
        if not self.tension_limit_n[0] <= self.homing_tension_n <= self.tension_limit_n[1]:
            raise ValueError(f"homing_tension_n of {self.channel} is outside its tension_limit_n")
        if self.per_mille(self.tension_limit_n[1]) > 5000:
            raise ValueError(f"the greatest tension of {self.channel} is more than five times the rated torque")
        if self.per_mille(self.tension_limit_n[1]) < _LEAST_LIMIT:
            raise ValueError(
                f"the greatest tension of {self.channel} is {self.per_mille(self.tension_limit_n[1]):.2g} per mille of "
                "the rated torque: write rated_torque_n_m in N m (drives state it in mN m or uN m)"
            )
        if max(abs(low), abs(high)) * self.counts_per_metre > 2**30:
            raise ValueError(f"length_limit_m of {self.channel} does not fit into 32-bit counts")
        return self

    @property
    def place(self) -> tuple[int, int]:
        """Node and axis."""
        return self.node, self.axis

    @property
    def counts_per_metre(self) -> float:
        """Counts of the encoder per metre of cable, without sign."""
        return self.gear * self.counts_per_turn / (2.0 * math.pi * self.drum_radius_m)

    def counts(self, length: float, offset: float) -> int:
        """Counts at a length [m]: sign x length / (2 pi r) x gear x counts per turn + offset."""
        return round(self.sign * length * self.counts_per_metre + offset)

    def length(self, counts: float, offset: float) -> float:
        """Length [m] at some counts."""
        return self.sign * (counts - offset) / self.counts_per_metre

    def angle(self, length: float) -> float:
        """Angle of the drum [rad] at a length [m]."""
        return length / self.drum_radius_m

    def tension(self, per_mille: float) -> float:
        """Cable tension [N] at a torque in per mille of the rated one; friction in motor and gear is left out."""
        return self.sign * per_mille * 1e-3 * self.rated_torque_n_m * self.gear / self.drum_radius_m

    def per_mille(self, tension: float) -> float:
        """Torque in per mille of the rated one, without sign, that holds a tension [N]."""
        return tension * self.drum_radius_m / (self.gear * self.rated_torque_n_m) * 1e3


class Chamber(RobotTable):
    """A chamber parallel to the axis: pressure times area is a force that follows the body.

    Between its ends the sections carry this force at the chamber's distance from the axis: a thrust along the axis and
    a moment.
    """

    name: Name = Field(description="unique among the robot's cables and chambers")
    azimuth_deg: float = Field(description="azimuth of the chamber, from +x towards +y")
    radius_m: float = Field(ge=0.0, description="distance of the chamber's middle line from the axis")
    z_m: Pair = Field(description="axial coordinates of the chamber's two ends in the undeformed body")
    area_m2: Positive = Field(description="area across the axis on which the pressure acts")
    pressure_limit_pa: Pair = Field(
        description="least and greatest pressure above the surroundings; commands beyond are held at the limit"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Chamber:
        if self.z_m[0] >= self.z_m[1]:
            raise ValueError(f"z_m of {self.name} does not begin with the end towards the base")
        low, high = self.pressure_limit_pa
        if not low <= 0.0 <= high or low == high:
            raise ValueError(f"pressure_limit_pa of {self.name} does not enclose zero")
        return self

    @property
    def unit(self) -> str:
        """Unit of its drive: a pressure."""
        return "Pa"

    @property
    def limit(self) -> Pair:
        """Least and greatest pressure [Pa]."""
        return self.pressure_limit_pa

    @property
    def end_m(self) -> float:
        """Axial coordinate of the end towards the tip in the undeformed body."""
        return self.z_m[1]

    def turned(self, angle: float) -> Chamber:
        """The chamber turned about +z [deg]."""
        return self.model_copy(update={"azimuth_deg": self.azimuth_deg + angle})

    def middle(self) -> Float[np.ndarray, "2"]:
        """Place of the chamber's middle line across the axis [m]."""
        angle = np.deg2rad(self.azimuth_deg)
        return self.radius_m * np.array([np.cos(angle), np.sin(angle)])

    def ends(self) -> Float[np.ndarray, "2 3"]:
        """Middle of the chamber's two ends in the undeformed body [m]."""
        return np.column_stack([np.tile(self.middle(), (2, 1)), self.z_m])


LIMITS = {"displacement": "displacement_limit_m", "tension": "tension_limit_n"}
UNITS = {"displacement": "m", "tension": "N"}


class Cable(RobotTable):
    """A cable that runs at one azimuth, parallel to the axis or tapering towards it.

    It starts at the anchor, a point fixed to the base, and passes the guides to its end at the last guide.
    """

    name: Name = Field(description="unique among the robot's cables and chambers")
    azimuth_deg: float = Field(description="azimuth of the cable, from +x towards +y")
    anchor_z_m: float = Field(description="axial coordinate of the anchor, a point fixed to the base")
    anchor_radius_m: Positive = Field(description="distance of the anchor from the axis")
    anchor_azimuth_deg: float | None = Field(
        default=None, description="azimuth of the anchor, if different from the cable's"
    )
    guide_z_m: tuple[float, ...] = Field(
        min_length=1, description="axial coordinates of the guides in the undeformed body; the cable ends at the last"
    )
    guide_radius_m: tuple[Positive, ...] = Field(description="distance of each guide from the axis")
    drive: Literal["displacement", "tension"] = Field(
        default="displacement",
        description='"displacement": the drive winds in a length; "tension": the drive holds a force at any length',
    )
    displacement_limit_m: Pair | None = Field(
        default=None,
        description="least and greatest displacement, pull > 0, to which commands are clipped; only for cables "
        "driven by displacement",
    )
    tension_limit_n: Pair | None = Field(
        default=None,
        description="least and greatest tension, to which commands are clipped; only for cables driven by tension",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Cable:
        if len(self.guide_radius_m) != len(self.guide_z_m):
            raise ValueError(f"{len(self.guide_radius_m)} guide radii for {len(self.guide_z_m)} guides of {self.name}")
        if np.any(np.diff(np.r_[self.anchor_z_m, self.guide_z_m]) <= 0):
            raise ValueError(f"anchor and guides of {self.name} do not follow each other along z")
        for drive, key in LIMITS.items():
            if (getattr(self, key) is None) != (drive != self.drive):
                raise ValueError(f"{self.name} is driven by a {self.drive}: it has {LIMITS[self.drive]} alone")
        low, high = self.limit
        if not low <= 0.0 <= high or low == high:
            raise ValueError(f"{LIMITS[self.drive]} of {self.name} does not enclose zero")
        if self.drive == "tension" and low < 0.0:
            raise ValueError(f"tension_limit_n of {self.name} lets a cable push")
        return self

    @property
    def unit(self) -> str:
        """Unit of its drive: a displacement or a tension."""
        return UNITS[self.drive]

    @property
    def limit(self) -> Pair:
        """Least and greatest drive of the cable [m or N]."""
        given = getattr(self, LIMITS[self.drive])
        assert given is not None
        return given

    @property
    def end_m(self) -> float:
        """Axial coordinate of the cable's end in the undeformed body."""
        return self.guide_z_m[-1]

    def turned(self, angle: float) -> Cable:
        """The cable turned about +z [deg]."""
        anchor = self.anchor_azimuth_deg
        changes = {"azimuth_deg": self.azimuth_deg + angle}
        changes |= {} if anchor is None else {"anchor_azimuth_deg": anchor + angle}
        return self.model_copy(update=changes)

    def anchor(self) -> Float[np.ndarray, "3"]:
        """Point at which the cable leaves the base [m]."""
        azimuth = self.azimuth_deg if self.anchor_azimuth_deg is None else self.anchor_azimuth_deg
        return _points(azimuth, self.anchor_radius_m, self.anchor_z_m)[0]

    def guides(self) -> Float[np.ndarray, "guide 3"]:
        """Guide points in the undeformed body [m], the cable ends at the last."""
        return _points(self.azimuth_deg, self.guide_radius_m, self.guide_z_m)


def _points(azimuth: float, radius: float | tuple[float, ...], z: float | tuple[float, ...]) -> np.ndarray:
    """Points (n, 3) at an azimuth [deg]."""
    angle, distance = np.deg2rad(azimuth), np.atleast_1d(radius)
    return np.stack([distance * np.cos(angle), distance * np.sin(angle), np.atleast_1d(z)], axis=1)


class Channels(RobotTable):
    """Map from commands to the drives of cables and chambers: ``radius * gain @ command``."""

    names: tuple[Name, ...] = Field(
        min_length=1, description="the command channels, in the order of the columns of gain"
    )
    gain: tuple[tuple[float, ...], ...] = Field(
        description="one row per cable, then per chamber, one column per channel: displacement [m], tension [N] or "
        "pressure [Pa] = gain @ command, times the radius if commands are angles; pull > 0"
    )
    radius_parameter: Name | None = Field(
        default=None,
        description="parameter [m] that turns an angle [rad] into a length; absent if commands are lengths",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Channels:
        if any(len(row) != len(self.names) for row in self.gain):
            raise ValueError(f"a row of gain does not have one entry for each of the {len(self.names)} channels")
        if np.any(np.all(np.array(self.gain) == 0, axis=0)):
            raise ValueError("a channel drives nothing")
        return self
