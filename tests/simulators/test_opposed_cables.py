"""Cables of a notched trunk that pull against each other: where rollouts start, and that they stay with the body."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.robots import load_robot
from rfdropo_bayes.simulators.engine import Backend, Engine
from rfdropo_bayes.simulators.protocol import Result
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble
from rfdropo_bayes.workflow.assembly import build_simulator
from rfdropo_bayes.workflow.experiment import Experiment


def test_a_notched_trunk_between_opposed_cables_stays_whole():
    """Eight random walks of up to 40 mm, each cable on its own, on light and heavy, soft and stiff trunks."""
    robot, discretisation = load_robot("trunk_sofa"), Discretisation(0.01)
    assembly = assemble(robot, discretisation)
    trunk = TrunkSimulator(robot, Engine(assembly, 0.01, Backend(threads=1)), assembly, discretisation)
    clock = np.arange(0.0, 3.0, 0.05)
    pull = 0.003 * np.cumsum(np.random.default_rng(0).normal(size=(len(clock), 8)), axis=0)
    commands = trunk.commands(clock, pull, np.zeros(8), np.arange(0.1, 3.0, 0.1))
    values = {
        "young_modulus": jnp.array([4.5e6, 9.15e6, 4.47e6, 1.1e7]),
        "trunk_mass": jnp.array([0.42, 0.139, 0.0693, 0.00226]),
        "poisson_ratio": jnp.array([0.45, 0.399, 0.365, 0.271]),
        "rayleigh_mass": jnp.array([0.1, 17.8, 17.2, 1.75]),
        "rayleigh_stiffness": jnp.array([0.1, 0.316, 0.355, 0.007]),
    }
    seen = jax.vmap(lambda value: trunk.rollout(value, commands))(values)
    np.testing.assert_array_equal(seen.status, int(Result.OK))
    length = assembly.system.body.station[-1]
    assert np.linalg.norm(seen.position, axis=-1).max() < 1.2 * length
    assert np.asarray(seen.tension).max() > 50.0


@pytest.mark.slow
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
