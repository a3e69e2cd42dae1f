"""The files a calibration leaves, and the report made again from them."""

from __future__ import annotations

from pathlib import Path

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import PosteriorRecord
from rfdropo_bayes.report.facts import RunFacts
from rfdropo_bayes.report.page import render_page
from rfdropo_bayes.report.summary import build_summary, read_summary, write_summary, write_text

POSTERIOR, SUMMARY, REPORT, CONFIG = "posterior.nc", "summary.json", "report.html", "config.toml"


def write_outputs(record: PosteriorRecord, facts: RunFacts, out: Path) -> Path:
    """Write posterior.nc, summary.json and report.html; returns the path of the last."""
    record.save(out / POSTERIOR)
    write_summary(build_summary(record, facts), out / SUMMARY)
    return rebuild_report(out)


def rebuild_report(folder: Path) -> Path:
    """Write report.html from the other files of a run, without computing anything anew.

    Raises:
        InputError: the folder does not hold a finished calibration.
    """
    folder = Path(folder)
    record, summary = PosteriorRecord.load(folder / POSTERIOR), read_summary(folder / SUMMARY)
    try:
        config = (folder / CONFIG).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}", where=str(folder / CONFIG), remedy="give the folder of a calibration"
        ) from None
    write_text(folder / REPORT, render_page(record, summary, config))
    return folder / REPORT
