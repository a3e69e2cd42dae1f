"""Cables of a notched trunk that pull against each other: where rollouts start, and that they stay with the body."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.model.assembly import build_robot_simulator
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.body_engine import Backend, Engine
from rfdropo_bayes.simulators.control_session import Session
from rfdropo_bayes.simulators.protocol import Result
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble


def test_a_notched_trunk_between_opposed_cables_stays_whole():
    """Eight random walks of up to 40 mm, each cable on its own, on light and heavy, soft and stiff trunks."""
    robot, discretisation = Robot.load("trunk_sofa"), Discretisation(0.01)
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


def squeezed(stiffness: np.ndarray, periods: int, held: int, integrator: str, seed: int = 2) -> np.ndarray:
    """Markers (period, lane, marker, 3) of trunks of some moduli [Pa] whose cables go by 5 mm at random, each on its
    own, then hold. Steps of a period are odd in number: a swing of two steps shows."""
    simulator = build_robot_simulator(ModelSpec(Robot.load("virtual_trunk").with_changes(integrator=integrator)))
    session = Session(simulator, len(stiffness), 0.05)
    fixed = {"poisson_ratio": 0.43, "trunk_mass": 0.4, "rayleigh_mass": 0.3, "rayleigh_stiffness": 0.05}
    session.reset(np.arange(len(stiffness)), {"young_modulus": stiffness, **fixed})
    random, level, shown = np.random.default_rng(seed), np.zeros(8), []
    for period in range(periods + held):
        if period < periods:
            cable, way = random.integers(8), random.choice([-1, 1])
            level[cable] = np.clip(level[cable] + 0.005 * way, 0.0, 0.04)
        shown.append(np.asarray(session.act(np.tile(level, (len(stiffness), 1))).position))
    return np.array(shown)


CHANGE = np.array([0.0, 1e-2, 1e-3, 1e-7])


def moved_by_changes(tip: np.ndarray) -> np.ndarray:
    """Root mean square distance of every tip from the first one, over the relative change of the modulus [m]."""
    return np.sqrt(np.mean(np.sum((tip[:, 1:] - tip[:, :1]) ** 2, axis=-1), axis=0)) / CHANGE[1:]


def test_a_squeezed_trunk_moves_smoothly_with_its_modulus_and_comes_to_rest():
    """Opposed cables squeeze necks to a third of their length and fold them. Changes of the modulus by a part in 100,
    1000 and 10 million then move the tip in the same proportion, within 5 %, and a trunk that is held stops moving."""
    shown = squeezed(5e6 * (1.0 + CHANGE), 100, 100, "euler")[:, :, -1]
    moved = moved_by_changes(shown[:100])
    np.testing.assert_allclose(moved[1:], moved[0], rtol=0.05)
    assert np.abs(np.diff(shown[-20:], axis=0)).max() < 1e-6


@pytest.mark.slow
def test_under_sdirk2_it_does_the_same():
    shown = squeezed(5e6 * (1.0 + CHANGE), 100, 100, "sdirk2")[:, :, -1]
    moved = moved_by_changes(shown[:100])
    np.testing.assert_allclose(moved[1:], moved[0], rtol=0.05)
    assert np.abs(np.diff(shown[-20:], axis=0)).max() < 1e-6


def test_tensions_of_a_squeezed_trunk_come_to_rest_under_sdirk2():
    """Opposed cables bring guides as near as a seventh of a neck to each other. Held for two seconds, tensions of over
    100 N change from step to step by less than 0.1 N; steps that know nothing of what taut cables hold lose the trunk.
    """
    robot, discretisation = Robot.load("trunk_sofa"), Discretisation(0.01)
    assembly = assemble(robot, discretisation)
    engine = Engine(assembly, 0.01, Backend(threads=1), integrator="sdirk2")
    trunk = TrunkSimulator(robot, engine, assembly, discretisation)
    pull = np.zeros((20, 8))
    pull[:, [4, 6]] = np.minimum(2e-3 * np.arange(1, 21), 0.035)[:, None]
    commands = trunk.commands(0.05 * np.arange(20), pull, np.zeros(8), 0.01 * np.arange(301))
    values = {"young_modulus": 4.4e6, "trunk_mass": 0.9, "rayleigh_stiffness": 0.02, "poisson_ratio": 0.42}
    seen = trunk.rollout({name: jnp.asarray(value) for name, value in values.items()}, commands)
    tension = np.asarray(seen.tension)
    assert int(seen.status) == Result.OK
    assert tension[-100:].max() > 100.0
    assert np.abs(np.diff(tension[-100:], 2, axis=0)).max() < 0.1


@pytest.mark.slow
def test_a_notched_trunk_settles_between_opposed_cables():
    """Taut cables hold its necks against twist; an iteration that does not know this swings in twist for ever."""
    simulator = build_robot_simulator(ModelSpec(Robot.load("trunk_physical")))
    commands = simulator.commands(np.zeros(1), np.zeros((1, 8)), np.zeros(8), np.array([0.0, 0.01]))
    rng = np.random.default_rng(0)
    batch = 24
    values = {name: rng.normal(0.0, 0.003, batch) for name in simulator.robot.initial_displacement_names}
    values |= {"young_modulus": 4.5e6 * np.exp(rng.normal(size=batch)), "poisson_ratio": rng.uniform(0.4, 0.499, batch)}
    status = jax.vmap(lambda one: simulator.rollout(one, commands).status)(values)
    assert np.sum(np.asarray(status) != Result.OK) <= 1
