"""Check that a calibration is used with the integrator of its fit, since fitted values depend on the time step."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import integrator_of
from rfdropo_bayes.model.experiment_file import read_tables
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.model.run_folder import CONFIG
from rfdropo_bayes.simulators.body_engine import QUASI_STATIC

INTEGRATOR = "integrator"  # attribute of a posterior: how time steps were taken in its fit


def stated_integrator(spec: ModelSpec) -> dict[str, str]:
    """The integrator of a model as an attribute of a posterior; empty for a black box."""
    integrator = integrator_of(spec)
    return {} if integrator is None else {INTEGRATOR: integrator}


def check_fitted_integrator(
    attributes: Mapping[str, Any], folder: Path | None, integrator: str | None, *, where: str
) -> None:
    """Check that a model uses the integrator of the fit whose posterior it uses.

    Args:
        attributes: attributes of the posterior.
        folder: folder of the run; its config.toml is used if the attributes lack the integrator.
        integrator: integrator of the model; None for a black box.
        where: place of the model in an error.

    Raises:
        InputError: it uses another.
    """
    fitted = attributes.get(INTEGRATOR)
    if fitted is None and folder is not None and (folder / CONFIG).is_file():
        simulator = read_tables(folder / CONFIG).get("simulator", {})
        fitted = QUASI_STATIC if simulator.get("motion") == QUASI_STATIC else simulator.get(INTEGRATOR)
    if None not in (fitted, integrator) and integrator != fitted:
        key = "motion" if fitted == QUASI_STATIC else "integrator"
        raise InputError(
            f"the parameters were fitted with {key} {fitted!r}, and are to be used with {integrator!r}",
            where=where,
            remedy=f"add --set simulator.{key}={fitted}, or calibrate anew",
        )
