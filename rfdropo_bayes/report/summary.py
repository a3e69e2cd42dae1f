"""summary.json: the numbers of a run under names that other programs rely on."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import write_json
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, central_interval, cut_off_at, summarise
from rfdropo_bayes.report.coverage import Coverage, coverage
from rfdropo_bayes.report.facts import RunFacts
from rfdropo_bayes.report.headline import headline
from rfdropo_bayes.report.identifiability import identify
from rfdropo_bayes.report.randomisation_safety import rate_safety
from rfdropo_bayes.report.residuals import error_correlations
from rfdropo_bayes.report.scores import MILLIMETRES, ErrorFigures, MeasuredPath, score
from rfdropo_bayes.tables import parse_table

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class ParameterRow:
    """One line of the posterior table; physical (SI) units."""

    # name, unit, description: facts of the parameter
    name: str
    unit: str
    description: str
    # mean, sd, q05, median, q95: statistics of the draws
    mean: float
    sd: float
    q05: float
    median: float
    q95: float
    at_bound: bool  # the posterior is piled up at a hard bound, or at an end of its prior
    bound: str | None  # "low", "high" or None
    # prior_q05, prior_q95: quantiles of the prior draws, None without them
    prior_q05: float | None
    prior_q95: float | None
    # posterior over prior standard deviation, of the logarithm if the prior is logarithmic and for products
    contraction: float | None
    # ess_bulk, ess_tail, mcse_mean, r_hat: ArviZ's diagnostics; ``r_hat`` is NaN for a single chain
    ess_bulk: float
    ess_tail: float
    mcse_mean: float
    r_hat: float
    derived: bool  # a function of other parameters
    # parameter, owner: name without the owner, and the recording or group that has it; see `Scope`
    parameter: str
    owner: str

    def as_dict(self) -> dict[str, Any]:
        """Everything but the name, for summary.json."""
        return {key: value for key, value in asdict(self).items() if key != "name"}


def posterior_table(record: PosteriorRecord) -> list[ParameterRow]:
    """One row per parameter and derived quantity."""
    diagnostics = summarise(record.posterior)
    free = {info.name for info in record.free}
    rows = []
    for info in record.parameters:
        draws, prior = record.flat(info.name), record.prior.get(info.name)
        q05, q95 = central_interval(draws)
        bound = bound_reached(draws, info) if info.name in free else None
        before = (None, None) if prior is None else np.quantile(prior, [0.05, 0.95]).tolist()
        rows.append(
            ParameterRow(
                info.name,
                info.unit,
                info.description,
                float(draws.mean()),
                float(draws.std(ddof=1)) if len(draws) > 1 else 0.0,
                float(q05),
                float(np.median(draws)),
                float(q95),
                bound is not None,
                bound,
                before[0],
                before[1],
                None if prior is None else _contraction(draws, prior, log=info.logarithmic or info.name not in free),
                diagnostics[info.name]["ess_bulk"],
                diagnostics[info.name]["ess_tail"],
                diagnostics[info.name]["mcse_mean"],
                diagnostics[info.name]["r_hat"],
                info.name not in free,
                info.parameter,
                info.scope.owner,
            )
        )
    return rows


def bound_reached(draws: Float[np.ndarray, " n"], info: ParameterInfo) -> str | None:
    """The end of the prior, "low" or "high", at which a posterior accumulates; None without accumulation.

    If the prior is logarithmic, the comparison is in logarithms; see `cut_off_at`.
    """
    return cut_off_at(draws, *info.ends, logarithmic=info.logarithmic)


def _contraction(draws: Float[np.ndarray, " n"], prior: Float[np.ndarray, " m"], *, log: bool) -> float | None:
    """Ratio of standard deviations, of the values or of their logarithms."""
    if log and np.all(draws > 0) and np.all(prior > 0):
        draws, prior = np.log(draws), np.log(prior)
    prior_deviation = float(np.std(prior))
    return float(np.std(draws)) / prior_deviation if prior_deviation > 0 else None


class _Open(BaseModel):
    model_config = ConfigDict(extra="allow")


class ParameterSummary(_Open):
    """Posterior of one parameter, in its unit."""

    mean: float
    sd: float
    q05: float
    q95: float
    unit: str
    at_bound: bool
    parameter: str
    owner: str


class Evidence(_Open):
    """Log evidence in nats; null if the method has none."""

    value: float | None
    sd: float | None


class Errors(_Open):
    """Root mean square distance over time of each marker [mm]; empty without recordings of that role."""

    fit: dict[str, float | None]
    test: dict[str, float | None]


class Summary(_Open):
    """The stable part of summary.json; more keys may follow."""

    schema_version: int
    status: str
    engine: str
    seconds: float
    rollouts: float
    parameters: dict[str, ParameterSummary]
    log_evidence: Evidence
    rmse: Errors


def effective_draws(record: PosteriorRecord, rows: Sequence[ParameterRow], details: Mapping[str, Any]) -> float | None:
    """Number of independent draws that a posterior is worth; None for draws that are no posterior.

    At most the number of distinct draws: a sampler without budget repeats a few. Weighted draws have a number of their
    own; for other draws it is the smallest of ArviZ's numbers per parameter.
    """
    if record.log_likelihood is None:
        return None
    names = [info.name for info in record.free]
    distinct = len(np.unique(np.stack([record.flat(name) for name in names], axis=1), axis=0))
    weighed = details.get("effective_draws")
    if weighed is None:
        weighed = min((row.ess_bulk for row in rows if row.name in names and row.ess_bulk > 0.0), default=np.inf)
    return float(min(distinct, weighed))


def build_summary(record: PosteriorRecord, facts: RunFacts) -> dict[str, Any]:
    """The content of summary.json, ready for JSON: values that are not finite become null, with the reason under
    ``not_available``.
    """
    figures = model_errors(record)
    shares, rows = coverage(record.recordings), posterior_table(record)
    summary = {
        "schema_version": SCHEMA_VERSION,
        **{key: getattr(facts, key) for key in ("title", "status", "robot", "method", "engine", "seed")},
        "algorithm": facts.details.get("algorithm", facts.method),
        "seconds": facts.seconds,
        "rollouts": facts.rollouts,
        "evaluations": facts.evaluations,
        "excluded": dict(facts.excluded),
        "effective_draws": effective_draws(record, rows, facts.details),
        "parameters": {row.name: row.as_dict() for row in rows},
        "log_evidence": dict(zip(("value", "sd"), facts.log_evidence or (None, None), strict=True)),
        "rmse": {role: dict(errors.over_time) if errors else {} for role, errors in figures.items()},
        "errors": {role: asdict(errors) if errors else None for role, errors in figures.items()},
        "baselines": {name: asdict(errors) for name, errors in facts.baselines.items()},
        "fitted_commands": list(facts.fitted_commands),
        "noise_floor_mm": facts.noise_floor and {m: MILLIMETRES * s for m, s in facts.noise_floor.items()},
        "residuals": {name: dict(check._asdict()) for name, check in facts.residuals.items()},
        "error_correlation": {role: error_correlations(record.recordings, role) for role in ("fit", "test")},
        "coverage": {str(p): share for p, share in shares.over_all.items()},
        "coverage_by_marker": _by_marker(shares),
        "coverage_by_role": {
            role: _by_marker(coverage([r for r in record.recordings if r.split == role])) for role in ("fit", "test")
        },
        "identifiability": [{**asdict(c), "contraction": c.contraction} for c in identify(record)],
        "recordings": [asdict(recording) for recording in facts.recordings],
        "data_sha256": combined_hash([recording.sha256 for recording in facts.recordings]),
        "model": dict(facts.model),
        "phi": facts.phi and {name: dict(values) for name, values in facts.phi.items()},
        "optimum": facts.optimum and dict(facts.optimum),
        "objects": {name: asdict(scores) for name, scores in facts.objects.items()},
        "cautions": [caution.as_dict() for caution in facts.cautions],
        "warnings": [caution.sentence for caution in facts.cautions],
        "unseen_sessions": dict(facts.unseen_sessions) or None,
        "limits": list(facts.limits),
        "outline": facts.outline and dict(facts.outline),
        "versions": dict(facts.versions),
        "details": dict(facts.details),
    }
    missing: dict[str, str] = {}
    if facts.log_evidence is None:
        missing["log_evidence"] = f"{facts.method} computes no evidence"
    plain = _plain(summary, "", missing)
    plain["not_available"] = missing
    plain["randomisation"] = rate_safety(record, plain).as_dict()
    plain["headline"] = [*headline(plain), plain["randomisation"]["sentence"]]
    check_summary(plain, where="summary.json")
    return plain


def _by_marker(shares: Coverage) -> dict[str, dict[str, float | None]]:
    return {marker: {str(p): share for p, share in row.items()} for marker, row in shares.markers.items()}


def model_errors(record: PosteriorRecord) -> dict[str, ErrorFigures | None]:
    """Errors of the point predictions, by role."""
    return {
        role: score(
            {r.name: r.central for r in record.recordings if r.split == role},
            [MeasuredPath.of_prediction(r) for r in record.recordings if r.split == role],
        )
        for role in ("fit", "test")
    }


def combined_hash(hashes: list[str]) -> str:
    """One hash for all recordings, in their order."""
    return hashlib.sha256("\n".join(hashes).encode()).hexdigest()


def _plain(value: Any, path: str, missing: dict[str, str]) -> Any:
    """Values in JSON's types; numbers that are not finite become null and are listed."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v, f"{path}.{k}" if path else str(k), missing) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(v, f"{path}[{i}]", missing) for i, v in enumerate(value)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        missing[path] = _reason(path, value)
        return None
    return value


