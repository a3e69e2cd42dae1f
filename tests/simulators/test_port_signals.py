"""Signals at ports: two engines agree on them, zeros change nothing, and known laws come out of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import build_robot_simulator
from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.model.model_spec import ModelSpec, find_robot
from rfdropo_bayes.simulators.port_signals import BodySignals, PortSignals, read_late

STEP = 0.01


def arm(engine="numba", settled=False, mechanisms=(), **table):
    robot = find_robot("smooth_arm", Path())
    if settled:
        robot = robot.with_changes(initial_state="equilibrium")
    table = SimulatorTable(engine=engine, time_step=STEP, **table)
    return build_robot_simulator(ModelSpec(robot, simulator=table).with_mechanisms(*mechanisms))


def commands(simulator, rows=12, seed=0):
    value = np.random.default_rng(seed).uniform(0.0, 0.008, (6, 4))
    return simulator.commands(0.1 * np.arange(6), value, np.zeros(4), 0.05 * np.arange(rows))


def signals(simulator, given, size=1.0, seed=1):
    """Smooth signals at every port, of the size of what a laboratory might see."""
    rows, places = len(given.step) + 1, len(simulator.engine.load_stations)
    rng, time = np.random.default_rng(seed), np.linspace(0.0, 1.0, len(given.step) + 1)

    def wave(*shape):
        phase = rng.uniform(0.0, 6.0, shape)
        return size * np.sin(5.0 * time.reshape(-1, *[1] * len(shape)) + phase)

    body = BodySignals(0.05 * wave(places, 3), 0.3 * wave(), 0.5 * wave(), 0.5 * wave(3))
    assert body.force.shape == (rows, places, 3)
    return PortSignals(1e-3 * wave(4), 0.02 * (1.0 + wave()), body)


@pytest.mark.parametrize(
    ("integrator", "settled", "mechanisms"),
    [
        pytest.param("euler", True, (), marks=pytest.mark.slow),
        ("sdirk2", False, ("viscoelasticity", "fibre_law", "softening")),
    ],
)
def test_two_engines_give_the_same_motion_under_signals(integrator, settled, mechanisms):
    found = []
    for engine in ("numba", "jax"):
        simulator = arm(engine, settled, mechanisms, integrator=integrator)
        given = commands(simulator)
        given = given._replace(signals=signals(simulator, given))
        values = {"softening_rate": 0.2, "fibre_law": 0.3} if mechanisms else {}
        found.append(simulator.rollout({k: jnp.asarray(v) for k, v in values.items()}, given))
    assert [int(each.status) for each in found] == [0, 0]
    assert np.abs(found[0].position - found[1].position).max() < 1e-9
    assert np.abs(found[0].tension - found[1].tension).max() < 1e-5


def test_signals_of_zeros_change_no_bit_and_signals_move_the_body():
    simulator = arm(settled=True)
    given = commands(simulator)
    plain = simulator.rollout({}, given)
    null = jax.tree.map(np.zeros_like, signals(simulator, given))
    still = simulator.rollout({}, given._replace(signals=null))
    assert np.array_equal(plain.position, still.position)
    every = signals(simulator, given)
    for name in ("force", "stiffness", "damping", "gravity"):
        one = null.body._replace(**{name: getattr(every.body, name)})
        moved = simulator.rollout({}, given._replace(signals=null._replace(body=one)))
        assert int(moved.status) == 0
        assert np.abs(moved.position - plain.position).max() > 1e-5, name


def test_constant_signals_are_known_parameters():
    """Logarithms of factors on stiffness and damping are changes of Young's modulus and Rayleigh's coefficients."""
    simulator = arm(settled=True)
    given = commands(simulator)
    null = jax.tree.map(np.zeros_like, signals(simulator, given))
    nominal = {spec.name: spec.nominal for spec in simulator.parameters}
    cases = {"stiffness": {"young_modulus": 1.3}, "damping": {"rayleigh_mass": 1.3, "rayleigh_stiffness": 1.3}}
    for name, factors in cases.items():
        constant = np.full_like(null.body.stiffness, np.log(1.3))
        body = null.body._replace(**{name: constant})
        acted = simulator.rollout({}, given._replace(signals=null._replace(body=body)))
        changed = simulator.rollout({k: jnp.asarray(f * nominal[k]) for k, f in factors.items()}, given)
        assert np.abs(acted.position - changed.position).max() < 1e-9, name


def test_a_signal_at_a_cable_is_a_change_of_the_command_and_a_delay_one_of_time():
    simulator = arm()
    given = commands(simulator)
    added = 1e-3 * np.random.default_rng(3).normal(size=(len(given.step) + 1, 4))
    port = PortSignals(added, np.zeros(len(added)))
    acted = simulator.rollout({}, given._replace(signals=port))
    commanded = simulator.rollout({}, given._replace(initial=given.initial + added[0], step=given.step + added[1:]))
    assert np.abs(acted.position - commanded.position).max() < 1e-12
    late = arm(mechanisms=("command_delay",))
    port = PortSignals(np.zeros_like(added), np.full(len(added), 0.034))
    acted = simulator.rollout({}, given._replace(signals=port))
    known = late.rollout({"command_delay": jnp.asarray(0.034)}, given)
    assert np.abs(acted.position - known.position).max() < 1e-12


def test_levels_are_read_linearly_and_stand_still_beyond_the_ends():
    levels = jnp.asarray([[0.0], [1.0], [4.0], [9.0]])
    read = read_late(levels, jnp.asarray([5.0, 0.5, 0.0, -3.0]))[:, 0]
    assert np.allclose(read, [0.0, 0.5, 4.0, 9.0])
    slope = jax.jacfwd(lambda late: read_late(levels, jnp.full(4, late))[:, 0])(0.0)
    assert np.allclose(slope[1:], [-1.0, -3.0, -5.0])


@pytest.mark.slow
def test_signals_on_a_body_with_a_cube_are_refused():
    simulator = build_robot_simulator(
        ModelSpec(find_robot("trunk_sofa", Path()), simulator=SimulatorTable(push=True, time_step=STEP))
    )
    given = simulator.commands(np.zeros(1), np.zeros((1, 8)), np.zeros(8), 0.05 * np.arange(3))
    rows = len(given.step) + 1
    body = BodySignals(np.zeros((rows, 3, 3)), np.zeros(rows), np.zeros(rows), np.zeros((rows, 3)))
    port = PortSignals(np.zeros((rows, 8)), np.zeros(rows), body)
    with pytest.raises(InputError, match="without a cube"):
        simulator.rollout({}, given._replace(signals=port))
    assert not simulator.engine.carries_loads
    assert replace(simulator.engine, scene=None).carries_loads
