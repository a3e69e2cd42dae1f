"""Motors: CiA 402 drives over CANopen, the control loop, its safety, its log in the format of recordings; no JAX.

Names are imported when they are first used: hub and drives are separate processes, and start in a tenth of the time
without xarray.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rfdropo_bayes.deployment.bench.plant import Plant, PlantState
    from rfdropo_bayes.deployment.causes import Cause, Stop
    from rfdropo_bayes.deployment.log import session_trajectory
    from rfdropo_bayes.deployment.session import Mode, Outcome, deploy
    from rfdropo_bayes.deployment.settings import Deployment, load_deployment

_HOMES = {
    "Cause": "causes",
    "Stop": "causes",
    "session_trajectory": "log",
    "Plant": "bench.plant",
    "PlantState": "bench.plant",
    "Mode": "session",
    "Outcome": "session",
    "deploy": "session",
    "Deployment": "settings",
    "load_deployment": "settings",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