def _reason(path: str, value: float) -> str:
    if path.endswith("r_hat"):
        return "needs at least two chains of at least four draws"
    if path.endswith(("ess_bulk", "ess_tail", "mcse_mean")):
        return "needs at least four draws that are not all equal"
    if path == "log_evidence.sd":
        return "nothing measures it: run more than one replicate"
    return "not a number" if math.isnan(value) else "infinite"


def check_summary(summary: Mapping[str, Any], *, where: str) -> None:
    """Raise InputError if a stable key is missing or of the wrong type."""
    parse_table(Summary, summary, where=where)
    if summary["schema_version"] != SCHEMA_VERSION:
        raise InputError(
            f"schema_version is {summary['schema_version']}, this program reads {SCHEMA_VERSION}",
            where=where,
            remedy="use the version of the program that wrote it",
        )


def write_summary(summary: Mapping[str, Any], path: Path) -> None:
    """Write summary.json.

    Raises:
        InputError: the summary cannot be written.
    """
    write_json(path, summary, finite=True)


def read_summary(path: Path) -> dict[str, Any]:
    """Read summary.json.

    Raises:
        InputError: the summary is missing, is no JSON, or lacks a stable key.
    """
    try:
        summary = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError("no such file", where=str(path), remedy="give the folder of a finished calibration") from None
    except (OSError, ValueError) as error:
        raise InputError(f"is not readable JSON ({error})", where=str(path), remedy="calibrate again") from None
    if not isinstance(summary, dict):
        raise InputError("is not a JSON object", where=str(path), remedy="calibrate again")
    check_summary(summary, where=str(path))
    return summary
