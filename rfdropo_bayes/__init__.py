"""Probabilistic sim-to-real for soft robots: calibrate a simulator, name the effects it lacks, and measure the gain.

    import rfdropo_bayes as rb

    runs = rb.read("monday/*.csv", format="csv", columns=...)
    model = rb.Model("trunk_sofa", priors={"young_modulus": {}, "trunk_mass": {}})
    fit = rb.calibrate(model, runs, rb.SMC(rollouts=20_000), seed=0)

Every command of ``rfdropo`` is one call of a function here. Nothing is loaded before it is used; type checkers and
editors read the same names from the imports below.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rfdropo_bayes.runtime import keep_callback_threads, limit_blas_threads, refuse_lost_threads

if TYPE_CHECKING:
    from rfdropo_bayes.cautions import Caution as Caution
    from rfdropo_bayes.cautions import Code as Code
    from rfdropo_bayes.data import Trajectory as Trajectory
    from rfdropo_bayes.deployment.session import deploy as deploy
    from rfdropo_bayes.deployment.settings import load_deployment as load_deployment
    from rfdropo_bayes.errors import InputError as InputError
    from rfdropo_bayes.inference.modes.mode_search import LaplaceConfig as Laplace
    from rfdropo_bayes.inference.rfdropo.phi_search import RfdropoConfig as RFDROPO
    from rfdropo_bayes.inference.smc.sampler import SmcConfig as SMC
    from rfdropo_bayes.model.model import Model as Model
    from rfdropo_bayes.policies.training_config import TrainingOptions as TrainingOptions
    from rfdropo_bayes.results.audited import Audit as Audit
    from rfdropo_bayes.results.calibrated import Calibration as Calibration
    from rfdropo_bayes.results.designed import Design as Design
    from rfdropo_bayes.results.load import load as load
    from rfdropo_bayes.results.predicted import Prediction as Prediction
    from rfdropo_bayes.robots import Robot as Robot
    from rfdropo_bayes.robots.parameter import Parameter as Parameter
    from rfdropo_bayes.robots.sections import Cone as Cone
    from rfdropo_bayes.robots.sections import Cylinder as Cylinder
    from rfdropo_bayes.robots.sections import Disks as Disks
    from rfdropo_bayes.robots.sections import Tube as Tube
    from rfdropo_bayes.robots.sections import section_profile as section_profile
    from rfdropo_bayes.simulators.adapters.mujoco_model import MuJoCo as MuJoCo
    from rfdropo_bayes.simulators.black_box import BlackBox as BlackBox
    from rfdropo_bayes.simulators.parameters import ParameterSpec as ParameterSpec
    from rfdropo_bayes.verbs.adapt import adapt as adapt
    from rfdropo_bayes.verbs.audit import AuditOptions as AuditOptions
    from rfdropo_bayes.verbs.audit import audit as audit
    from rfdropo_bayes.verbs.calibrate import calibrate as calibrate
    from rfdropo_bayes.verbs.check import check as check
    from rfdropo_bayes.verbs.design import design as design
    from rfdropo_bayes.verbs.evaluate import evaluate as evaluate
    from rfdropo_bayes.verbs.make_vec import make_vec as make_vec
    from rfdropo_bayes.verbs.predict import predict as predict
    from rfdropo_bayes.verbs.read import read as read
    from rfdropo_bayes.verbs.simulate import simulate as simulate
    from rfdropo_bayes.verbs.train import train as train

limit_blas_threads()
keep_callback_threads()

__version__ = "0.1.0"

_HOMES = {
    "Audit": "results.audited",
    "AuditOptions": "verbs.audit",
    "BlackBox": "simulators.black_box",
    "Calibration": "results.calibrated",
    "Caution": "cautions",
    "Code": "cautions",
    "Cone": "robots.sections",
    "Cylinder": "robots.sections",
    "Design": "results.designed",
    "Disks": "robots.sections",
    "InputError": "errors",
    "Laplace": "inference.modes.mode_search:LaplaceConfig",
    "Model": "model.model",
    "MuJoCo": "simulators.adapters.mujoco_model",
    "Parameter": "robots.parameter",
    "ParameterSpec": "simulators.parameters",
    "Prediction": "results.predicted",
    "RFDROPO": "inference.rfdropo.phi_search:RfdropoConfig",
    "Robot": "robots",
    "SMC": "inference.smc.sampler:SmcConfig",
    "Trajectory": "data",
    "Tube": "robots.sections",
    "adapt": "verbs.adapt",
    "audit": "verbs.audit",
    "calibrate": "verbs.calibrate",
    "check": "verbs.check",
    "deploy": "deployment.session",
    "design": "verbs.design",
    "evaluate": "verbs.evaluate",
    "load": "results.load",
    "load_deployment": "deployment.settings",
    "make_vec": "verbs.make_vec",
    "predict": "verbs.predict",
    "read": "verbs.read",
    "section_profile": "robots.sections",
    "simulate": "verbs.simulate",
    "TrainingOptions": "policies.training_config",
    "train": "verbs.train",
}
"""Definition of each name: ``module`` under the same name, or ``module:name``."""

_COMPUTING = ("inference.", "model.", "simulators.", "verbs.")
"""Rooms that make arrays of JAX when they are imported."""

__all__ = ["__version__", *_HOMES]


def __dir__() -> list[str]:
    return sorted(__all__)


if not TYPE_CHECKING:  # with this function every name would be Any to a type checker

    def __getattr__(name: str) -> Any:
        """Load the object of a name at its first use."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, _, attribute = _HOMES[name].partition(":")
        if module.startswith(_COMPUTING):
            refuse_lost_threads()
        found = getattr(import_module(f"{__name__}.{module}"), attribute or name)
        globals()[name] = found
        return found
