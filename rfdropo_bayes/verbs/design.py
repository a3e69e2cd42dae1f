"""The next command sequence, and the question it will decide: ``design``."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from rfdropo_bayes.bayes.recordings import commands_after
from rfdropo_bayes.data import DataSpec, Trajectory, asl_csv
from rfdropo_bayes.data.asl_csv import FORMAT as ASL
from rfdropo_bayes.data.plain_csv import command_columns
from rfdropo_bayes.discrepancy.audit_problem import AuditProblem
from rfdropo_bayes.discrepancy.base_fit import base_model
from rfdropo_bayes.discrepancy.deadline import Deadline, OutOfTime
from rfdropo_bayes.discrepancy.experiment_design import DesignOutlook, Hypothesis, at_hand, best, outlooks
from rfdropo_bayes.discrepancy.extension import DISCRETISATION, ExtensionSearch
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget
from rfdropo_bayes.discrepancy.inadequacy import seen_under
from rfdropo_bayes.discrepancy.law_search import Refit, law_search
from rfdropo_bayes.discrepancy.score_tests import ScoreTests
from rfdropo_bayes.inference.progress import say_lines
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import hashes, run_folder
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.results.designed import COMMANDS, Design
from rfdropo_bayes.simulators.commands import Commands, stack_commands
from rfdropo_bayes.verbs.arguments import given_model
from rfdropo_bayes.verbs.audit import build_problem, start_values

SEQUENCES, HYPOTHESES, KINDS = 24, 4, 4
SCREENED_BY, REFITTED_BY, LAWS_BY = 0.6, 0.7, 0.85  # shares of the time by which these parts have to end
SCREENING = "screening of the candidates"


class Clock(Deadline):
    """The time that a design may take; each part of the work has to end by its share of it.

    Attributes:
        missed: parts that were given up, in words.
    """

    def __init__(self, minutes: float) -> None:
        super().__init__(minutes, "[design] minutes")
        self.missed: list[str] = []

    @contextmanager
    def part(self, share: float, words: str) -> Iterator[None]:
        """Work that is given up when the time is up, which is then noted in ``words``."""
        self.share = share
        try:
            yield
        except OutOfTime:
            self.missed.append(words)
        finally:
            self.share = math.inf


def design(
    model: Model,
    runs: Sequence[Trajectory] | None = None,
    *,
    fit: Calibration | Path | None = None,
    seed: int | None = None,
    minutes: float | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
    show: bool | None = None,
) -> Design:
    """Propose the commands that best separate the leading explanations of a model's misfit: candidates of the library,
    and laws at ports that the recordings cannot distinguish.

    The proposals stay within the recorded range of commands and are as long as the first recording. There are four
    kinds: random walks, holds, slow loops and chirps. If no candidate is significant, the most informative sequence for
    the base parameters is proposed. When the time is up, the best sequence so far is proposed for the leading
    explanation so far.

    Args:
        model: simulator and inferred parameters.
        runs: recordings; by default from the model's experiment.
        fit: an earlier calibration, or its folder, from whose posterior means the base model starts.
        seed: seed of all random numbers; by default from the model's experiment.
        minutes: bound of the whole run; by default from the model's experiment, else 10.
        out: folder for design.json and next_commands.csv; None writes nothing.
        overwrite: replace an earlier run in ``out``.
        show: whether to show progress, as in `calibrate`.

    Raises:
        InputError: bad input, or a base model that was not fitted in the time.
    """
    model = given_model(model, "design")
    runs, chosen = model.runs(runs, ())[0], model.settings.seed if seed is None else seed
    work = partial(_design, model, runs, fit, chosen, minutes, say_lines(show))
    if out is None:
        return work()
    options = {"from": fit.folder if isinstance(fit, Calibration) else fit, "seed": chosen}
    settings: dict[str, Any] = {
        "tables": model.tables(),
        "folder": model.folder,
        "data": hashes(runs),
        "options": options,
        "texts": model.texts(),
    }
    with run_folder(Path(out), "design", **settings, overwrite=overwrite) as folder:
        designed = work()
        designed.save(folder)
    return designed


def _design(
    model: Model,
    runs: Sequence[Trajectory],
    fit: Calibration | Path | None,
    seed: int,
    minutes: float | None,
    report: Callable[[str], None],
) -> Design:
    settings = model.settings
    problem = build_problem(model.spec, settings.audit, runs, [], seed, start=start_values(fit))
    clock = Clock(settings.design.minutes if minutes is None else minutes)
    rng = np.random.default_rng(problem.seed)
    clock.share = 1.0
    target, fitted = base_model(problem, problem.seed, report=report, deadline=clock)
    report("base model fitted")
    search = ExtensionSearch(target, problem.candidates, problem.rules, problem.seed)
    scores: ScoreTests | None = None
    with clock.part(SCREENED_BY, SCREENING):
        scores = search.score_tests(fitted)
    hypotheses = [] if scores is None else _hypotheses(search, scores, clock, report)
    wrong = scores is not None and scores.omnibus.p <= problem.rules.level
    if wrong and (alternatives := _alternatives(problem, target, fitted, clock, report)):
        target, fitted, hypotheses = _with_laws(problem, target, fitted, hypotheses, alternatives)
    tried = list(proposals(runs[0], runs, rng))
    outlook = _outlooks(problem, target, fitted, hypotheses, runs[0], tried, clock, report)
    chosen = best(outlook, len(hypotheses) > 1)
    kind, times, value = tried[chosen]
    now = at_hand(target, hypotheses)
    content = {
        "sentence": _sentence(kind, outlook[chosen], now, SCREENING not in clock.missed)
        + stated_units(settings.data)
        + _unfinished(clock),
        "kind": kind,
        "hypotheses": [h.name for h in hypotheses],
        "separation_now": {" / ".join(pair): value for pair, value in now.items()},
        "separation_with_it": {" / ".join(pair): value for pair, value in outlook[chosen].pairs.items()},
        "probability_of_the_right_decision": outlook[chosen].right if len(hypotheses) > 1 else None,
        "information_gain_nats": outlook[chosen].information,
        "tried": [
            {"kind": k, "separation": o.separation, "information_nats": o.information}
            for (k, _, _), o in zip(tried, outlook, strict=False)
        ],
        "not_finished": clock.missed,
        "minutes": round((time.monotonic() - clock.began) / 60.0, 2),
        "seed": problem.seed,
        "schema_version": 1,
    }
    return Design(content, command_table(settings.data, runs[0], times, value, float(runs[0].time[-1])))


def _hypotheses(
    search: ExtensionSearch, scores: ScoreTests, clock: Clock, report: Callable[[str], None]
) -> list[Hypothesis]:
    """The leading significant candidates, each refitted."""
    rows = [row for row in scores.rows if row.adjusted_p <= search.rules.level and row.name != DISCRETISATION]
    report(f"{len(rows)} candidates are significant")
    hypotheses = []
    for row in rows[: 2 * HYPOTHESES]:
        with clock.part(REFITTED_BY, f"refit with {row.name}"):
            hypotheses.append(Hypothesis(row.name, search.refit(scores.fit, row)))
            report(f"hypothesis {row.name}")
    hypotheses.sort(key=lambda h: -search.gain(scores.fit, h.fit))
    return hypotheses[:HYPOTHESES]


def _alternatives(
    problem: AuditProblem, target: FitTarget, base: Fit, clock: Clock, report: Callable[[str], None]
) -> list[Refit]:
    """The leading law at a port without a name in the library, and laws that the recordings cannot distinguish from
    it.
    """
    if problem.ports is None:
        return []
    simulator: Any = problem.lanes.simulator
    names, unit = tuple(simulator.channel_names), str(getattr(simulator, "command_unit", "m"))
    options = (problem.ports, names, unit, problem.seed, problem.rules.level, report, None, problem.timed)
    alternatives: list[Refit] = []
    with clock.part(LAWS_BY, "laws at ports"):
        search = replace(law_search(target, *options), most=1)
        alternatives = search.find(target, base).alternatives
    return alternatives


def _with_laws(
    problem: AuditProblem, target: FitTarget, base: Fit, hypotheses: Sequence[Hypothesis], alternatives: Sequence[Refit]
) -> tuple[FitTarget, Fit, list[Hypothesis]]:
    """Target, base fit and hypotheses with laws before them, all under the same noise, which is fitted to the model
    with the leading law. A misspecified model would be overconfident under the measurement noise.
    """
    simulator: Any = problem.lanes.simulator
    names, fit_target = tuple(simulator.channel_names), alternatives[0].target.on(target.forward)
    laws = [
        Hypothesis(
            f"{refit.feature.formula(names)} at {refit.term.port.words}",
            seen_under(refit.target, fit_target, refit.fit),
            refit.target.forward,
        )
        for refit in alternatives
    ]
    own = [replace(h, fit=seen_under(target, fit_target, h.fit)) for h in hypotheses]
    return fit_target, seen_under(target, fit_target, base), [*laws, *own][:HYPOTHESES]


def _outlooks(
    problem: AuditProblem,
    target: FitTarget,
    base: Fit,
    hypotheses: Sequence[Hypothesis],
    first: Trajectory,
    proposals: Sequence[tuple[str, np.ndarray, np.ndarray]],
    clock: Clock,
    report: Callable[[str], None],
) -> list[DesignOutlook]:
    """Outlooks of the proposals, one of each kind at a time; of the first few, whatever the time."""
    simulator = problem.lanes.simulator
    sequences = [commands_after(simulator, first, t, v) for _, t, v in proposals]
    shaped = _shaped(sequences, problem.model.recordings.commands)
    outlook = outlooks(target, base, hypotheses, shaped[:KINDS])
    for start in range(KINDS, len(shaped), KINDS):
        report(f"{start} of {len(shaped)} command sequences")
        with clock.part(1.0, f"{len(shaped) - start} of {len(shaped)} command sequences"):
            outlook += outlooks(target, base, hypotheses, shaped[start : start + KINDS])
        if len(outlook) == start:
            break
    return outlook


def command_table(
    data: DataSpec | None, first: Trajectory, time: np.ndarray, value: np.ndarray, seconds: float
) -> pd.DataFrame:
    """The proposal, of length ``seconds``, in the columns of the experiment's recordings."""
    if data is not None and data.format == ASL:
        return pd.DataFrame(asl_csv.command_columns(time, value, seconds))
    if data is not None and data.columns is not None:
        return pd.DataFrame(command_columns(data.columns, time, value))
    channels = {f"{c}_{first.command_unit}": value[:, k] for k, c in enumerate(first.cable_names)}
    return pd.DataFrame({"time_s": time, **channels})


