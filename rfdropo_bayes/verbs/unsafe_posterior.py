"""Cautions of earlier results on a posterior used for training. They are read from files, not recomputed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.discrepancy.verdict import NEGLIGIBLE, NO_DISCREPANCY, PARTLY, UNEXPLAINED
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment_file import read_tables
from rfdropo_bayes.model.run_folder import RUN
from rfdropo_bayes.report.run_files import CONFIG, SUMMARY
from rfdropo_bayes.results.audited import AUDIT, EXTENDED
from rfdropo_bayes.results.calibrated import Calibration

NAMED = 3  # reasons that the warning gives, the worst


def posterior_caution(source: Calibration | Path, width: float = 1.0) -> Caution | None:
    """A caution if a calibration is not safe to randomise over, or an audit of its recordings found that its model
    lacks an effect; None otherwise.

    Audits are searched in the calibration's folder and its sibling folders; only audits that share a recording count.

    Args:
        source: the calibration, its folder or its posterior.nc.
        width: factor by which the training widens the posterior.
    """
    if isinstance(source, Calibration):
        folder, content = source.folder, source.content
    else:
        folder = Path(source) if Path(source).is_dir() else Path(source).parent
        content = _read(folder / SUMMARY)
    own = content.get("randomisation", {})
    reasons = list(own["reasons"][:NAMED]) if own.get("verdict") == "unsafe" else []
    reasons += [] if folder is None else _audited(folder.resolve(), content)
    if not reasons:
        return None
    where = "the posterior" if folder is None else str(folder)
    wider = ", or draw wider with [training] width" if width <= 1.0 else f". Width {width:g} may make up for some of it"
    return Caution(
        Code.UNSAFE_POSTERIOR,
        f"{where} is not safe to train on: {'; '.join(reasons)}. A narrow posterior of a wrong model transfers worse "
        f"than none: audit the model and calibrate extended.toml{wider}",
    )


def _audited(folder: Path, summary: Mapping[str, Any]) -> list[str]:
    """Effects that the calibrated model lacks according to audits of its recordings; empty if an audit passed this
    model.
    """
    own, reasons = _terms(folder / CONFIG), []
    for path in sorted(folder.parent.glob(f"*/{AUDIT}")):
        audit = _read(path)
        verdict, place = audit.get("verdict"), path.parent
        if not _same_recordings(folder, summary, place, audit):
            continue
        if verdict in (NO_DISCREPANCY, NEGLIGIBLE) and own is not None and own == _terms(place / CONFIG):
            return []
        extended = _terms(place / EXTENDED)
        if own is not None and extended is not None and extended - own:
            reasons.append(
                f"the audit in {place} names the effects that its model lacks, see {path.with_name(EXTENDED)}"
            )
        elif verdict in (PARTLY, UNEXPLAINED):
            reasons.append(f"the audit in {place} leaves a discrepancy unexplained")
    return reasons


def _same_recordings(folder: Path, summary: Mapping[str, Any], place: Path, audit: Mapping[str, Any]) -> bool:
    """Whether two runs share a recording, by their run.json; else whether they have the same recordings."""
    first, second = (set(_read(each / RUN).get("settings", {}).get("data", {}).values()) for each in (folder, place))
    if first and second:
        return bool(first & second)
    return "data_sha256" in summary and audit.get("data_sha256") == summary["data_sha256"]


def _terms(experiment: Path) -> set[str] | None:
    """Mechanisms and laws of a run's model; None if its file does not state them."""
    try:
        model = read_tables(experiment).get("model", {})
    except InputError:
        return None
    return {json.dumps(term, sort_keys=True) for key in ("mechanisms", "laws") for term in model.get(key, [])}


def _read(path: Path) -> dict[str, Any]:
    """The content of a JSON file, empty if it cannot be read, as training does not need it."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
