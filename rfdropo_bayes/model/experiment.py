"""The experiment file: one TOML that names robot, data, priors, mechanisms, method, budget and seed.

Names and numbers, as the file has them; `model_spec` gives them meaning.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rfdropo_bayes.data import DataSpec
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment_file import override, read_tables
from rfdropo_bayes.policies.training_config import TrainingTable
from rfdropo_bayes.robots import DriveTravel
from rfdropo_bayes.simulators.mesh_body import TetrahedraTable
from rfdropo_bayes.tables import parse_table

NoiseModel = Literal["auto", "white", "ar1", "student-t", "repeats", "stated"]


class ExperimentTable(BaseModel):
    """A table of the experiment file: unknown keys are errors, values do not change once read."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class WeighedTable(ExperimentTable):
    """[[model.weighed]]: parts that were weighed, or other sums of parameters that were measured."""

    parameters: list[str] = Field(
        min_length=1, description="parameters whose sum was measured; payload_mass@NAME belongs to the recording NAME"
    )
    value: float = Field(description="measured sum, in the unit of the parameters")
    sd: float = Field(gt=0.0, description="standard deviation of the measurement")


class LawTermTable(ExperimentTable):
    """A term of [[model.laws]]: a coefficient times a feature."""

    coefficient: str = Field(description="name of the parameter; zero has no effect")
    feature: str = Field(description="kind of the feature, see docs/mechanisms.md")
    commands: list[str] = Field(default_factory=list, description="commands of the feature")
    motion: list[str] = Field(
        default_factory=list,
        description="motion of the body in place of commands, at ports of the body: tip x, tip y, tip z or tip "
        "distance, from the first position of the last marker",
    )
    shape: float | None = Field(
        default=None, gt=0.0, description="time constant [s] of a low pass or lag, or half the width of a play"
    )
    shape_parameter: str | None = Field(
        default=None,
        description="name of a parameter that is inferred in place of shape; its default prior is normal, "
        "with mean shape and standard deviation shape / 2",
    )
    scale: float = Field(gt=0.0, description="scale of the coefficient's default prior, a normal about zero")


class LawTable(ExperimentTable):
    """[[model.laws]]: an effect that no mechanism of the library has, as a law at a port."""

    port: str = Field(
        description='port at which the law acts, such as "cable left", "stiffness" or "marker m3 along the body"'
    )
    terms: list[LawTermTable] = Field(min_length=1, description="terms, whose sum is the signal")


class ModelTable(ExperimentTable):
    """[model]: additions to the robot's base simulator, and inferred parameters."""

    mechanisms: list[str] = Field(
        default_factory=list,
        description="effects on top of the base simulator, by name, or file.py:ClassName of your own",
    )
    laws: list[LawTable] = Field(
        default_factory=list, description="effects without a name: laws at ports, as found by an audit"
    )
    noise: NoiseModel = Field(
        default="auto",
        description='noise of the positions: "auto" (white and correlated), "white", "ar1" (correlated), "student-t" '
        '(heavy-tailed), "repeats" (the spread between repeats, for all channels), "stated" (the values of [noise]); '
        "see docs/likelihood.md",
    )
    priors: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="inferred parameters: parameter = prior; {} asks for the default prior"
    )
    fixed: dict[str, float] = Field(default_factory=dict, description="values of parameters that are not inferred")
    per_recording: dict[str, str | list[str]] = Field(
        default_factory=dict,
        description='parameters that are free in each of the named recordings instead of shared: "all", or names with'
        " wildcards",
    )
    groups: dict[str, str | list[str]] = Field(
        default_factory=dict,
        description="recordings with a common set-up (a session, a robot), by names or wildcards; a recording in no "
        "group forms its own",
    )
    drives: list[DriveTravel] = Field(
        default_factory=list, description="known properties of the drives, in addition to the robot file"
    )
    per_group: dict[str, float] = Field(
        default_factory=dict,
        description="parameters that differ between groups, with the scale of the half-normal prior of their standard "
        "deviation between groups, in their unit; a name such as initial_displacement stands for the parameters of all "
        "cables, with one standard deviation",
    )
    only_in: dict[str, str | list[str]] = Field(
        default_factory=dict,
        description="parameters of the named groups alone: each of these groups has a value, and all other recordings "
        "have the nominal value, at which a mechanism has no effect",
    )
    tension: bool = Field(
        default=False,
        description="use recorded cable tensions; their relative noise tension_noise is inferred, and tension_gain is "
        "1 unless it has a prior",
    )
    motor_angle: bool = Field(
        default=False, description="use recorded motor angles; their noise motor_angle_noise is inferred"
    )
    orientation: bool = Field(
        default=False,
        description="use recorded orientations of sections; their noise orientation_noise is inferred, and the turn of "
        "the frame (frame_turn_x, _y and _z) is zero unless it has a prior",
    )
    object_pose: bool = Field(
        default=False,
        description="use recorded poses of the pushed body, which starts at its first pose; object_noise, "
        "object_turn_noise and, unless noise is white, object_correlation_time are inferred",
    )
    weighed: list[WeighedTable] = Field(
        default_factory=list, description="measured parameters, or measured sums of parameters"
    )


