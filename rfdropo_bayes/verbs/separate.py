"""``rfdropo audit --separate``: which mechanisms the recordings tell apart; separation.json, .md and .png."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rfdropo_bayes.audit.audit_problem import AuditProblem
from rfdropo_bayes.audit.fit import Fit
from rfdropo_bayes.audit.journal import Journal
from rfdropo_bayes.audit.pipeline import first_target
from rfdropo_bayes.audit.separation import Separation, separate
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import write_json, write_text
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import hashes, run_folder
from rfdropo_bayes.report import software_versions
from rfdropo_bayes.report.separation_table import separation_figure, separation_markdown
from rfdropo_bayes.report.summary import combined_hash
from rfdropo_bayes.verbs.audit import build_problem, start_values

RESULT, TABLE, FIGURE, JOURNAL = "separation.json", "separation.md", "separation.png", "checkpoints/separation"
DRAWS = 1000
MILLIMETRES = 1e3


def separate_mechanisms(
    model: Model,
    out: Path,
    *,
    base: Path | None = None,
    seed: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    report: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Fit the experiment's base model with and without the mechanisms of its table [separation].

    Args:
        model: of an experiment file, whose ``fit`` recordings are used.
        out: folder to write to.
        base: folder of an earlier calibration, from whose posterior means the model without mechanisms starts.
        seed: of the intervals of sizes; that of the file by default.
        resume: go on from what an interrupted run has left in ``out``.
        overwrite: start anew whatever ``out`` holds.
        report: called with a line of words now and then.

    Returns:
        the content of separation.json.

    Raises:
        InputError: bad input, before anything long has started.
    """
    settings = model.settings
    table = settings.separation
    if table is None:
        raise InputError(
            "has no [separation]",
            where=model.title if model.file is None else str(model.file.path),
            remedy="name the mechanisms to tell apart",
        )
    both = [name for name in table.mechanisms if name in model.spec.sources]
    if both:
        raise InputError(
            f"{both[0]!r} is in the base model", where="[separation] mechanisms", remedy="leave it out of one of them"
        )
    fitted = model.recordings("fit")
    start, seed = start_values(base), settings.seed if seed is None else seed
    names = table.mechanisms
    problem = build_problem(model.spec, settings.audit, fitted, [], seed, start=start, names=names)
    given: dict[str, Any] = {"tables": model.tables(), "folder": model.folder, "data": hashes(fitted)}
    given["options"] = {"base": base, "seed": seed}
    with run_folder(out, "separate", **given, resume=resume, overwrite=overwrite) as out:
        coordinates = problem.coordinates
        found = separate(
            first_target(problem, Journal(out / JOURNAL, resume=resume)),
            problem.candidates,
            table.groups,
            coordinates.null if start is None else coordinates.encode(start),
            report,
        )
        content = {
            **record_separation(found, problem),
            "seed": seed,
            "versions": software_versions(),
            "data_sha256": combined_hash([trajectory.sha256 for trajectory in fitted]),
        }
        write_json(out / RESULT, content, finite=True)
        write_text(out / TABLE, separation_markdown(content))
        separation_figure(content).savefig(out / FIGURE)
    return content


def record_separation(found: Separation, problem: AuditProblem) -> dict[str, Any]:
    """What was found as plain values; evidences in nats, lengths in mm where a name says so."""
    noise, names = found.target.noise.first, list(found.groups)
    return {
        "noise": {
            "source": noise.source,
            "standard_deviation_mm": (MILLIMETRES * noise.scale).tolist(),
            "autocorrelation": noise.autocorrelation.tolist(),
        },
        "rmse_none_mm": MILLIMETRES * found.none.rmse,
        "rmse_all_mm": MILLIMETRES * found.whole.rmse,
        "log_evidence_all_over_none": found.whole.fit.log_evidence - found.none.fit.log_evidence,
        "groups": {
            name: {
                "members": list(found.groups[name]),
                "gain_alone": found.gain(name),
                "rmse_alone_mm": MILLIMETRES * found.alone[name].rmse,
                "loss_without": found.loss(name),
                "rmse_without_mm": MILLIMETRES * found.without[name].rmse,
                "needed": found.needed(name),
                "own_share": found.own[name],
                "sizes_with_all": _sizes(found.whole.fit, found.groups[name], problem),
                "sizes_alone": _sizes(found.alone[name].fit, found.groups[name], problem),
            }
            for name in names
        },
        "cosines": [[found.cosine(a, b) if a != b else 1.0 for b in names] for a in names],
        "rollouts": found.rollouts,
    }


def _sizes(fit: Fit, members: Sequence[str], problem: AuditProblem) -> dict[str, Any]:
    """Medians and 90 % intervals of mechanisms' parameters, from the normal approximation."""
    coordinates = problem.coordinates
    draws = fit.draws(np.random.default_rng([problem.seed, 5]), DRAWS, *coordinates.bounds)
    values = coordinates.values(draws)
    indices = [i for c in problem.candidates if c.name in members for i in c.indices]
    quantiles = {i: np.quantile(values[:, i], [0.05, 0.5, 0.95]) for i in indices}
    return {
        coordinates.names[i]: {
            "q05": float(low),
            "median": float(middle),
            "q95": float(high),
            "unit": coordinates.space.parameters[i].spec.unit,
        }
        for i, (low, middle, high) in quantiles.items()
    }
