"""Residuals of the fitted recordings and signals at ports, as a dataset: the content of residuals.nc."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from rfdropo_bayes.discrepancy.pipeline import Answer


def residual_dataset(answer: Answer) -> xr.Dataset:
    """Measured less simulated positions [m] of every group of repeats, by the base and the final model; mean and
    deviation of the signal at every examined port [unit of the port].
    """
    measured, markers = answer.target.measurements, answer.problem.model.recordings.markers
    models: dict[str, Any] = {"base": (answer.target, answer.base.x), "last": (answer.target, answer.extended.x)}
    if answer.steps:
        models["last"] = (answer.steps[-1].fit_target, answer.extended.x)
    if answer.law is not None and answer.law.last is not None:
        models["last"] = (answer.law.last.target, answer.law.last.fit.x)
    valid = measured.valid[..., : measured.markers]
    shape = (*valid.shape[:2], len(markers), 3)
    residuals = {
        name: np.where(valid, target.errors(x)[..., : measured.markers], np.nan).reshape(shape)
        for name, (target, x) in models.items()
    }
    along = ("recording", "row", "marker", "axis")
    variables: dict[str, Any] = {f"residual_{name}": (along, part, {"units": "m"}) for name, part in residuals.items()}
    variables["time"] = (("recording", "row"), np.asarray(measured.time), {"units": "s"})
    coordinates: dict[str, Any] = {"recording": list(measured.names), "marker": list(markers), "axis": list("xyz")}
    described = answer.described
    if described is not None:
        rows = described.search.ports
        coordinates |= {"port": [row.port.name for row in rows], "signal_time": described.search.centre}
        coordinates |= {"unit": ("port", [row.port.unit for row in rows])}
        across = ("port", "recording", "signal_time")
        variables["signal"] = (across, np.stack([row.mean for row in rows]), {})
        variables["signal_sd"] = (across, np.stack([row.sd for row in rows]), {})
    return xr.Dataset(variables, coordinates)