class SimulatorTable(ExperimentTable):
    """[simulator]: body, engine and discretisation; missing keys are the robot's own."""

    body: Literal["rod", "tetrahedra"] = Field(
        default="rod", description="a rod with the robot's section profile, or the mesh under [simulator.tetrahedra]"
    )
    motion: Literal["dynamic", "quasi-static"] = Field(
        default="dynamic",
        description='"quasi-static": every row is an equilibrium, without damping; only drives and cameras depend on '
        "time. Quasi-static motion suffices if commands change slowly compared with vibrations of the body, which "
        "rfdropo check measures",
    )
    push: bool = Field(default=False, description="put the robot's cube and plate before the trunk")
    drives: Literal["robot", "direct"] = Field(
        default="robot",
        description='"direct": commands act at once, without the robot\'s ramp and dead time; add the drives '
        "as mechanisms such as command_delay",
    )
    tetrahedra: TetrahedraTable | None = Field(default=None, description="the mesh")
    engine: Literal["auto", "jax", "numba"] = Field(
        default="auto", description='"auto" is JAX for a rod if there is a GPU, else the compiled engine'
    )
    precision: Literal["float64", "float32"] = Field(
        default="float64", description="floating-point precision of the compiled engine; stiff bodies need float64"
    )
    time_step: float | None = Field(default=None, gt=0.0, le=0.1, description="time step [s]; the robot's by default")
    integrator: Literal["euler", "sdirk2"] | None = Field(
        default=None,
        description='"sdirk2" has order 2 (1.6 with taut cables) and two solves a step; "euler", the scheme of SOFA, '
        "has one solve and about ten times the error; the robot's by default",
    )
    refine: int = Field(default=1, ge=1, le=16, description="number of pieces of every element of the robot's rod")
    threads: int | None = Field(default=None, ge=1, description="threads of the engine; one per processor by default")

    @model_validator(mode="after")
    def _rests(self) -> SimulatorTable:
        if self.motion != "quasi-static":
            return self
        moving = {"time_step": self.time_step is not None, "integrator": self.integrator is not None}
        moving |= {"push": self.push, 'body = "tetrahedra"': self.body == "tetrahedra"}
        for key, stated in moving.items():
            if stated:
                remedy = 'remove it, or set motion = "dynamic"'
                raise InputError(f'motion = "quasi-static" does not allow {key}', where="[simulator]", remedy=remedy)
        return self

    @model_validator(mode="after")
    def _has_mesh(self) -> SimulatorTable:
        if self.body == "tetrahedra" and self.tetrahedra is None:
            raise InputError(
                'body = "tetrahedra" needs a mesh',
                where="[simulator]",
                remedy="add a table [simulator.tetrahedra] with mesh, unit and clamp_height",
            )
        return self


ROLLOUTS = 20000  # budget of an experiment that states none


class InferenceTable(BaseModel):
    """[inference]: method and budget; the method's own options are checked by the method."""

    model_config = ConfigDict(extra="allow", frozen=True)

    method: str = Field(
        default="smc",
        description="inference method (docs/reference/methods.md); options of the method are further keys of this "
        "table",
    )
    rollouts: int | None = Field(
        default=None, ge=1, description=f"budget in full-length rollouts; {ROLLOUTS} without minutes"
    )
    minutes: float | None = Field(
        default=None,
        gt=0.0,
        description="budget in minutes on the machine that calibrates, predictions and report included; the number "
        "of rollouts follows from their measured time; replaced by rollouts, if given",
    )

    @property
    def options(self) -> dict[str, Any]:
        """Options of the method, without the name and the budget."""
        return dict(self.model_extra or {})


