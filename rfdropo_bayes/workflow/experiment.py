"""The experiment file: one TOML that names robot, data, priors, mechanisms, method, budget and seed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rfdropo_bayes.data import DataSpec
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.mesh_body import TetrahedraTable
from rfdropo_bayes.tables import parse_table
from rfdropo_bayes.workflow.experiment_file import override, read_tables


class Table(BaseModel):
    """A table of the experiment file: unknown keys are errors, values do not change once read."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class WeighedTable(Table):
    """[[model.weighed]]: the sum of ``parameters`` was measured as ``value`` +- ``sd``, in their unit."""

    parameters: list[str] = Field(min_length=1)
    value: float
    sd: float = Field(gt=0.0)


class ModelTable(Table):
    """[model]: what is added to the robot's base simulator, and what is inferred.

    ``priors`` maps parameter names to prior tables (``{}`` asks for the default prior); ``fixed`` sets the values of
    parameters that are not inferred; ``per_recording`` frees a parameter in the named recordings (``"all"``, or names
    with wildcards) instead of sharing it. ``groups`` names recordings that have a set-up in common (a day, a robot), by
    names or wildcards; a recording in none is a group of its own. ``per_group`` lets a parameter differ between groups
    about the value they share, with the given standard deviation in its unit (partial pooling). ``tension`` uses the
    recordings' cable tensions as data, with a relative noise ``tension_noise`` that is inferred and a ``tension_gain``
    that is 1 unless it has a prior; ``motor_angle`` uses the motor angles that the robot measured, with a noise
    ``motor_angle_noise`` that is inferred; ``object_pose`` uses the measured poses of the pushed body, which then
    starts at the first of them, with ``object_noise``, ``object_turn_noise`` and ``object_correlation_time``;
    ``weighed`` lists parameters, or sums of them, known from measurements of their own.
    """

    mechanisms: list[str] = Field(default_factory=list)
    noise: Literal["white", "ar1"] = "white"
    priors: dict[str, dict[str, Any]] = Field(default_factory=dict)
    fixed: dict[str, float] = Field(default_factory=dict)
    per_recording: dict[str, str | list[str]] = Field(default_factory=dict)
    groups: dict[str, str | list[str]] = Field(default_factory=dict)
    per_group: dict[str, float] = Field(default_factory=dict)
    tension: bool = False
    motor_angle: bool = False
    object_pose: bool = False
    weighed: list[WeighedTable] = Field(default_factory=list)


class SimulatorTable(Table):
    """[simulator]: body, engine and discretisation; what is left out is the robot's own.

    ``body`` is made of the layers of the robot's section profile (``nodes_across``, ``refine``) or of the mesh that
    ``tetrahedra`` describes. An experiment may describe both; the body that is not chosen has no effect. ``push`` puts
    the robot's cube and plate before the trunk. With ``drives = "direct"`` commands act at once, without the robot's
    ramp and dead time: what the drives do is left to mechanisms such as `command_delay` and `actuator_lag`.
    """

    body: Literal["layered", "tetrahedra"] = "layered"
    push: bool = False
    drives: Literal["robot", "direct"] = "robot"
    tetrahedra: TetrahedraTable | None = None
    engine: Literal["auto", "jax", "numba"] = "auto"
    precision: Literal["float64", "float32"] = "float64"
    time_step: float | None = Field(default=None, gt=0.0, le=0.1)
    nodes_across: Literal[2, 3] = 2
    refine: int = Field(default=1, ge=1, le=16)
    threads: int | None = Field(default=None, ge=1)

    @model_validator(mode="after")
    def _has_mesh(self) -> SimulatorTable:
        if self.body == "tetrahedra" and self.tetrahedra is None:
            raise InputError(
                'body = "tetrahedra" without a mesh',
                where="[simulator]",
                remedy="add a table [simulator.tetrahedra] with mesh, unit and clamp_height",
            )
        return self


class InferenceTable(BaseModel):
    """[inference]: method and budget; the method's own options are checked by the method."""

    model_config = ConfigDict(extra="allow", frozen=True)

    method: str = "smc"
    rollouts: int = Field(default=20000, ge=1)

    @property
    def options(self) -> dict[str, Any]:
        """Options of the method, without the name and the budget."""
        return dict(self.model_extra or {})


