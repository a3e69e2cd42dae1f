"""An audit as plain values: the content of audit.json."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.noise.autoregression import REPEATS
from rfdropo_bayes.cautions import Caution
from rfdropo_bayes.discrepancy.candidates import spoken
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.discrepancy.extension import DISCRETISATION, Added
from rfdropo_bayes.discrepancy.fit import Fit
from rfdropo_bayes.discrepancy.gain import LEVELS, noise_distance
from rfdropo_bayes.discrepancy.law_words import law_record, ports_record
from rfdropo_bayes.discrepancy.pipeline import Answer
from rfdropo_bayes.discrepancy.prequential import in_words, prequential, span_in_words
from rfdropo_bayes.discrepancy.score import likeness
from rfdropo_bayes.discrepancy.score_tests import ScoreRow, ScoreTests
from rfdropo_bayes.discrepancy.sentence import sentence
from rfdropo_bayes.discrepancy.verdict import NEGLIGIBLE, NO_DISCREPANCY, NO_VERDICT, UNEXPLAINED
from rfdropo_bayes.posteriors import sharper_less_median

SCHEMA_VERSION = 1
MILLIMETRES = 1e3
STIFFNESS = "young_modulus"
FORCES = frozenset({"N", "kg", "Pa", "J", "W"})  # units that hold one force each
MORE_TESTS = 6  # recordings: all must favour a model by chance in one case of 64 only
REFINE = "raise [simulator] refine and, if the robot moves, shorten time_step"
SHORTEN = "shorten [simulator] time_step"  # of a mesh, whose finer simulation has the same elements


def record(
    answer: Answer, *, versions: dict[str, str], data_sha256: str, next_experiment: Any, doubts: Sequence[Caution] = ()
) -> dict[str, Any]:
    """Results of an audit with the keys of /audit.json/; lengths in mm if a key ends in mm.

    ``doubts`` are cautions on its recordings.
    """
    first = answer.test_series[0]
    refits = {step.name: step.log_bayes_factor for step in answer.steps}
    refits |= answer.steps[0].refits if answer.steps else answer.refits
    findings = [_finding(answer, step, stage) for step, stage in zip(answer.steps, _shares(answer), strict=True)]
    gain, noise = answer.validation.gain, answer.target.noise.first
    measured = answer.target.measurements
    base_rms = float(np.sqrt(np.mean(measured.series(answer.base.residual)[measured.valid] ** 2)))
    coordinates, base_x = answer.problem.coordinates, answer.base.x
    return {
        "verdict": answer.verdict,
        "sentence": sentence(answer, findings),
        "findings": findings,
        "candidates": [_candidate(answer, row, first, refits.get(row.name)) for row in first.rows],
        "between": _between(answer, findings),
        "base_fit_converged": answer.base.converged,
        "out_of_time": bool(answer.cost.stopped),
        "stopped": answer.cost.stopped,
        "not_done": list(answer.cost.unfinished),
        "left_out": dict(answer.problem.left_out),
        "adopted": [step.name for step in answer.adopted],
        "unsupported": list(answer.unsupported),
        "bootstraps": answer.problem.rules.bootstraps,
        "omnibus": [
            {
                "after": n,
                "p": tests.omnibus.p,
                "finer_mesh": tests.refined,
                "tests": tests.omnibus.single,
                "blocks": [None if np.isnan(block) else block for block in tests.omnibus.blocks.tolist()],
            }
            for n, tests in enumerate(answer.test_series)
        ],
        "gain": None
        if gain is None
        else {
            "rmse_base_mm": MILLIMETRES * gain.rmse_base,
            "rmse_extended_mm": MILLIMETRES * gain.rmse_extended,
            "elpd_difference": gain.elpd_difference,
            "elpd_difference_se": gain.elpd_difference_se,
            "elpd_p": gain.elpd_p,
            "explained_fraction": gain.explained,
            "explained_fraction_interval": list(gain.interval),
            "test_trajectories": gain.trajectories,
            "by_trajectory": gain.by_trajectory,
            "measured_on": answer.validation.recordings,
        },
        "coverage": {} if gain is None else {f"{level:g}": gain.coverage[level] for level in LEVELS},
        "noise_floor_mm": MILLIMETRES * noise_distance(noise) if noise.source == REPEATS else None,
        "numerical_error_mm": None if answer.numerical is None else MILLIMETRES * answer.numerical,
        "noise": _noise(answer),
        "channels": list(answer.target.measurements.names_of_channels),
        "residual_in_noise_deviations": base_rms,
        "remainder": {
            "amplitude_mm": MILLIMETRES * answer.remainder.amplitude,
            "length_scale_s": answer.remainder.memory,
            "log_likelihood_ratio": answer.remainder.log_likelihood_ratio,
        },
        "where": _where(answer),
        "cautions": [caution.as_dict() for caution in (*doubts, *answer.priors)],
        "optimum": _optimum(answer),
        "base_parameters": {
            coordinates.names[i]: coordinates.named(base_x)[coordinates.names[i]] for i in answer.base.free
        },
        "ports": ports_record(answer),
        "law": law_record(answer),
        "next_experiment": next_experiment,
        "rollouts": answer.cost.rollouts,
        "seconds": round(answer.cost.seconds, 2),
        "profile": {stage: round(seconds, 2) for stage, seconds in answer.cost.profile.items()},
        "minutes": answer.problem.rules.minutes,
        "seed": answer.problem.seed,
        "versions": versions,
        "data_sha256": data_sha256,
        "schema_version": SCHEMA_VERSION,
    }


def _optimum(answer: Answer) -> dict[str, dict[str, float]]:
    """Values of the extended model by parameter and owner, of the base model if no effect was adopted: optimisations of
    a calibration may start there.
    """
    coordinates, fit = answer.problem.coordinates, answer.extended if answer.adopted else answer.base
    values, found = coordinates.named(fit.x), dict[str, dict[str, float]]()
    for i in fit.free:
        parameter = coordinates.space.parameters[i]
        found.setdefault(parameter.spec.name, {})[parameter.scope.owner] = values[coordinates.names[i]]
    return found


def _noise(answer: Answer) -> dict[str, Any]:
    """Noise of the markers in mm, and of other channels in their own units; of tensions as a share of the reading."""
    noise, shift, suspected = answer.target.noise.first, answer.shift, answer.suspected
    parts = zip(answer.target.measurements.channels[1:], answer.target.noise.parts[1:], strict=True)
    return {
        "source": noise.source,
        "order": noise.order,
        "autocorrelation": noise.autocorrelation.tolist(),
        "standard_deviation_mm": (MILLIMETRES * noise.scale).tolist(),
        "correlation_between_channels": None if noise.correlation is None else np.round(noise.correlation, 3).tolist(),
        "other_channels": {
            channel.name: {"standard_deviation": part.scale.tolist(), "autocorrelation": part.autocorrelation.tolist()}
            for channel, part in parts
        },
        "shift_between_repeats_mm": None if shift is None else MILLIMETRES * shift,
        "suspected_mm": None if suspected is None else (MILLIMETRES * suspected.first.scale).tolist(),
    }


def next_experiment(answer: Answer) -> dict[str, Any]:
    """Next step at the robot, in a sentence, and the candidates that it distinguishes."""
    apart = next((step for step in answer.steps if len(step.members) > 1), None)
    if answer.verdict == NO_DISCREPANCY:
        words = "No change is needed for commands like these; record larger and faster commands, and audit them."
    elif answer.verdict == NEGLIGIBLE:
        words = "Nothing need be done: the residual is too small to matter."
    elif answer.law is not None and answer.law_leads:
        looks = "; ".join(dict.fromkeys(refit.term.port.look for refit in answer.law.search.terms))
        words = f"Look at {looks}: the library has no mechanism that acts so."
    elif not answer.fitted:
        words = "Nothing yet: raise [audit] minutes and go on with --resume, or start anew from a calibration (--from)."
    elif not answer.converged:
        words = "Run `rfdropo calibrate`, look at its fit, and start the audit from it with --from."
    elif answer.suspected is not None:
        words = "Repeat one command sequence three times: the repeats show whether the noise agrees with [noise]."
    elif answer.target.noise.doubtful:
        words = "Repeat one command sequence three times, or state the noise in [noise]: then a slow discrepancy shows."
    elif answer.verdict == UNEXPLAINED and answer.steps:
        words = f"No candidate explains it: {_watch(answer)}, for a cause to add as in docs/mechanisms.md."
    elif answer.verdict == NO_VERDICT:
        words = "Nothing yet: raise [audit] minutes, and go on with --resume."
    elif apart is not None:
        checks = "; ".join(f"{spoken(member)}: {_remedy(answer, member)}" for member in apart.members)
        both = " from ".join(spoken(member) for member in apart.members[:2])
        words = f"To tell {both}: {checks}. Or let `rfdropo design` propose commands that differ."
        return {"sentence": words, "separates": list(apart.members)}
    elif not answer.steps:
        leading = [row.name for row in answer.test_series[0].rows[:2]]
        asked = " and ".join(spoken(each) for each in leading) or "candidates of your own"
        words = (
            f"Send the commands that `rfdropo design` proposes to separate {asked}, each three times; {_watch(answer)}."
        )
        return {"sentence": words, "separates": leading}
    else:
        name, share = _largest(answer)
        most = f", {100 * share:.0f} % of what is wrong" if share and len(answer.steps) > 1 else ""
        where = "Refine the simulation" if name == DISCRETISATION else f"Check {spoken(name)} on the robot"
        words = f"{where}{most}: {_remedy(answer, name)}."
        if not answer.adopted:
            words = f"{words[:-1]}; and {_doubt(answer)}."
        return {"sentence": words, "separates": [name]}
    return {"sentence": words, "separates": []}


def _doubt(answer: Answer) -> str:
    """Test that decides whether a named but not adopted mechanism is present."""
    gain = answer.validation.gain
    if gain is None or not gain.opposed or gain.worse or answer.problem.compared:
        return f"record {MORE_TESTS} more test recordings: they show whether the model needs it"
    return f"see whether it was otherwise in {' and '.join(gain.against)}: compare groups of recordings with --between"


def _largest(answer: Answer) -> tuple[str, float | None]:
    """The step that explains most of the discrepancy, and the share; the first step if no share is known."""
    shares = zip(answer.steps, _shares(answer), strict=True)
    step, share = max(shares, key=lambda entry: -np.inf if entry[1] is None else entry[1])
    return step.name, share


def _remedy(answer: Answer, name: str) -> str:
    candidate = answer.problem.candidate(name)
    if candidate is not None:
        return candidate.mechanism.remedy
    rod = answer.problem.lanes.simulator.description.get("body") == "rod"
    return REFINE if rod else SHORTEN


def _watch(answer: Answer) -> str:
    """Advice on the place to watch: time and marker of the base model's largest misfit."""
    scores = prequential(answer.target, answer.base)
    worst, markers = int(np.argmax(scores.surprise)), answer.problem.model.recordings.markers
    marker = markers[int(np.argmax(scores.misfit.reshape(-1, 3).sum(axis=1)))]
    first, last = scores.edges[worst : worst + 2]
    return f"watch {marker} while the commands {span_in_words(first, last, answer.problem.timed)} are sent again"


