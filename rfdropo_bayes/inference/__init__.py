"""Inference methods. They depend on a `Problem` alone, not on its simulator.

Other rooms import from here, and the module `methods`; a name's module is loaded when it is first used.

| to find | look in |
|---|---|
| the methods by name | `methods` |
| the start, the stages and the moves of SMC | `smc.start`, `smc.sampler`, `smc.moves` |
| the search for modes | `modes.mode_search` |
| RF-DROPO | `rfdropo.phi_search` |
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rfdropo_bayes.runtime import configure_jax

configure_jax()

if TYPE_CHECKING:
    from rfdropo_bayes.inference.methods import METHODS as METHODS
    from rfdropo_bayes.inference.methods import make_config as make_config
    from rfdropo_bayes.inference.methods import method_named as method_named
    from rfdropo_bayes.inference.modes.lasting import lasting_series as lasting_series
    from rfdropo_bayes.inference.modes.mode_search import LaplaceConfig as LaplaceConfig
    from rfdropo_bayes.inference.modes.mode_search import find_modes as find_modes
    from rfdropo_bayes.inference.modes.optimisation import maximise as maximise
    from rfdropo_bayes.inference.modes.optimisation import normal_at as normal_at
    from rfdropo_bayes.inference.modes.optimisation import optimisation_cost as optimisation_cost
    from rfdropo_bayes.inference.modes.targets import Target as Target
    from rfdropo_bayes.inference.nested import NestedConfig as NestedConfig
    from rfdropo_bayes.inference.nuts import NutsConfig as NutsConfig
    from rfdropo_bayes.inference.progress import Checkpoint as Checkpoint
    from rfdropo_bayes.inference.progress import Progress as Progress
    from rfdropo_bayes.inference.result import InferenceResult as InferenceResult
    from rfdropo_bayes.inference.rfdropo.phi_search import RfdropoConfig as RfdropoConfig
    from rfdropo_bayes.inference.smc.sampler import SmcConfig as SmcConfig
    from rfdropo_bayes.inference.smc.tempering import next_step as next_step

PUBLIC = {
    "Checkpoint": "progress",
    "METHODS": "methods",
    "make_config": "methods",
    "method_named": "methods",
    "optimisation_cost": "modes.optimisation",
    "maximise": "modes.optimisation",
    "normal_at": "modes.optimisation",
    "lasting_series": "modes.lasting",
    "LaplaceConfig": "modes.mode_search",
    "find_modes": "modes.mode_search",
    "Target": "modes.targets",
    "NestedConfig": "nested",
    "NutsConfig": "nuts",
    "Progress": "progress",
    "InferenceResult": "result",
    "RfdropoConfig": "rfdropo.phi_search",
    "next_step": "smc.tempering",
    "SmcConfig": "smc.sampler",
}
"""Public names, and the module of each."""


def __getattr__(name: str) -> Any:
    if name not in PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{PUBLIC[name]}"), name)
