"""Where a rollout starts when cables of a notched trunk pull against each other."""

from __future__ import annotations

import jax
import numpy as np

from rfdropo_bayes.robots import load_robot
from rfdropo_bayes.simulators.protocol import Result
from rfdropo_bayes.workflow.assembly import build_simulator
from rfdropo_bayes.workflow.experiment import Experiment


def test_a_notched_trunk_settles_between_opposed_cables():
    """Taut cables hold its necks against twist; an iteration that does not know this swings in twist for ever."""
    simulator = build_simulator(Experiment(robot="trunk_physical"), load_robot("trunk_physical"))
    commands = simulator.commands(np.zeros(1), np.zeros((1, 8)), np.zeros(8), np.array([0.0, 0.01]))
    rng = np.random.default_rng(0)
    batch = 24
    values = {name: rng.normal(0.0, 0.003, batch) for name in simulator.robot.initial_displacement_names}
    values |= {"young_modulus": 4.5e6 * np.exp(rng.normal(size=batch)), "poisson_ratio": rng.uniform(0.4, 0.499, batch)}
    status = jax.vmap(lambda one: simulator.rollout(one, commands).status)(values)
    assert np.sum(np.asarray(status) != Result.OK) <= 1
