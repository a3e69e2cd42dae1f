"""Cables through guide points, and the channels that command them."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from rfdropo_bayes.robots.table import Name, Pair, Positive, RobotTable

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