def _shares(answer: Answer) -> list[float | None]:
    """Explained fraction that each step brought."""
    if not answer.validation.stages:
        return [None] * len(answer.steps)
    return [float(v) for v in np.diff([0.0, *answer.validation.stages])]


def _finding(answer: Answer, step: Added, share: float | None) -> dict[str, Any]:
    gain = answer.validation.gain if len(answer.steps) == 1 else None
    row = step.before.row(step.name)
    candidate = answer.problem.candidate(step.name)
    mechanism = candidate.mechanism if candidate else None
    parameters: dict[str, Any] = {}
    relative: dict[str, Any] = {}
    if candidate is not None:
        parameters = _drawn_parameters(answer, candidate.indices)
        own, indices = answer.problem.coordinates, candidate.indices
        relative = relative_sizes(own, answer.sizes, indices) or differences(own, answer.draws, indices)
    return {
        "mechanism": candidate.title if candidate else step.name,
        "group": candidate.group if candidate else "",
        "equivalence_class": list(step.members),
        "parameters": parameters,
        "relative": relative,
        "cause": getattr(mechanism, "cause", "the mesh or the time step of the simulator is too coarse"),
        "remedy": _remedy(answer, step.name),
        "explained_fraction": share,
        "explained_fraction_interval": None if gain is None else list(gain.interval),
        "adjusted_p": row.adjusted_p,
        "log_bayes_factor": step.log_bayes_factor,
        "refits": step.refits,
    }


