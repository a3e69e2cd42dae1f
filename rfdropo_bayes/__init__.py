"""Probabilistic sim-to-real for soft robots: calibrate a simulator, say what it lacks, and measure the gain.

    import rfdropo_bayes as rb

    runs = rb.read("monday/*.csv", format="csv", columns=...)
    model = rb.Model("trunk_sofa", priors={"young_modulus": {}, "trunk_mass": {}})
    fit = rb.calibrate(model, runs, rb.SMC(rollouts=20_000), seed=0)

Every command of ``rfdropo`` is one call of a function here. Nothing is loaded before it is used.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

from rfdropo_bayes.runtime import keep_callback_threads, limit_blas_threads, refuse_lost_threads

limit_blas_threads()
keep_callback_threads()

__version__ = "0.1.0"

_HOMES = {
    "Audit": "results.audited",
    "BlackBox": "simulators.black_box",
    "Calibration": "results.calibrated",
    "Caution": "cautions",
    "Code": "cautions",
    "Cone": "robots.sections",
    "Cylinder": "robots.sections",
    "Design": "results.designed",
    "Disks": "robots.sections",
    "InputError": "errors",
    "Model": "model.model",
    "MuJoCo": "simulators.adapters.mujoco_model",
    "Parameter": "robots.parameter",
    "ParameterSpec": "simulators.parameters",
    "Prediction": "results.predicted",
    "Robot": "robots",
    "Trajectory": "data",
    "Tube": "robots.sections",
    "adapt": "verbs.adapt",
    "audit": "verbs.audit",
    "calibrate": "verbs.calibrate",
    "check": "verbs.check",
    "deploy": "deployment.session",
    "design": "verbs.design",
    "design_day": "verbs.design_day",
    "evaluate": "verbs.evaluate",
    "load": "results.load",
    "load_deployment": "deployment.settings",
    "make_vec": "verbs.make_vec",
    "predict": "verbs.predict",
    "read": "verbs.read",
    "section_profile": "robots.sections",
    "simulate": "verbs.simulate",
    "train": "verbs.train",
}
"""Where each name is defined: ``module`` under the same name, or ``module:name``."""
_METHODS = {
    "BayesSim": "bayessim",
    "Bridge": "bridge",
    "Laplace": "laplace",
    "NPDR": "npdr",
    "NUTS": "nuts",
    "Nested": "nested",
    "RFDROPO": "rfdropo",
    "SMC": "smc",
    "UDR": "udr",
}
"""Options of each method of inference, by the method's name in an experiment file."""

_COMPUTING = ("model.", "simulators.", "verbs.")
"""Rooms that make arrays of JAX when they are imported."""

__all__ = ["__version__", *_HOMES, *_METHODS]


def __getattr__(name: str) -> Any:
    """Load what a name stands for, once it is asked for."""
    if name in _METHODS:
        refuse_lost_threads()
        found = import_module(f"{__name__}.inference.methods").METHODS[_METHODS[name]].config
    elif name in _HOMES:
        module, _, attribute = _HOMES[name].partition(":")
        if module.startswith(_COMPUTING):
            refuse_lost_threads()
        found = getattr(import_module(f"{__name__}.{module}"), attribute or name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)


class _FrontDoor(ModuleType):
    """This module. Importing the room `audit` does not hide the function of that name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _FrontDoor
