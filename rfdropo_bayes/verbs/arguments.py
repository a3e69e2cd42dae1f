"""Checks of the models and calibrations given to a verb."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.results.calibrated import Calibration
from rfdropo_bayes.runtime import refuse_lost_threads


def given_model(given: Any, where: str) -> Model:
    """The argument, if it is a model.

    Args:
        given: argument of the caller.
        where: name of the verb.

    Raises:
        InputError: the argument is no model, or JAX cannot compute in this process.
    """
    refuse_lost_threads()
    if isinstance(given, Model):
        return given
    named = f"{str(given)!r}" if isinstance(given, str | Path) else f"a {type(given).__name__}"
    remedy = (
        'rb.Model("my_arm.toml", priors=...) makes one of a robot, rb.Model.read("experiment.toml") of an experiment'
    )
    raise InputError(f"{named} is not a model", where=where, remedy=remedy)


def given_fit(given: Any, where: str) -> Calibration:
    """A calibration.

    Raises:
        InputError: something else was given, or JAX cannot compute in this process.
    """
    refuse_lost_threads()
    if isinstance(given, Calibration):
        return given
    named = f"{str(given)!r}" if isinstance(given, str | Path) else f"a {type(given).__name__}"
    remedy = "rb.calibrate returns one, rb.load(folder) reads the calibration of an earlier run"
    raise InputError(f"{named} is not a calibration", where=where, remedy=remedy)