def stated_units(data: DataSpec | None) -> str:
    """Sentence on the units of `command_table`, if its column names do not state them."""
    if data is not None and data.format == ASL:
        return " Columns u1 to u6 are in degrees, a row every 10 ms, as that format has them."
    return ""


def _shaped(sequences: Sequence[Commands], like: Commands) -> list[Commands]:
    """Sequences padded and cut to the shape of the recordings at hand, which the compiled simulator expects."""
    steps, rows = like.step.shape[1], like.sample_step.shape[1]
    stacked = stack_commands([*sequences, like.of(0)])
    return [
        Commands(
            np.asarray(stacked.initial)[k],
            np.asarray(stacked.step)[k, :steps],
            np.asarray(stacked.sample_step)[k, :rows],
            np.asarray(stacked.sample_fraction)[k, :rows],
        )
        for k in range(len(sequences))
    ]


def proposals(
    first: Trajectory, fitted: Sequence[Trajectory], rng: np.random.Generator
) -> list[tuple[str, Float[np.ndarray, " k"], Float[np.ndarray, "k channel"]]]:
    """Command sequences within the range that the recordings have used."""
    low = np.min([np.min(t.command, axis=0) for t in fitted], axis=0)
    high = np.max([np.max(t.command, axis=0) for t in fitted], axis=0)
    low, high = np.minimum(low, first.initial_command), np.maximum(high, first.initial_command)
    duration, channels = float(first.time[-1]), len(low)
    proposed = []
    for index in range(SEQUENCES):
        kind = ("random walk", "holds", "slow loop", "chirp")[index % 4]
        if kind in ("random walk", "holds"):
            interval = duration / (25 if kind == "random walk" else rng.integers(4, 9))
            time = interval * np.arange(int(duration / interval))
            level = rng.uniform(low, high, (len(time), channels))
            moved = rng.uniform(size=level.shape) < (0.3 if kind == "random walk" else 0.6)
            value = _constant(level, moved, first.initial_command)
        else:
            time = np.arange(0.0, duration, duration / 100)
            turns = rng.integers(1, 4)
            phase = turns * time / duration if kind == "slow loop" else 4.0 * turns * (time / duration) ** 2
            swing = 0.5 - 0.5 * np.cos(2 * np.pi * phase)
            weight = rng.dirichlet(np.ones(channels)) ** 0.5
            value = first.initial_command + np.outer(swing, weight * (high - first.initial_command))
        proposed.append((kind, time, np.clip(value, low, high)))
    return proposed


