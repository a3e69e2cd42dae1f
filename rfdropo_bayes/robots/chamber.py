"""Chambers under pressure along part of the body, beside its axis."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from rfdropo_bayes.robots.table import Name, Pair, Positive, RobotTable


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
