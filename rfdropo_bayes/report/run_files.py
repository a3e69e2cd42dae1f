"""The files of a run's folder that come after inference: posterior.nc, summary.json, config.toml, report.html."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rfdropo_bayes.files import output_folder, write_text
from rfdropo_bayes.posteriors import PosteriorRecord
from rfdropo_bayes.report.page import render_page
from rfdropo_bayes.report.summary import read_summary, write_summary

POSTERIOR, SUMMARY, CONFIG, REPORT = "posterior.nc", "summary.json", "config.toml", "report.html"


def write_run(folder: Path, record: PosteriorRecord, summary: Mapping[str, Any], config: str) -> Path:
    """Write all four files and return the path of the report.

    The numbers are written before the pictures are drawn, so that a stop while drawing loses nothing.

    Raises:
        InputError: if the folder cannot be written.
    """
    folder = output_folder(folder)
    record.save(folder / POSTERIOR)
    write_summary(summary, folder / SUMMARY)
    write_text(folder / CONFIG, config)
    write_text(folder / REPORT, render_page(record, summary, config))
    return folder / REPORT


def rebuild_report(folder: Path) -> Path:
    """Draw report.html again from the folder's content, without new computation; return its path.

    Raises:
        InputError: if the folder lacks posterior.nc or summary.json, or one of them is damaged.
    """
    folder = Path(folder)
    summary = read_summary(folder / SUMMARY)
    record = PosteriorRecord.load(folder / POSTERIOR)
    try:
        config = (folder / CONFIG).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        config = ""  # the page says that it is missing
    write_text(folder / REPORT, render_page(record, summary, config))
    return folder / REPORT
