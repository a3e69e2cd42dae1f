"""Recordings with an effect hidden in them, for tests of the audit: it sees the files and nothing else.

Three repeats of one random command and one recording of another are to be fitted, six more are untouched. The size of
what is hidden is rho: the root mean square of what a refit of the base model cannot absorb, on noise-free recordings,
in standard deviations of the noise. Data come from a finer mesh and time step than the audit's own; that
discretisation's rho is computed as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.stats import chi2, ncx2

from rfdropo_bayes.bayes.channels.tension import reading_size
from rfdropo_bayes.bayes.noise import Noise, draw_noise
from rfdropo_bayes.bayes.noise.autoregression import STATED, Autoregression
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.discrepancy.audit_problem import measurements_of, simulated
from rfdropo_bayes.discrepancy.fit import FitTarget, optimise
from rfdropo_bayes.discrepancy.score import project_out, span
from rfdropo_bayes.files import output_folder
from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.experiment import AuditTable, CommandsTable, Experiment, SimulatorTable
from rfdropo_bayes.model.experiment_file import describe
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.protocol import Observation
from rfdropo_bayes.verbs.audit import Workshop, build_problem
from rfdropo_bayes.verbs.simulate import random_walk

NOISE, MEMORY = 5e-4, 0.6  # standard deviation [m] and correlation from row to row
TENSION_NOISE = 0.02  # of a tension reading
REPEATS, UNTOUCHED = 3, 6
EARLIER = {"integrator": "euler"}  # the ledgers in reports/audit_power and reports/unknown_effects were begun with it
SIZES = np.geomspace(1e-4, 60.0, 40)  # multiples of the prior's scale among which a size is looked for


@dataclass(frozen=True)
class Setting:
    """How data sets are made, and how they are audited.

    Attributes:
        robot: name; recordings: command sequences.
        audited, made: [simulator] tables of the audit and of the data.
        spread: relative deviation of the truth from the middle of the priors.
        priors: of the base parameters.
        tension: whether cable tensions are recorded, and are data of the audit.
        shared: share of the noise's variance that all markers have in common, as where a mount shakes.
    """

    robot: str = "smooth_arm"
    commands: CommandsTable = field(
        default_factory=lambda: CommandsTable(
            duration=5.0, interval=0.2, step=0.0025, low=0.0, high=0.01, sample_time=0.05, recordings=["any"]
        )
    )
    audited: Mapping[str, Any] = field(default_factory=lambda: {**EARLIER, "refine": 2, "time_step": 0.005})
    made: Mapping[str, Any] = field(default_factory=lambda: {**EARLIER, "refine": 3, "time_step": 0.05 / 12})
    spread: float = 0.3
    priors: Mapping[str, Mapping[str, Any]] = field(
        default_factory=lambda: {
            "young_modulus": {"distribution": "LogNormal", "median": 2e6, "sigma": 0.5},
            "trunk_mass": {"distribution": "LogNormal", "median": 0.09, "sigma": 0.5},
            "rayleigh_stiffness": {"distribution": "LogNormal", "median": 0.05, "sigma": 0.7},
        }
    )
    tension: bool = False
    shared: float = 0.0


@dataclass(frozen=True)
class Hidden:
    """What is in a data set.

    Attributes:
        values: true parameters, base and hidden, by name.
        rho: of each hidden mechanism, and ``discretisation`` for that of the mesh and time step.
        ideal: chance that a test finds each hidden mechanism among all candidates, at the audit's level, if it knows
            the noise and the mechanism's directions.
        folder: of the recordings and the experiment file.
        clean: noise-free untouched recordings [m].
    """

    values: dict[str, float]
    rho: dict[str, float]
    ideal: dict[str, float]
    folder: Path
    clean: Float[np.ndarray, "trajectory time channel"]

    @property
    def experiment(self) -> Path:
        """The file to audit."""
        return self.folder / "audit.toml"


def hide(
    setting: Setting,
    mechanisms: Sequence[str],
    rho: float,
    seed: int,
    out: Path,
    *,
    exclude: Sequence[str] = (),
    workshop: Workshop | None = None,
) -> Hidden | None:
    """Write a data set with mechanisms hidden in it, each of size ``rho``.

    Args:
        setting: see `Setting`.
        mechanisms: registry names; none for null data.
        rho: size of each.
        seed: of truth, commands, sizes and noise.
        out: folder to write to.
        exclude: candidates that the audit is not to have.
        workshop: keeps compiled simulators from one data set to the next.

    Returns:
        what is hidden; None where no size of a mechanism within its bounds reaches rho, or where the truth of that size
        does not roll out well.
    """
    rng = np.random.default_rng(seed)
    out = output_folder(out)
    experiment = experiment_tables(setting, exclude)
    names = [*(f"fit_{k + 1}" for k in range(REPEATS)), "screen", *(f"test_{k + 1}" for k in range(UNTOUCHED))]
    blank = blank_recordings(setting, rng, names, [*([0] * REPEATS), *range(1, 2 + UNTOUCHED)])
    fitted, untouched = blank[: REPEATS + 1], blank[REPEATS + 1 :]
    problem = build_problem(spec_of(experiment, out), AuditTable(), fitted, untouched, seed, workshop=workshop)
    coordinates = problem.coordinates
    truth = coordinates.null.copy()
    truth[: coordinates.base] += (
        setting.spread * coordinates.prior_sd[: coordinates.base] * rng.standard_normal(coordinates.base)
    )
    measurements = measurements_of(problem, range(len(fitted)), fitted)
    forward = simulated(problem, False, measurements, [group[0] for group in measurements.members])
    widths = [channel.valid.shape[-1] for channel in measurements.channels]
    sizes_of = zip(widths, (NOISE, TENSION_NOISE), strict=False)
    white = Stacked(tuple(Autoregression(np.full(n, size), np.ones(1), STATED, np.inf) for n, size in sizes_of))
    shown = forward.observe_one(truth)  # what small tensions are small beside
    read = [shown["position"], shown["tension"]]
    channels = tuple(replace(c, readings=part) for c, part in zip(measurements.channels, read, strict=False))
    plain = replace(measurements, channels=channels, count=measurements.valid.astype(float))
    target = FitTarget(forward, plain, white)
    memory = Autoregression(np.full(widths[0], NOISE), np.array([1.0, MEMORY]), STATED, np.inf)
    measured = FitTarget(forward, measurements, replace(white, parts=(memory, *white.parts[1:])))
    sizes, ideal = {}, {}
    for name in mechanisms:
        index = next(c.indices for c in problem.candidates if c.name == name)
        moved = _sized(target, truth, index, rho, rng)
        if moved is None:
            return None
        base = span(measured.jacobian(truth, np.arange(coordinates.base)))
        effect = project_out(base, (measured.residual(truth[None]) - measured.residual(moved[None])).T)
        level = problem.rules.level / len(problem.candidates)
        ideal[name] = float(ncx2.sf(chi2.isf(level, len(index)), len(index), np.sum(effect**2)))
        truth = moved
        sizes[name] = rho
    values = {n: v for n, v in coordinates.named(truth).items() if _belongs(problem, n, mechanisms)}
    made = _made(setting, mechanisms, values, blank)
    if made is None:
        return None
    sizes["discretisation"] = _discretisation(target, truth, made, measurements.members)
    _write(setting, experiment, blank, made, seed, out)
    untouched_rows = np.asarray(made.position)[REPEATS + 1 :]
    return Hidden(values, sizes, ideal, out, untouched_rows.reshape(*untouched_rows.shape[:2], -1))


def _belongs(problem: Any, name: str, mechanisms: Sequence[str]) -> bool:
    hidden = [c for c in problem.candidates if c.name in mechanisms]
    names = problem.coordinates.names
    own = {names[i] for c in hidden for i in c.indices}
    return name in own or names.index(name) < problem.coordinates.base


def experiment_tables(
    setting: Setting, exclude: Sequence[str] = (), fit: Sequence[str] = ("fit_*.nc", "screen.nc")
) -> Experiment:
    """The experiment file that audits a data set."""
    return Experiment.model_validate(
        {
            "robot": setting.robot,
            "data": {"format": "netcdf", "fit": list(fit), "test": ["test_*.nc"]},
            "model": {
                "priors": {name: dict(table) for name, table in setting.priors.items()},
                "tension": setting.tension,
            },
            "simulator": dict(setting.audited),
            "audit": {"exclude": list(exclude)},
        }
    )


def blank_recordings(
    setting: Setting, rng: np.random.Generator, names: Sequence[str], order: Sequence[int]
) -> list[Trajectory]:
    """Commands and times of all recordings; their positions are still those at rest.

    Args:
        setting: what is recorded.
        rng: of the command sequences.
        names: of the recordings.
        order: the number of the command sequence of each of them; repeats have the same one.
    """
    robot, table = Robot.load(setting.robot), setting.commands
    sequences = [random_walk(table, len(robot.channel_names), rng) for _ in range(1 + max(order))]
    time = table.sample_time * np.arange(round(table.duration / table.sample_time) + 1)
    return [
        Trajectory.build(
            Origin(name=name, robot=robot.name, format="netcdf", synthetic=True),
            SentCommands(
                command_time=sequences[k][0],
                command=sequences[k][1],
                command_unit=robot.command_unit,
                cable_names=robot.channel_names,
            ),
            Measured(
                time=time,
                position=np.tile(robot.marker_points(), (len(time), 1, 1)),
                marker_names=robot.marker_names,
                tension=np.ones((len(time), len(robot.channel_names))) if setting.tension else None,
            ),
        )
        for name, k in zip(names, order, strict=True)
    ]


def _sized(
    target: FitTarget, truth: np.ndarray, indices: Sequence[int], rho: float, rng: np.random.Generator
) -> np.ndarray | None:
    """The truth with a mechanism of size ``rho`` in it, its signs and shapes at random.

    The size is looked for on a grid of multiples of the prior's scale, between whose values rho is taken as a power.
    """
    coordinates = target.forward.coordinates
    low, high = coordinates.bounds
    indices = list(indices)
    shapes = [i for i in indices if not coordinates.affine[i] or coordinates.space.parameters[i].spec.grid]
    amplitudes = [i for i in indices if i not in shapes] or shapes
    start = truth.copy()
    for i in shapes:
        start[i] = coordinates.quantiles(i, [rng.uniform(0.3, 0.7)])[0]
    direction = np.zeros(len(truth))
    signs = np.where(coordinates.one_sided[amplitudes] != 0, 1.0, rng.choice([-1.0, 1.0], len(amplitudes)))
    direction[amplitudes] = signs * rng.uniform(0.5, 1.0, len(amplitudes))
    start[amplitudes] = truth[amplitudes]
    points = start + SIZES[:, None] * direction
    inside = ((points >= low) & (points <= high)).all(axis=1)
    points = points[inside]
    base = span(target.jacobian(truth, np.arange(coordinates.base)))
    effect = target.residual(truth[None])[0] - target.residual(points)
    found = np.sqrt(np.mean(project_out(base, effect.T).T ** 2, axis=1))
    above = np.flatnonzero(found >= rho)
    if len(above) == 0 or above[0] == 0:
        return None
    k = above[0]
    share = np.log(rho / max(found[k - 1], 1e-9)) / np.log(found[k] / max(found[k - 1], 1e-9))
    size = np.exp(np.log(SIZES[inside][k - 1]) + share * np.log(SIZES[inside][k] / SIZES[inside][k - 1]))
    return start + size * direction


def _made(
    setting: Setting, mechanisms: Sequence[str], values: Mapping[str, float], blank: Sequence[Trajectory]
) -> Observation | None:
    """What the finer simulator shows of every recording; None where a rollout does not end well."""
    spec = spec_of(experiment_tables(setting, ()), Path(), mechanisms=mechanisms)
    simulator = build_simulator(replace(spec, simulator=SimulatorTable.model_validate(dict(setting.made))))
    recordings = gather_recordings(simulator, blank)
    given = {name: jnp.asarray(v) for name, v in values.items()}
    observed = jax.vmap(lambda c: simulator.rollout(given, c, jnp.asarray(c.step.shape[0])))(recordings.commands)
    return observed if int(np.max(np.asarray(observed.status))) == 0 else None


def _discretisation(target: FitTarget, truth: np.ndarray, made: Observation, members: Sequence[Sequence[int]]) -> float:
    """RMS of what a refit with the true mechanisms in the model cannot absorb, in noise deviations."""
    firsts = [group[0] for group in members]
    shown = [np.asarray(part)[firsts] for part in (made.position, made.tension)]
    channels = zip(target.measurements.channels, shown, strict=False)
    fitted = replace(target.measurements, channels=tuple(replace(c, readings=part) for c, part in channels))
    refit = optimise(replace(target, measurements=fitted), truth, np.arange(target.forward.coordinates.base))
    return float(np.sqrt(np.mean(refit.residual**2)))


class Absorbing(NamedTuple):
    """What a refit of the base model cannot absorb of a change of the markers.

    Attributes:
        recordings: the fitted ones, without repeats; ``commands``: theirs.
        rho: of changes of their positions [m], (recording, time, marker, 3).
    """

    recordings: list[Trajectory]
    commands: Any
    rho: Callable[[np.ndarray], float]


def absorbing(problem: Any, truth: np.ndarray, fitted: Sequence[Trajectory]) -> Absorbing:
    """See `Absorbing`; the base model is linearised at ``truth``."""
    measurements = measurements_of(problem, range(len(fitted)), fitted)
    firsts = [group[0] for group in measurements.members]
    forward = simulated(problem, False, measurements, firsts)
    widths = [channel.valid.shape[-1] for channel in measurements.channels]
    white = Stacked(tuple(Autoregression(np.full(n, NOISE), np.ones(1), STATED, np.inf) for n in widths))
    target = FitTarget(forward, replace(measurements, count=measurements.valid.astype(float)), white)
    base = span(target.jacobian(truth, np.arange(problem.coordinates.base)))

    def rho(change: np.ndarray) -> float:
        return float(np.sqrt(np.mean(project_out(base, change.reshape(-1, 1) / NOISE) ** 2)))

    return Absorbing([fitted[k] for k in firsts], forward.commands, rho)


def noisy(
    recording: Trajectory, position: Float[np.ndarray, "time marker 3"], key: PRNGKeyArray, setting: Setting
) -> Trajectory:
    """A recording whose markers are at these positions, and measured with noise."""
    memory = jnp.asarray(-setting.commands.sample_time / np.log(MEMORY))
    time, size = jnp.asarray(recording.time), Noise(jnp.asarray(NOISE), memory)
    noise = np.asarray(draw_noise(key, time, position.shape[1], size))
    if setting.shared > 0.0:
        common = np.asarray(draw_noise(jax.random.fold_in(key, 2), time, 1, size))
        noise = np.sqrt(1.0 - setting.shared) * noise + np.sqrt(setting.shared) * common
    dataset = recording.dataset.copy()
    dataset["position"] = dataset["position"].copy(data=position + noise)
    return Trajectory(dataset)


def _write(
    setting: Setting, experiment: Experiment, blank: Sequence[Trajectory], made: Observation, seed: int, out: Path
) -> None:
    for index, (recording, position) in enumerate(zip(blank, np.asarray(made.position), strict=True)):
        key = jax.random.fold_in(jax.random.key(seed), index)
        dataset = noisy(recording, position, key, setting).dataset
        if setting.tension:
            pull = np.asarray(made.tension)[index]
            error = np.asarray(jax.random.normal(jax.random.fold_in(key, 1), pull.shape))
            size = np.asarray(reading_size(pull[None], np.ones((1, *pull.shape), dtype=bool), pull[None]))[0]
            dataset["tension"] = dataset["tension"].copy(data=pull + TENSION_NOISE * size * error)
        Trajectory(dataset).save(out / f"{recording.name}.nc")
    tables = experiment.model_dump(exclude_none=True, exclude_defaults=True)
    tables["seed"] = seed
    (out / "audit.toml").write_text(describe(tables), encoding="utf-8")
