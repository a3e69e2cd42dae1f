"""Layered finite elements for slender soft bodies: the differentiable reference engine.

Build a ``System`` (body and cables, static), ``prepare`` it with a ``Material`` once a rollout, start from
``state_at_rest`` or ``static_equilibrium``, and ``simulate``. Everything after the system is a pure function of arrays.
"""

from rfdropo_bayes.runtime import configure_jax

configure_jax()

from rfdropo_bayes.fem.cables import CableLayout, cable_layout  # noqa: E402
from rfdropo_bayes.fem.dynamics import (  # noqa: E402
    Material,
    Prepared,
    State,
    StepInfo,
    System,
    material,
    prepare,
    remembering,
    state_at_rest,
    step,
    without_cables,
)
from rfdropo_bayes.fem.effects import BendingLaw, BodyEffects, Memory, Viscoelasticity, Wall  # noqa: E402
from rfdropo_bayes.fem.energies import Energies, energies  # noqa: E402
from rfdropo_bayes.fem.equilibrium import EquilibriumInfo, static_equilibrium  # noqa: E402
from rfdropo_bayes.fem.layered import (  # noqa: E402
    LayeredBody,
    PointMap,
    attach,
    point_positions,
    profile_body,
    rest_positions,
    solid_torsion_constant,
    spread_forces,
    uniform_body,
)
from rfdropo_bayes.fem.rollouts import Rollout, simulate  # noqa: E402

__all__ = [
    "BendingLaw",
    "BodyEffects",
    "CableLayout",
    "Energies",
    "EquilibriumInfo",
    "LayeredBody",
    "Material",
    "Memory",
    "PointMap",
    "Prepared",
    "Rollout",
    "State",
    "StepInfo",
    "System",
    "Viscoelasticity",
    "Wall",
    "attach",
    "cable_layout",
    "energies",
    "material",
    "point_positions",
    "prepare",
    "profile_body",
    "remembering",
    "rest_positions",
    "simulate",
    "solid_torsion_constant",
    "spread_forces",
    "state_at_rest",
    "static_equilibrium",
    "step",
    "uniform_body",
    "without_cables",
]