def _between(answer: Answer, findings: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Differences between two groups of recordings, and effects that both lack; None without a comparison."""
    groups = answer.problem.compared
    if groups is None:
        return None
    keys = ("mechanism", "group", "parameters", "relative", "log_bayes_factor")
    alike = [list(step.members[1:]) for step in answer.steps]
    rows = [
        {**{key: finding[key] for key in keys}, "not_told_from": others}
        for finding, others in zip(findings, alike, strict=True)
    ]
    return {
        "groups": {name: list(members) for name, members in groups.members.items()},
        "left_out": list(groups.left_out),
        "differences": [row for row in rows if row["group"]],
        "in_both": [row for row in rows if not row["group"]],
    }


def _drawn_parameters(answer: Answer, indices: tuple[int, ...]) -> dict[str, Any]:
    """Posterior of parameters in physical units, from the extended model's normal approximation."""
    coordinates = answer.problem.coordinates
    values = coordinates.values(answer.draws)
    parameters = {}
    for i in indices:
        column = values[:, i]
        parameters[coordinates.names[i]] = {
            "title": coordinates.space.parameters[i].spec.name,
            "mean": float(column.mean()),
            "sd": float(column.std()),
            "q05": float(np.quantile(column, 0.05)),
            "q95": float(np.quantile(column, 0.95)),
            "unit": coordinates.space.parameters[i].spec.unit,
        }
    return parameters


def relative_sizes(coordinates: Coordinates, fit: Fit, indices: Sequence[int]) -> dict[str, Any]:
    """Masses, forces and stiffnesses over Young's modulus. With imposed cable lengths and no measured force only these
    ratios are determined. First-order error propagation in logarithms.
    """
    if STIFFNESS not in coordinates.names[: coordinates.base]:
        return {}
    place = {int(i): k for k, i in enumerate(fit.free)}
    modulus = coordinates.names.index(STIFFNESS)
    named, slopes = coordinates.named(fit.x), coordinates.slopes(fit.x[None])[0]
    sizes = {}
    for i in indices:
        name, own = coordinates.names[i], coordinates.space.parameters[i].spec
        unit = own.unit
        power = force_power(unit)
        if power == 0 or i not in place or named[name] == 0.0:
            continue
        gradient = np.zeros(len(fit.free))
        gradient[place[i]] = slopes[i] / named[name]
        gradient[place[modulus]] -= power * slopes[modulus] / named[STIFFNESS]
        ratio = named[name] / named[STIFFNESS] ** power
        deviation = float(np.sqrt(gradient @ fit.covariance @ gradient))
        low, high = ratio * (1 - 1.645 * deviation), ratio * (1 + 1.645 * deviation)
        relation = f"_over_{STIFFNESS}" if power > 0 else f"_times_{STIFFNESS}"
        sizes[f"{name}{relation}"] = {
            "title": f"{own.name}{relation}",
            "parameter": name,
            "power": power,
            "young_modulus": named[STIFFNESS],
            "mean": ratio,
            "sd": abs(ratio) * deviation,
            "q05": min(low, high),
            "q95": max(low, high),
            "unit": f"{unit}/Pa" if power > 0 else f"{unit} Pa",
        }
    return sizes


def differences(coordinates: Coordinates, draws: Float[np.ndarray, "draw d"], indices: Sequence[int]) -> dict[str, Any]:
    """Members of a family less their median, if the data determine these differences much better than the members."""
    parameters = [coordinates.space.parameters[i] for i in indices]
    apart = sharper_less_median(coordinates.values(draws)[:, list(indices)])
    if apart is None or len({each.spec.unit for each in parameters}) > 1:
        return {}
    return {
        f"{coordinates.names[i]}_less_median": {
            "title": f"{each.spec.name}_less_median",
            "parameter": coordinates.names[i],
            "power": 0,
            "mean": float(column.mean()),
            "sd": float(column.std()),
            "q05": float(np.quantile(column, 0.05)),
            "q95": float(np.quantile(column, 0.95)),
            "unit": each.spec.unit,
        }
        for i, each, column in zip(indices, parameters, apart.T, strict=True)
    }


def _where(answer: Answer) -> dict[str, Any]:
    """Time and place of the base model's misfit."""
    scores, problem = prequential(answer.target, answer.base), answer.problem
    markers = problem.model.recordings.markers
    misfit = np.sqrt(scores.misfit.reshape(-1, 3).mean(axis=1))
    return {
        "sentence": in_words(scores, markers, problem.rules.level, problem.timed),
        "block_edges_s": scores.edges.tolist(),
        "prequential_score": scores.score.tolist(),
        "block_p": scores.p.tolist(),
        "marker_misfit": dict(zip(markers, misfit.tolist(), strict=True)),
    }


def _candidate(answer: Answer, row: ScoreRow, tests: ScoreTests, refit: float | None) -> dict[str, Any]:
    coordinates = answer.problem.coordinates
    alike: list[tuple[float, str]] = []
    at: dict[str, float] = {}
    if row.probe is not None:
        alike = [
            (round(likeness(row.probe.mark, other.probe.mark), 4), other.name)
            for other in tests.rows
            if other is not row and other.probe is not None
        ]
        point = answer.base.x.copy()
        for index, value in row.probe.point.items():
            point[index] = value
        named = coordinates.named(point)
        at = {coordinates.names[i]: named[coordinates.names[i]] for i in row.probe.point}
    return {
        "mechanism": row.name,
        "visible": row.probe is not None,
        "statistic": row.lm,
        "degrees_of_freedom": row.rank,
        "p": row.p,
        "adjusted_p": row.adjusted_p,
        "would_explain": row.lm / max(float(tests.fit.residual @ tests.fit.residual), 1e-300),
        "tried_at": at,
        "log_bayes_factor": refit,
        "named": any(step.name == row.name for step in answer.steps),
        "cosines": [{"mechanism": name, "cosine": cosine} for cosine, name in sorted(alike, reverse=True)[:6]],
    }


def force_power(unit: str) -> int:
    """Power of the unit of force in a unit such as "kg", "N/m", "Pa s" or "1/Pa"; exponents of its parts do not count.

    1 for masses, forces and stiffnesses, -1 for compliances. If every such parameter is multiplied by one factor to
    that power, no motion changes. Positions under commanded lengths therefore do not determine the factor (Buckingham's
    theorem).
    """
    above, *below = [sum(part in FORCES for part in re.findall(r"[A-Za-z]+", side)) for side in unit.split("/")]
    return above - sum(below)
