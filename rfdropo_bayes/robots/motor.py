"""Motors that wind the cables: from length to counts, from torque to tension, and the limits of a motor."""

from __future__ import annotations

import math

from pydantic import Field, model_validator

from rfdropo_bayes.robots.table import Name, Pair, Positive, RobotTable

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
