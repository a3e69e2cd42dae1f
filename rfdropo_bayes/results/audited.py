"""Result of an audit, as an object that shows itself and writes its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import xarray as xr

from rfdropo_bayes.cautions import Caution, read_cautions
from rfdropo_bayes.discrepancy.pipeline import Answer
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import output_folder, whole, write_json, write_text
from rfdropo_bayes.model.experiment import Experiment
from rfdropo_bayes.model.experiment_file import describe
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.model_spec import RunSettings, Workpiece, spec_of
from rfdropo_bayes.report import audit_figures as figures
from rfdropo_bayes.report.audit_figures import Shown
from rfdropo_bayes.report.sentences import sentences
from rfdropo_bayes.report.trajectory_figures import AXES
from rfdropo_bayes.results.calibrated import axes_or_new
from rfdropo_bayes.results.named_entries import entry_number
from rfdropo_bayes.tables import nearest, parse_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

AUDIT, EXTENDED, REPORT, RESIDUALS = "audit.json", "extended.toml", "report.html", "residuals.nc"


@dataclass(frozen=True)
class Audit:
    """The effects that a simulator lacks, by name.

    Attributes:
        content: content of audit.json.
        tables: experiment file with the adopted extensions, as tables.
        page: the report as HTML.
        robot: audited robot, if made in Python; None for a robot that the tables name.
        base: folder that paths in the tables are relative to.
        folder: folder with the audit's files, if written.
        shown: data of the figures; None for an audit read from files.
        answer: answer with fits; None for an audit read from files.
        residuals: residuals of the base and the final model, and signals at ports; None if it was read from files.
    """

    content: Mapping[str, Any]
    tables: Mapping[str, Any]
    page: str
    robot: Workpiece | None
    base: Path
    folder: Path | None = None
    shown: Shown | None = None
    answer: Answer | None = None
    residuals: xr.Dataset | None = None

    @property
    def verdict(self) -> str:
        """explained, equivalent, partly_explained, described, unexplained, negligible, no_discrepancy or no_verdict."""
        return str(self.content["verdict"])

    @property
    def sentence(self) -> str:
        """The verdict in words that a lab can act on."""
        return str(self.content["sentence"])

    @property
    def cautions(self) -> list[Caution]:
        """Reasons to doubt the answer or its recordings."""
        return read_cautions(self.content["cautions"])

    @cached_property
    def findings(self) -> pd.DataFrame:
        """One row per parameter of the named effects: mean, 5 and 95 % quantile, unit, and explained share."""
        columns = ("explained_fraction", "adjusted_p", "log_bayes_factor")
        rows = [
            {"mechanism": finding["mechanism"], "parameter": name, **row, **{key: finding[key] for key in columns}}
            for finding in self.content["findings"]
            for name, row in finding["parameters"].items()
        ]
        index = ["mechanism", "parameter"]
        return pd.DataFrame(rows).set_index(index) if rows else pd.DataFrame(columns=["mean", "unit", *columns])

    @cached_property
    def candidates(self) -> pd.DataFrame:
        """Every mechanism that was tried, with its statistics."""
        return pd.DataFrame(self.content["candidates"])

    @property
    def gain(self) -> Mapping[str, Any] | None:
        """Errors on unseen recordings without and with the adopted effects; None if none was adopted."""
        return self.content["gain"]

    @property
    def extended(self) -> Model:
        """The model with the mechanisms that unseen recordings support, with priors for their parameters."""
        experiment = parse_table(Experiment, self.tables, where=EXTENDED)
        return Model.of(spec_of(experiment, self.base, self.robot), RunSettings.of(experiment))

    def plot_residual(self, against: str = "time", ax: Axes | None = None) -> Axes:
        """Draw residuals of the base model on the fitted recordings against a possible cause.

        Args:
            against: time, command, rate, direction (sign of the rate), position, or tension.
            ax: axes to draw on; a new figure by default.

        Raises:
            InputError: no such cause. As for all figures: the audit was read from files, which do not hold them.
        """
        residuals = self._shown().residuals
        known = figures.causes(residuals)
        if against not in known:
            raise InputError(f"no cause {against!r}", where="audit", remedy=nearest(against, known))
        axes = axes_or_new(ax)
        figures.draw_residual(axes, residuals, against)
        return axes

    def plot_blocks(self, ax: Axes | None = None) -> Axes:
        """Draw when each model fails: mean square of the means of blocks of rows, 1 if a model is right."""
        axes = axes_or_new(ax)
        figures.draw_blocks(axes, self._shown())
        axes.legend()
        return axes

    def plot_likeness(self, ax: Axes | None = None) -> Axes:
        """Draw the cosines between the candidates' signatures, after projection on the base parameters."""
        axes = axes_or_new(ax)
        figures.draw_cosines(axes, self._shown())
        return axes

    def plot_unseen(self, axis: str = "x", ax: Axes | None = None) -> Axes:
        """Draw the last marker of an unseen recording: measured, base model, extended model.

        Raises:
            InputError: no such axis, no recording was left unseen, or nothing was named.
        """
        if self._shown().unseen is None:
            raise InputError("no unseen recording was predicted", where="audit", remedy="give recordings as test=")
        axes = axes_or_new(ax)
        figures.draw_unseen(axes, self._shown(), entry_number(axis, AXES, "axis"))
        axes.legend()
        return axes

    def plot_remainder(self, ax: Axes | None = None) -> Axes:
        """Draw the final model's residual at the last marker, with two standard deviations.

        Raises:
            InputError: the residual is noise only.
        """
        if self._shown().remainder is None:
            raise InputError(
                "the residuals of the last model are noise: there is no remainder",
                where="audit",
                remedy="draw another figure",
            )
        axes = axes_or_new(ax)
        figures.draw_remainder(axes, self._shown())
        axes.legend()
        return axes

    def _shown(self) -> Shown:
        if self.shown is None:
            raise InputError(
                "an audit read from files has no data for figures",
                where="audit",
                remedy="see its report.html, or audit again",
            )
        return self.shown

    def report(self, path: Path | str) -> Path:
        """Write the report, one HTML page that needs nothing else; return its path."""
        write_text(Path(path), self.page)
        return Path(path)

    def save(self, folder: Path | str) -> Path:
        """Write audit.json, extended.toml, residuals.nc and report.html; return the path of the report."""
        folder = output_folder(Path(folder))
        write_json(folder / AUDIT, self.content, finite=True)
        write_text(folder / EXTENDED, describe(self.tables))
        if self.residuals is not None:
            with whole(folder / RESIDUALS) as partial:
                self.residuals.to_netcdf(partial, engine="h5netcdf")
        return self.report(folder / REPORT)

    def _repr_html_(self) -> str:
        table = self.findings.to_html(float_format=lambda x: f"{x:.3g}") if len(self.findings) else ""
        said = "</p><p>".join(escape(sentence) for sentence in sentences(self.sentence))
        cautions = "".join(f"<li>{escape(caution.sentence)}</li>" for caution in self.cautions)
        listed = f"<ul>{cautions}</ul>" if cautions else ""
        return f"<p><b>{escape(self.verdict.replace('_', ' '))}</b>: {said}</p>{listed}{table}"

    def __repr__(self) -> str:
        said = [caution.sentence for caution in self.cautions]
        return "\n".join([f"{self.verdict}: {self.sentence}", *said])
