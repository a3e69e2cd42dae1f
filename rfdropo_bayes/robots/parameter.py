"""Physical parameters of a robot: unit, nominal value, hard bounds and a default prior."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from rfdropo_bayes.robots.table import RobotTable
from rfdropo_bayes.tables import nearest

ARGUMENTS = {
    "Normal": ("loc", "scale"),
    "TruncatedNormal": ("loc", "scale"),
    "HalfNormal": ("scale",),
    "LogNormal": ("median", "sigma"),
    "Uniform": ("low", "high"),
    "LogUniform": ("low", "high"),
}
"""Prior distributions (names of numpyro) and their arguments; LogNormal's ``sigma`` is the deviation of the
logarithm.
"""
ENDS = {"TruncatedNormal": ("low", "high")}  # optional arguments: the ends of a truncated normal inside the hard bounds


class Parameter(RobotTable):
    """A physical parameter."""

    unit: str = Field(description='SI unit, "-" if it has none')
    nominal: float = Field(description="value used if the parameter is fixed")
    low: float = Field(description="lower hard bound, below which the model has no meaning")
    high: float = Field(description="upper hard bound")
    prior: dict[str, Any] = Field(
        description='default prior, e.g. { distribution = "LogNormal", median = 4.5e6, sigma = 0.5 }'
    )
    description: str = Field(min_length=1, description="physical meaning in one line")
    each: Literal["cable"] | None = Field(
        default=None, description='"cable" stands for one parameter per cable, named NAME_CABLE'
    )

    @model_validator(mode="after")
    def _consistent(self) -> Parameter:
        if not self.low < self.high:
            raise ValueError(f"low = {self.low:g} is not below high = {self.high:g}")
        if not self.low <= self.nominal <= self.high:
            raise ValueError(f"nominal = {self.nominal:g} is outside its bounds [{self.low:g}, {self.high:g}]")
        _check_prior(self.prior, self.low, self.high)
        return self


def _check_prior(prior: dict[str, Any], low: float, high: float) -> None:
    family = prior.get("distribution")
    if family not in ARGUMENTS:
        raise ValueError(f"unknown distribution {family!r}; {nearest(str(family), ARGUMENTS)}")
    names, given = ARGUMENTS[family], set(prior) - {"distribution"}
    ends = ENDS.get(family, ())
    if given - set(ends) != set(names):
        raise ValueError(f"{family} takes {', '.join(names)}" + (f", perhaps {' and '.join(ends)}" if ends else ""))
    for name in given:
        value = prior[name]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{name} of the prior is not a number")
        if name in ("scale", "sigma", "median") and value <= 0:
            raise ValueError(f"{name} of the prior is not positive")
    if family == "TruncatedNormal" and not prior.get("low", low) < prior.get("high", high):
        raise ValueError("the prior ends before it begins: low is not below high")
    if family in ("Uniform", "LogUniform"):
        inside = low <= prior["low"] < prior["high"] <= high
    else:
        centre = prior.get("loc", prior.get("median", max(low, 0.0)))
        inside = low <= centre <= high
    if not inside:
        raise ValueError(f"the prior lies outside the bounds [{low:g}, {high:g}]")
