"""Geometrically exact rods for slender soft bodies: the differentiable engine.

Build a ``System`` (body and cables, static), ``prepare`` it with a ``Material`` once a rollout, start from
``state_at_rest`` or ``static_equilibrium``, and ``simulate``. Everything after the system is a pure function of arrays.
"""

from rfdropo_bayes.runtime import configure_jax

configure_jax()

from rfdropo_bayes.fem.cables import CableLayout, cable_layout  # noqa: E402
from rfdropo_bayes.fem.chambers import chamber_layout  # noqa: E402
from rfdropo_bayes.fem.dynamics import Material, System, material, prepare, state_at_rest, step, without_cables  # noqa: E402
from rfdropo_bayes.fem.effects import BendingLaw, BodyEffects, Viscoelasticity, Wall  # noqa: E402
from rfdropo_bayes.fem.equilibrium import static_equilibrium  # noqa: E402
from rfdropo_bayes.fem.points import point_positions  # noqa: E402
from rfdropo_bayes.fem.rod import PointMap, Rod, attach, profile_rod, refined, solid_torsion_constant, uniform_rod  # noqa: E402
from rfdropo_bayes.fem.rollouts import simulate  # noqa: E402
