"""Whether a calibration is used with the integrator that it was fitted with: what a fit finds carries its time step."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment_file import read_tables
from rfdropo_bayes.model.run_folder import CONFIG
from rfdropo_bayes.simulators.body_engine import QUASI_STATIC

INTEGRATOR = "integrator"
"""Attribute of a posterior: how time steps were taken in its fit."""


def fitted_integrator(attributes: Mapping[str, Any], folder: Path | None = None) -> str:
    """How time steps were taken in a fit.

    Args:
        attributes: of its posterior; a posterior of an earlier version says nothing.
        folder: of its run, whose config.toml says it then. Without one it was "euler", which those versions had alone.
    """
    if INTEGRATOR in attributes:
        return str(attributes[INTEGRATOR])
    if folder is None or not (folder / CONFIG).is_file():
        return "euler"
    return str(read_tables(folder / CONFIG).get("simulator", {}).get(INTEGRATOR, "euler"))


def check_fitted_integrator(fitted: str, integrator: str | None, *, where: str) -> None:
    """See that a model takes its time steps as the fit did whose answer it is to use; None is a black box.

    Raises:
        InputError: it does not.
    """
    if integrator is not None and integrator != fitted:
        key = "motion" if fitted == QUASI_STATIC else "integrator"
        raise InputError(
            f"the parameters were fitted with {key} {fitted!r}, and are to be used with {integrator!r}",
            where=where,
            remedy=f"add --set simulator.{key}={fitted}, or calibrate anew",
        )
