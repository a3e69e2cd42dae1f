"""A rod of PyElastica in the robot's place: ``robot = "pyelastica_rod.py:rod"`` in an experiment file beside this one.

It hangs from its base, a force on its tip is the command, and its tip is measured. Needs ``pip install pyelastica``.
"""

from __future__ import annotations

from collections.abc import Mapping

import elastica
import numpy as np

import rfdropo_bayes as rb

LENGTH, RADIUS = 0.3, 0.01  # [m]
STEP = 1e-4  # [s]: the stiffest and lightest rod lets a wave pass half an element in it


class _Scene(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Damping):
    """What PyElastica simulates."""


class _TipForce(elastica.NoForces):
    """The command [N] in force, along x, on the last node."""

    def __init__(self, level: list[float]) -> None:
        self.level = level

    def apply_forces(self, system: elastica.CosseratRod, time: float = 0.0) -> None:
        """Add it to the forces of a step."""
        system.external_forces[0, -1] += self.level[0]


def rod(elements: int = 20, time_step: float = 0.01) -> rb.BlackBox:
    """The simulator; ``elements`` and ``time_step`` may stand in the experiment's [adapter]."""

    def simulate(parameters: Mapping[str, float], command: np.ndarray) -> np.ndarray:
        scene, level = _Scene(), [float(command[0, 0])]
        axis, side = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
        own = elastica.CosseratRod.straight_rod(
            elements,
            start=np.zeros(3),
            direction=axis,
            normal=side,
            base_length=LENGTH,
            base_radius=RADIUS,
            density=parameters["density"],
            youngs_modulus=parameters["young_modulus"],
            shear_modulus=parameters["young_modulus"] / 3.0,
        )
        scene.append(own)
        fixed = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
        scene.constrain(own).using(elastica.OneEndFixedBC, **fixed)
        scene.add_forcing_to(own).using(elastica.GravityForces, acc_gravity=9.81 * axis)
        scene.add_forcing_to(own).using(_TipForce, level)
        constant = parameters["damping"]
        scene.dampen(own).using(elastica.AnalyticalLinearDamper, uniform_damping_constant=constant, time_step=STEP)
        scene.finalize()
        stepper, time, rows = elastica.PositionVerlet(), np.float64(0.0), [own.position_collection[:, -1].copy()]
        for row in command[1:]:
            level[0] = float(row[0])
            for _ in range(round(time_step / STEP)):
                time = stepper.step(scene, time, np.float64(STEP))
            rows.append(own.position_collection[:, -1].copy())
        return np.stack(rows)[:, None]

    def table(unit: str, low: float, median: float, high: float) -> dict:
        prior = {"distribution": "LogNormal", "median": median, "sigma": 0.4}
        return {"unit": unit, "low": low, "high": high, "nominal": median, "prior": prior}

    parameters = {
        "young_modulus": table("Pa", 1e5, 1e6, 3e6),
        "density": table("kg/m3", 800.0, 1100.0, 3000.0),
        "damping": table("1/s", 0.01, 2.0, 50.0),
    }
    names = {"markers": ["tip"], "channels": ["force"], "command_unit": "N"}
    return rb.BlackBox(simulate, parameters=parameters, time_step=time_step, name="rod", **names)
