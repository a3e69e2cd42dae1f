"""Result of a calibration, as an object that shows itself, draws its figures and writes its files."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from PIL import Image

from rfdropo_bayes.cautions import Caution, read_cautions
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import write_text
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.posteriors import PosteriorRecord, ProductOfPowers, RecordingPrediction
from rfdropo_bayes.report import render_page, write_run
from rfdropo_bayes.report.posterior_figures import draw_before_and_after, draw_pairs, pair_figure, paired_names
from rfdropo_bayes.report.run_files import POSTERIOR
from rfdropo_bayes.report.trajectory_figures import AXES, draw_band
from rfdropo_bayes.results.named_entries import entry_number
from rfdropo_bayes.tables import nearest

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rfdropo_bayes.posteriors import InferenceData

SHOWN_PAIRS = 4  # parameters of the picture in a notebook
COLOURS = 64  # of that picture
LABELS = 0.18  # share of the axes that labels beside and below a pair plot take


@dataclass(frozen=True)
class Calibration:
    """A posterior with its predictions, and its summary.

    Attributes:
        record: draws and predictions as plain arrays.
        content: content of summary.json.
        config: the experiment as TOML.
        model: fitted model; None if it cannot be rebuilt from files.
        folder: folder with the calibration's files, if written.
    """

    record: PosteriorRecord
    content: Mapping[str, Any]
    config: str
    model: Model | None = None
    folder: Path | None = None

    @classmethod
    def of_posterior(cls, folder: Path, model: Model) -> Calibration:
        """The posterior in a folder with the model that was fitted, and no further content.

        Raises:
            InputError: the folder has no posterior, or a damaged posterior.
        """
        return cls(PosteriorRecord.load(folder / POSTERIOR), {"title": model.title}, "", model, folder)

    @cached_property
    def idata(self) -> InferenceData:
        """Draws, prior draws, predictions and sampler statistics in ArviZ's layout."""
        return self.record.inference_data()

    @property
    def summary(self) -> pd.DataFrame:
        """Mean, standard deviation, 5 and 95 % quantile, unit and more of each parameter."""
        return pd.DataFrame.from_dict(dict(self.content["parameters"]), orient="index")

    @property
    def cautions(self) -> list[Caution]:
        """Reasons to doubt the draws."""
        return read_cautions(self.content.get("cautions", []))

    @property
    def verdict(self) -> str:
        """Verdict on randomisation over the posterior: ``"safe"``, ``"with care"`` or ``"unsafe"``."""
        return str(self.content["randomisation"]["verdict"])

    @property
    def sentence(self) -> str:
        """The verdict with reasons."""
        return str(self.content["randomisation"]["sentence"])

    @property
    def log_evidence(self) -> tuple[float | None, float | None]:
        """Value and standard deviation [nats]; None if the method has none."""
        evidence = self.content["log_evidence"]
        return evidence["value"], evidence["sd"]

    @property
    def rmse(self) -> pd.DataFrame:
        """Root mean square distance over time of each marker [mm], of fitted and of unseen recordings."""
        return pd.DataFrame(dict(self.content["rmse"]))

    @property
    def phi(self) -> Mapping[str, Any] | None:
        """Distribution to randomise over, of RF-DROPO; else None."""
        return self.content["phi"]

    def plot_pair(self, names: Sequence[str] | None = None, ax: Axes | None = None) -> Axes | Figure:
        """Draw every pair of parameters with their 50 % and 90 % regions.

        Args:
            names: names of the parameters; the most correlated six by default.
            ax: axes to draw on; a new figure by default.
        """
        chosen = self._known(names) if names is not None else paired_names(self.record)
        if ax is None:
            return pair_figure(self.record, chosen)
        ax.set_axis_off()
        size = (1.0 - LABELS) / len(chosen)
        places = LABELS + size * np.arange(len(chosen))
        cells = [[(left, low, 0.92 * size, 0.92 * size) for left in places] for low in places[::-1]]
        draw_pairs(
            self.record, chosen, np.array([[ax.inset_axes(cell) for cell in row] for row in cells], dtype=object)
        )
        return ax

    def plot_prior_posterior(self, name: str, ax: Axes | None = None) -> Axes:
        """Draw the density of one parameter before and after the data."""
        (name,) = self._known([name])
        info = next(info for info in self.record.parameters if info.name == name)
        axes = axes_or_new(ax)
        logarithmic = name in {q.name for q in self.record.derived if isinstance(q, ProductOfPowers)}
        draw_before_and_after(axes, info, self.record.flat(name), self.record.prior.get(name), log=logarithmic)
        handles, labels = axes.get_legend_handles_labels()
        axes.legend(dict(zip(labels, handles, strict=True)).values(), dict.fromkeys(labels))
        return axes

    def plot_fit(
        self, recording: str | int = 0, marker: str | int = -1, axis: str | None = None, ax: Axes | None = None
    ) -> Axes:
        """Draw one coordinate of one marker over time: measured, with its 50 % and 90 % predictive bands.

        Args:
            recording: name or number of the recording, fitted recordings first.
            marker: name or number of the marker; the last by default.
            axis: ``"x"``, ``"y"`` or ``"z"``; the axis of largest motion by default.
            ax: axes to draw on.

        Raises:
            InputError: no such recording, marker or axis.
        """
        shown = self.prediction(recording)
        index = entry_number(marker, shown.marker_names, "marker")
        moved = np.ptp(
            np.where(shown.mask[:, index, None], shown.observed[:, index], shown.observed[:1, index]), axis=0
        )
        axes = axes_or_new(ax)
        draw_band(axes, shown, index, int(np.argmax(moved)) if axis is None else entry_number(axis, AXES, "axis"))
        axes.set_xlabel("time [s]")
        axes.set_title(shown.name)
        axes.legend()
        return axes

    def prediction(self, recording: str | int = 0) -> RecordingPrediction:
        """Measured and predicted motion of a recording, by name or number.

        Raises:
            InputError: no such recording.
        """
        known = {shown.name: shown for shown in self.record.recordings}
        return known[list(known)[entry_number(recording, list(known), "recording")]]

    def _known(self, names: Sequence[str]) -> list[str]:
        for name in names:
            if name not in self.record.posterior:
                raise InputError(
                    f"no parameter {name!r}", where="calibration", remedy=nearest(name, self.record.posterior)
                )
        return list(names)

    def report(self, path: Path | str) -> Path:
        """Write the report, one HTML page that needs nothing else; return its path."""
        write_text(Path(path), render_page(self.record, self.content, self.config))
        return Path(path)

    def save(self, folder: Path | str) -> Path:
        """Write posterior.nc, summary.json, config.toml and report.html; return the path of the report."""
        return write_run(Path(folder), self.record, self.content, self.config)

    def _repr_html_(self) -> str:
        names = paired_names(self.record)[:SHOWN_PAIRS]
        columns = ["mean", "sd", "q05", "q95", "unit"]
        cautions = "".join(f"<li>{escape(caution.sentence)}</li>" for caution in self.cautions)
        return (
            f"<p><b>{escape(str(self.content['title']))}</b>: {escape(self.sentence)}</p>"
            f"{self.summary[columns].to_html(float_format=lambda x: f'{x:.4g}')}"
            + (f"<ul>{cautions}</ul>" if cautions else "")
            + (picture_tag(pair_figure(self.record, names)) if len(names) > 1 else "")
        )

    def __repr__(self) -> str:
        return f"{self.sentence}\n{self.summary[['mean', 'sd', 'q05', 'q95', 'unit']].to_string()}"


def axes_or_new(ax: Axes | None) -> Axes:
    """The given axes, or the axes of a new figure."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.figure(layout="constrained").add_subplot()


def picture_tag(figure: Figure) -> str:
    """A figure as an image with few colours inside HTML, which a notebook stores."""
    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=96)
    Image.open(drawn).convert("RGB").quantize(COLOURS).save(small, format="png", optimize=True)
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(small.getvalue()).decode("ascii")}"/>'