class CommandsTable(ExperimentTable):
    """[commands]: a random command sequence to simulate, if no recording is replayed."""

    duration: float = Field(gt=0.0, description="length of a recording [s]")
    interval: float = Field(
        gt=0.0, description="time between changes [s]: one channel, chosen at random, moves up or down"
    )
    step: float = Field(gt=0.0, description="size of a change, in the robot's unit of commands")
    low: float = Field(description="least command")
    high: float = Field(description="greatest command")
    sample_time: float = Field(gt=0.0, description="time between observations [s]")
    recordings: list[str] = Field(min_length=1, description="a name for each recording")
    markers: list[str] = Field(default_factory=list, description="markers that are observed; all by default")
    blind: bool = Field(default=False, description="do not store the true parameters in the recordings")


class NoiseTable(ExperimentTable):
    """[noise]: noise of marker positions whose size is known."""

    standard_deviation: float = Field(ge=0.0, description="standard deviation of one coordinate of one marker [m]")
    correlation_time: float | None = Field(
        default=None, gt=0.0, description="correlation time of the noise [s]; white by default"
    )


class AuditTable(ExperimentTable):
    """[audit]: candidates and effort of ``rfdropo audit``."""

    candidates: list[str] = Field(
        default_factory=list, description="further mechanisms to try, e.g. mine.py:MyMechanism"
    )
    exclude: list[str] = Field(default_factory=list, description="mechanisms that are not tried")
    library: bool = Field(
        default=True,
        description="try the registry's mechanisms, quantities of the robot, and differences between groups",
    )
    ports: bool = Field(
        default=True, description="look for unknown causes, as laws at ports, if the library leaves a misfit"
    )
    matters_mm: float | None = Field(
        default=None, gt=0.0, description="distance of a marker [mm] below which a discrepancy does not matter"
    )
    bootstraps: int = Field(default=999, ge=199, description="number of simulated data sets for the p-values")
    minutes: float = Field(
        default=30.0,
        gt=0.0,
        description="limit of the whole run in minutes, after which the audit ends with its present results",
    )


class DesignTable(ExperimentTable):
    """[design]: effort of ``rfdropo design``."""

    minutes: float = Field(
        default=10.0,
        gt=0.0,
        description="limit of the whole run in minutes, after which the best candidate so far is proposed",
    )


class Experiment(ExperimentTable):
    """An experiment as read from its file; see `load_experiment`."""

    robot: str = Field(
        description="name of a robot that comes with the package, or path of a robot file, relative to this file; the "
        "path of a MuJoCo model (.xml, .urdf); or module:attribute or file.py:attribute of another simulator"
    )
    adapter: dict[str, Any] = Field(
        default_factory=dict,
        description="settings of another simulator: markers, channels, parameters and further keys of the adapter; "
        "see docs/your_simulator.md",
    )
    seed: int = Field(default=0, description="seed of all random numbers")
    title: str = Field(default="", description="heading of the report; the file's name by default")
    data: DataSpec | None = Field(default=None, description="the recordings")
    commands: CommandsTable | None = Field(
        default=None, description="random commands to simulate, if no recording is replayed"
    )
    noise: NoiseTable | None = Field(
        default=None, description="noise that simulate adds to positions, and that an audit without repeats assumes"
    )
    model: ModelTable = Field(
        default_factory=ModelTable, description="additions to the base simulator, and inferred parameters"
    )
    simulator: SimulatorTable = Field(default_factory=SimulatorTable, description="body, engine and discretisation")
    inference: InferenceTable = Field(
        default_factory=InferenceTable, description="method, budget and the method's options"
    )
    audit: AuditTable = Field(default_factory=AuditTable, description="candidates and effort of rfdropo audit")
    design: DesignTable = Field(default_factory=DesignTable, description="effort of rfdropo design")
    training: TrainingTable | None = Field(default=None, description="task and settings of rfdropo train")


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
    """Recordings of ``"all"``, a name or a wildcard pattern; InputError if one matches no recording."""
    from fnmatch import fnmatchcase

    if patterns == "all":
        return list(names)
    chosen: list[str] = []
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        found = [pattern] if pattern in names else [name for name in names if fnmatchcase(name, pattern)]
        if not found:
            raise InputError(f"no recording matches {pattern!r}", where=where, remedy=f"recordings: {', '.join(names)}")
        chosen += [name for name in found if name not in chosen]
    return chosen