class CommandsTable(Table):
    """[commands]: a random command sequence to simulate, where no recording is replayed.

    Every ``interval`` seconds one channel, chosen at random, moves by ``step`` (in the robot's command unit) up or
    down, within ``[low, high]``; every ``sample_time`` seconds the named markers are observed (all, if none is named).
    """

    duration: float = Field(gt=0.0)
    interval: float = Field(gt=0.0)
    step: float = Field(gt=0.0)
    low: float
    high: float
    sample_time: float = Field(gt=0.0)
    recordings: list[str] = Field(min_length=1)
    markers: list[str] = Field(default_factory=list)


class NoiseTable(Table):
    """[noise]: added to simulated marker positions; ``standard_deviation`` in metres per coordinate."""

    standard_deviation: float = Field(ge=0.0)
    correlation_time: float | None = Field(default=None, gt=0.0)


class AuditTable(Table):
    """[audit]: ``candidates`` are tried beside the registry's mechanisms, e.g. ``"mine.py:MyMechanism"``; those in
    ``exclude`` are not. ``bootstraps`` is how many simulated data sets its p-values rest on; ``minutes`` the processor
    time that a candidate may take which only a slower engine knows."""

    candidates: list[str] = Field(default_factory=list)
    exclude: list[str] = Field(default_factory=list)
    bootstraps: int = Field(default=999, ge=199)
    minutes: float = Field(default=10.0, ge=0.0)


class DesignTable(Table):
    """[design]: ``minutes`` that ``rfdropo design`` may take; it then proposes the best of what it has looked at."""

    minutes: float = Field(default=10.0, gt=0.0)


class SeparationTable(Table):
    """[separation]: ``mechanisms`` that join the base model, to see which of them the recordings tell apart; ``groups``
    names sets of them that are asked for together, such as all ways to be late."""

    mechanisms: list[str] = Field(min_length=2)
    groups: dict[str, list[str]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _has_members(self) -> SeparationTable:
        for name, members in self.groups.items():
            for member in members:
                if member not in self.mechanisms:
                    raise InputError(
                        f"{member!r} is none of the mechanisms",
                        where=f"[separation.groups] {name}",
                        remedy=f"use {', '.join(self.mechanisms)}",
                    )
            if name in self.mechanisms or not members:
                raise InputError(
                    f"{name!r} is a mechanism itself" if members else "is empty",
                    where=f"[separation.groups] {name}",
                    remedy="give a group a name of its own, and members",
                )
        return self


class Experiment(Table):
    """An experiment as read from its file; see `load_experiment`."""

    robot: str
    seed: int = 0
    title: str = ""
    data: DataSpec | None = None
    commands: CommandsTable | None = None
    noise: NoiseTable | None = None
    model: ModelTable = Field(default_factory=ModelTable)
    simulator: SimulatorTable = Field(default_factory=SimulatorTable)
    inference: InferenceTable = Field(default_factory=InferenceTable)
    audit: AuditTable = Field(default_factory=AuditTable)
    design: DesignTable = Field(default_factory=DesignTable)
    separation: SeparationTable | None = None


def load_experiment(path: Path, overrides: Sequence[str] = ()) -> tuple[Experiment, dict[str, Any]]:
    """Read an experiment file.

    Args:
        path: the TOML file.
        overrides: assignments that replace entries of the file: ``table.key=value`` (value in TOML syntax), or
            ``name=value`` for the value of a parameter ([model.fixed]; its prior is then dropped).

    Returns:
        the experiment, and its tables as they were read with the overrides in place, for the record.

    Raises:
        InputError: no such file, not TOML, an unknown key or a value of the wrong type.
    """
    tables = read_tables(path)
    for assignment in overrides:
        override(tables, assignment, Experiment.model_fields)
    return parse_table(Experiment, tables, where=str(path)), tables


def matching(names: Sequence[str], patterns: str | Sequence[str], *, where: str) -> list[str]:
    """Recordings that ``"all"``, a name or a wildcard pattern stand for; InputError if one stands for none."""
    from fnmatch import fnmatchcase

    if patterns == "all":
        return list(names)
    chosen: list[str] = []
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        found = [name for name in names if fnmatchcase(name, pattern)]
        if not found:
            raise InputError(f"no recording matches {pattern!r}", where=where, remedy=f"recordings: {', '.join(names)}")
        chosen += [name for name in found if name not in chosen]
    return chosen
