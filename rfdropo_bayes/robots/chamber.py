"""Chambers: pressure that pushes two sections of the body apart, along a line beside its axis."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from rfdropo_bayes.robots.table import Name, Pair, Positive, RobotTable

UNIT = "Pa"


class Chamber(RobotTable):
    """A chamber along part of the body: its pressure times its area is a force that follows the body.

    Between its ends the body carries that force, at the chamber's offset from the axis: an axial force and a moment.
    """

    name: Name = Field(description="unique among the robot's cables and chambers")
    azimuth_deg: float = Field(description="where it lies, from +x towards +y")
    radius_m: float = Field(ge=0.0, description="distance of its middle line from the axis")
    z_m: Pair = Field(description="axial coordinates of its ends in the undeformed body")
    area_m2: Positive = Field(description="area that the pressure acts on, across the axis")
    pressure_limit_pa: Pair = Field(description="least and greatest pressure; commands beyond are held at the limit")

    @model_validator(mode="after")
    def _consistent(self) -> Chamber:
        if self.z_m[0] >= self.z_m[1]:
            raise ValueError(f"z_m of {self.name} does not begin at the end towards the base")
        low, high = self.pressure_limit_pa
        if not low <= 0.0 <= high or low == high:
            raise ValueError(f"pressure_limit_pa of {self.name} does not enclose zero")
        return self

    @property
    def unit(self) -> str:
        """Of what drives it."""
        return UNIT

    @property
    def limit(self) -> Pair:
        """Least and greatest pressure [Pa]."""
        return self.pressure_limit_pa

    def line(self, station: Float[np.ndarray, " station"], end: float) -> Float[np.ndarray, "point 3"]:
        """Its middle line from the first of the body's stations to a height, with a point at every station on the
        way."""
        heights = np.append(station[station < end - 1e-9], end)
        angle = np.deg2rad(self.azimuth_deg)
        across = np.tile([self.radius_m * np.cos(angle), self.radius_m * np.sin(angle)], (len(heights), 1))
        return np.column_stack([across, heights])
