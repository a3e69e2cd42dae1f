"""Result of a prediction, as an object that shows itself, draws its bands and writes its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float

from rfdropo_bayes.cautions import Caution
from rfdropo_bayes.files import output_folder, whole, write_json
from rfdropo_bayes.posteriors import RecordingPrediction
from rfdropo_bayes.report.trajectory_figures import AXES, draw_band
from rfdropo_bayes.results.calibrated import axes_or_new
from rfdropo_bayes.results.named_entries import entry_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEVELS = {"q05": 0.05, "q25": 0.25, "q75": 0.75, "q95": 0.95}
OBJECT = "object"


@dataclass(frozen=True, repr=False)
class Prediction:
    """Prediction of a calibrated simulator for commands that were never run.

    Attributes:
        bands: mean and 5, 25, 75 and 95 % quantiles [m] of the predicted measurement, (time, marker, axis).
        drawn: draws of the predicted measurement.
        group: assumed group of the commands.
        group_fitted: whether the posterior has values of the group; None if groups share all parameters.
        cautions: reasons to doubt the prediction.
        facts: origin of commands and draws, for prediction.json.
        unseen: facts on the error in a session that no fit has seen; empty for other sessions.
    """

    bands: xr.Dataset
    drawn: RecordingPrediction
    group: str = ""
    group_fitted: bool | None = None
    cautions: list[Caution] = field(default_factory=list)
    unseen: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def content(self) -> dict[str, Any]:
        """The content of prediction.json."""
        return {
            **self.facts,
            "group": self.group,
            "group_fitted": self.group_fitted,
            "unseen_session": self.unseen or None,
            "rows": len(self.drawn.time),
            "draws": int(self.drawn.predicted.shape[0]),
            "draws_that_did_not_match_the_first_row": self.bands.attrs["draws_that_did_not_match_the_first_row"],
            "cautions": [caution.as_dict() for caution in self.cautions],
            "unit": "m",
            "frame": self.bands.attrs["frame"],
        }

    @property
    def frame(self) -> pd.DataFrame:
        """One row per time [s]; columns ``<marker>_<axis>_<statistic>`` [m]."""
        return _columns(self.bands)

    def plot(self, marker: str | int = -1, axis: str = "x", ax: Axes | None = None) -> Axes:
        """Draw one coordinate of one marker over time, with its 50 % and 90 % bands.

        Raises:
            InputError: no such marker or axis.
        """
        index = entry_number(marker, self.drawn.marker_names, "marker")
        axes = axes_or_new(ax)
        draw_band(axes, self.drawn, index, entry_number(axis, AXES, "axis"))
        axes.set_xlabel("time [s]")
        axes.legend()
        return axes

    def save(self, folder: Path | str) -> list[Path]:
        """Write prediction.nc, prediction.csv and prediction.json; return their paths.

        The first has mean and the 5, 25, 75 and 95 % quantiles of the measurement, in metres, in the robot's base
        frame, the second the same, one row per time. The centre of a pushed object is in both files, every draw of its
        pose in the first.
        """
        files = [Path(folder) / f"prediction.{ending}" for ending in ("nc", "csv", "json")]
        output_folder(files[0].parent)
        with whole(files[0]) as partial:
            self.bands.to_netcdf(partial, engine="h5netcdf")
        with whole(files[1]) as partial:
            self.frame.to_csv(partial, index=False, float_format="%.6f")
        write_json(files[2], {**self.content, "files": [str(file) for file in files[:2]]})
        return files

    def __repr__(self) -> str:
        time = self.bands["time"].values
        markers = ", ".join(str(name) for name in self.bands["marker"].values)
        lines = [f"{len(time)} rows over {time[-1] - time[0]:.4g} s of markers {markers}; .bands, .frame [m], .plot()"]
        return "\n".join([*lines, *(caution.sentence for caution in self.cautions)])

    def _repr_html_(self) -> str:
        said = "".join(f"<p>{escape(line)}</p>" for line in repr(self).splitlines())
        return said + self.bands._repr_html_()


def _columns(table: xr.Dataset) -> pd.DataFrame:
    """One row per time [s]; columns ``<marker>_<axis>_<statistic>`` [m]."""
    columns: dict[str, Float[np.ndarray, " time"]] = {"time": table["time"].values}
    for name in ("mean", *LEVELS):
        for i, marker in enumerate(table["marker"].values):
            for j, axis in enumerate("xyz"):
                columns[f"{marker}_{axis}_{name}"] = table[name].values[:, i, j]
        if OBJECT in table:
            for j, axis in enumerate("xyz"):
                columns[f"{OBJECT}_{axis}_{name}"] = table[f"{OBJECT}_{name}"].values[:, j]
    return pd.DataFrame(columns)
