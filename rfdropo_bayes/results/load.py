"""Results of earlier runs, as the objects that the functions return."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment_file import read_tables
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.posteriors import PosteriorRecord
from rfdropo_bayes.report import read_summary
from rfdropo_bayes.report.run_files import CONFIG, POSTERIOR, SUMMARY
from rfdropo_bayes.results.audited import AUDIT, EXTENDED, REPORT, Audit
from rfdropo_bayes.results.calibrated import Calibration


def load(folder: Path | str, model: Model | None = None) -> Calibration | Audit:
    """Read the folder of a calibration or of an audit.

    Args:
        folder: folder of the run.
        model: calibrated model, for predictions; by default rebuilt from the folder's config.toml. No file describes
            a black box, or a mechanism, that was made in Python.

    Raises:
        InputError: the folder holds neither, or a damaged file.
    """
    folder = Path(folder)
    if (folder / AUDIT).is_file() and ((folder / EXTENDED).is_file() or not (folder / POSTERIOR).is_file()):
        return _audit(folder)  # a report's folder may hold a calibration, and the answer of an audit beside it
    if not (folder / POSTERIOR).is_file():
        raise InputError(
            "holds neither a calibration nor an audit", where=str(folder), remedy="give the folder that --out named"
        )
    config = folder / CONFIG
    text = config.read_text(encoding="utf-8") if config.is_file() else ""
    record, content = PosteriorRecord.load(folder / POSTERIOR), read_summary(folder / SUMMARY)
    return Calibration(record, content, text, _model(config) if model is None else model, folder)


def _model(config: Path) -> Model | None:
    try:
        return Model.read(config)
    except InputError:  # of something that no file describes
        return None


def _audit(folder: Path) -> Audit:
    try:
        content: Any = json.loads((folder / AUDIT).read_text(encoding="utf-8"))
        page = (folder / REPORT).read_text(encoding="utf-8") if (folder / REPORT).is_file() else ""
    except (OSError, ValueError) as error:
        raise InputError(f"is not readable ({error})", where=str(folder), remedy="audit again") from None
    tables = read_tables(folder / EXTENDED)
    return Audit(content, tables, page, None, folder.resolve(), folder)
