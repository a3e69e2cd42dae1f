"""The interface of every simulator: parameters and commands in, an observation and a result code out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.tables import nearest as nearest


class ParameterSpec(NamedTuple):
    """One physical parameter of a simulator, of a mechanism or of a noise model.

    Attributes:
        name: name used in experiment files, posteriors and reports.
        unit: SI unit, "-" if it has none.
        low, high: hard bounds, outside which the model has no meaning.
        nominal: value used if the parameter is fixed; a mechanism's null value.
        prior: default prior as a table, e.g. ``{"distribution": "LogNormal", "median": 4.5e6, "sigma": 0.5}``.
        description: one line on its physical meaning.
        grid: values to try, for a mechanism's parameter that has no effect while the others are null (a time constant,
            the place of a wall): its derivative is zero there, so it cannot be screened. Empty for all others.
        family: the quantity of which this is a local value, if a simulator offers it as a candidate of audits; empty
            for all others.
    """

    name: str
    unit: str
    low: float
    high: float
    nominal: float
    prior: Mapping[str, Any]
    description: str
    grid: tuple[float, ...] = ()
    family: str = ""


class Result(IntEnum):
    """Result code of a rollout. Everything but OK is counted and reported, and gets no weight in any inference."""

    OK = 0
    DIVERGED = 1
    CABLE_LIMIT = 2
    CONTACT_NOT_CONVERGED = 3
    NOT_IN_EQUILIBRIUM = 4

    @property
    def remedy(self) -> str:
        """Remedy for the user."""
        return _REMEDIES[self]


_REMEDIES = {
    Result.OK: "",
    Result.DIVERGED: "shorten the time step or narrow the priors of stiffness, mass and damping",
    Result.CABLE_LIMIT: "the cables could not reach their commanded lengths: check limits and initial displacements",
    Result.CONTACT_NOT_CONVERGED: "shorten the time step: the contacts of a step were not solved",
    Result.NOT_IN_EQUILIBRIUM: "the initial pose was not found, or overlaps the cube: check gravity, stiffness, "
    "initial displacements and the cube's position",
}


class Observation(NamedTuple):
    """Observation of a rollout at the observation times, in the frame of the robot's base."""

    position: Float[Array, "time marker 3"]  # marker positions [m]
    tension: Float[Array, "time cable"]  # cable tensions [N]
    # position [m] and unit quaternion (x, y, z, w) of the object; None if the scene has none
    object_pose: Float[Array, "time 7"] | None
    status: Int[Array, ""]  # a `Result` value
    # drive positions: the command after all effects inside the drives, such as delay and lag, before the transmission
    # to the cables, in the unit of the commands [rad or m]; None if unknown
    motor_angle: Float[Array, "time channel"] | None = None
    # largest tension of each cable at the time steps of a session's last control period [N]; None if unknown. In 64
    # pushes of models/policies/push it was up to 3.3 times the tension at the periods' ends.
    peak: Float[Array, " cable"] | None = None
    # orientations of the robot's `orientations`, unit quaternions (x, y, z, w) from the base's axes to the section's;
    # None if unknown
    orientation: Float[Array, "time section 4"] | None = None


@runtime_checkable
class Simulator(Protocol):
    """Anything that turns named parameters and commands into an observation.

    ``rollout`` replays the whole command sequence from the initial state, without resets (RF-DROPO, eq. 2). A batch of
    rollouts is ``jax.vmap`` over the parameters.
    """

    @property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """Every parameter that may be given to ``rollout``; missing parameters take their nominal value."""

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Names of the markers, in the order of ``Observation.position``."""

    @property
    def cable_names(self) -> tuple[str, ...]:
        """Names of the cables, in the order of ``Observation.tension``."""

    @property
    def description(self) -> dict[str, object]:
        """Engine, precision and discretisation, for the record."""

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the command channels, in the order of ``Commands.step``."""

    @property
    def lanes(self) -> int:
        """Preferred number of rollouts per call."""

    def commands(
        self,
        time: Float[np.ndarray, " command"],
        value: Float[np.ndarray, "command channel"],
        initial: Float[np.ndarray, " channel"],
        observation_time: Float[np.ndarray, " time"],
    ) -> Commands:
        """Convert a recorded command sequence to the simulator's own clock (see `commands_on_grid`)."""

    def rollout(
        self, parameters: Mapping[str, Float[Array, ""]], commands: Commands, steps: Int[Array, ""] | None = None
    ) -> Observation:
        """Simulate from the initial state to the last observation, or ``steps`` time steps only (rows beyond hold no
        meaning)."""


def specs_of(table: Mapping[str, Any]) -> tuple[ParameterSpec, ...]:
    """Specifications of the parameters of robots and black boxes (`robots.parameter.Parameter`, by name)."""
    return tuple(
        ParameterSpec(name, p.unit, p.low, p.high, p.nominal, p.prior, p.description) for name, p in table.items()
    )


def check_names(names: Iterable[str], specs: Iterable[ParameterSpec], *, where: str) -> None:
    """Raise InputError for a name that no specification carries."""
    known = {spec.name for spec in specs}
    for name in names:
        if name not in known:
            raise InputError(f"unknown parameter {name!r}", where=where, remedy=nearest(name, known))


def check_value(spec: ParameterSpec, value: float, *, where: str) -> float:
    """Return ``value`` if it lies within the hard bounds of ``spec``; raise InputError otherwise."""
    if not spec.low <= value <= spec.high:
        raise InputError(
            f"{spec.name} = {value:g} {spec.unit} is outside its hard bounds [{spec.low:g}, {spec.high:g}]",
            where=where,
            remedy="give a value inside them",
        )
    return float(value)
