"""What earlier results say against a posterior that a training draws from. They are read; nothing is computed anew."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rfdropo_bayes.audit.verdict import DESCRIBED, EQUIVALENT, EXPLAINED, PARTLY, UNEXPLAINED
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment_file import read_tables
from rfdropo_bayes.report.run_files import CONFIG, SUMMARY
from rfdropo_bayes.results.audited import AUDIT, EXTENDED
from rfdropo_bayes.results.calibrated import Calibration

NAMED = 3  # reasons that the warning gives, the worst


def posterior_caution(source: Calibration | Path) -> Caution | None:
    """A caution where a calibration is not safe to randomise over, or an audit of its recordings says that its model
    lacks something; None where nothing speaks against it.

    Audits are looked for in the calibration's folder and in those beside it, by the hash of their recordings.

    Args:
        source: the calibration, its folder or its posterior.nc.
    """
    if isinstance(source, Calibration):
        folder, content = source.folder, source.content
    else:
        folder = Path(source) if Path(source).is_dir() else Path(source).parent
        content = _read(folder / SUMMARY)
    own = content.get("randomisation", {})
    reasons = list(own["reasons"][:NAMED]) if own.get("verdict") == "unsafe" else []
    reasons += [] if folder is None else _audited(folder, content)
    if not reasons:
        return None
    where = "the posterior" if folder is None else str(folder)
    return Caution(
        Code.UNSAFE_POSTERIOR,
        f"{where} is not safe to train on: {'; '.join(reasons)}. A narrow posterior of a wrong model transfers worse "
        "than none: audit the model and calibrate extended.toml, or draw wider with [training] width",
    )


def _audited(folder: Path, summary: Mapping[str, Any]) -> list[str]:
    """What audits of the same recordings found that the calibrated model lacks."""
    found = []
    for path in sorted(folder.parent.glob(f"*/{AUDIT}")):
        audit, model = _read(path), _model(folder)
        if "data_sha256" not in summary or audit.get("data_sha256") != summary["data_sha256"]:
            continue
        if audit["verdict"] in (PARTLY, UNEXPLAINED):
            found.append(f"the audit in {path.parent} leaves a discrepancy unexplained")
        elif audit["verdict"] in (EXPLAINED, EQUIVALENT, DESCRIBED) and model and model == _model(path.parent):
            found.append(f"the audit of this model names what it lacks, see {path.with_name(EXTENDED)}")
    return found


def _model(folder: Path) -> Any:
    """What a run's [model] says; None where its folder does not tell."""
    try:
        return read_tables(folder / CONFIG).get("model")
    except InputError:
        return None


def _read(path: Path) -> dict[str, Any]:
    """The content of a JSON file, empty where it cannot be read: it is not what the training needs."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