def _constant(level: np.ndarray, moved: np.ndarray, initial: np.ndarray) -> np.ndarray:
    """Channels that keep their command until they are moved."""
    value, last = np.empty_like(level), np.array(initial, dtype=float)
    for row in range(len(level)):
        last = np.where(moved[row], level[row], last)
        value[row] = last
    return value


def _unfinished(clock: Clock) -> str:
    if not clock.missed:
        return ""
    return (
        f" The {clock.minutes:g} minutes of [design] minutes were up before the end; not looked at: "
        f"{', '.join(name.replace('_', ' ') for name in clock.missed)}."
    )


def _sentence(kind: str, outlook: DesignOutlook, now: dict[tuple[str, str], float], score_tests: bool) -> str:
    if not outlook.pairs:
        outcome = "No candidate is significant." if score_tests else "There was no time for the candidates."
        return (
            f"{outcome} The {kind} in {COMMANDS} would tell most about the base parameters: "
            f"{outlook.information:.1f} nats."
        )
    pair = min(outlook.pairs, key=lambda p: outlook.pairs[p])
    words = " and ".join(name.replace("_", " ") for name in pair)
    before, after = (f"{0.5 * ratio:.1f}" for ratio in (now[pair], outlook.pairs[pair]))
    if before == after:
        return (
            f"No proposed experiment separates {words} further: with the {kind} in {COMMANDS}, the best of them, the "
            f"expected log likelihood ratio stays at {after} nats."
        )
    return (
        f"Record the {kind} in {COMMANDS}: it raises the expected log likelihood ratio of the pair that "
        f"is hardest to distinguish, {words}, from {before} to {after} nats, and identifies the right explanation with "
        f"probability {outlook.right:.2f}."
    )
