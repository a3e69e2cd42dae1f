"""Rods at rest in every row: against closed forms, motions that have died out, and rows found one by one."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import build_robot_simulator
from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.simulators.control_session import Session

LENGTH, RADIUS, ARM = 0.2, 0.01, 0.0075
LINE = rb.Robot.outline(name="arm", length=LENGTH, radius=RADIUS, markers={"tip": LENGTH}, cables=1)
LIGHT = LINE.with_changes(gravity_m_s2=(0.0, 0.0, 0.0))


def pulled_by_tension(robot):
    cable = robot.cables[0].model_copy(
        update={"drive": "tension", "displacement_limit_m": None, "tension_limit_n": (0.0, 5.0)}
    )
    parameters = {name: found for name, found in robot.parameters.items() if name != "initial_displacement"}
    timing = {"unit": "N", "ramp_s": 0.0, "dead_time_s": 0.0}
    return robot.with_changes(cables=(cable,), command=timing, parameters=parameters)


def simulated(robot, motion="quasi-static", mechanisms=(), **table):
    spec = ModelSpec(robot, simulator=SimulatorTable(engine="numba", motion=motion, **table))
    return build_robot_simulator(spec.with_mechanisms(*mechanisms) if mechanisms else spec)


def rows(simulator, command, interval=1.0, values=None):
    """Tip in rows with these commands of the only channel."""
    time = interval * np.arange(len(command))
    given = simulator.commands(time, np.reshape(command, (-1, 1)), np.atleast_1d(command[0]), time + 0.5 * interval)
    found = simulator.rollout({name: jnp.asarray(v) for name, v in (values or {}).items()}, given)
    assert int(found.status) == 0
    return found


def test_a_tension_beside_the_axis_bends_a_light_bar_to_an_arc():
    """Curvature k with E I k = T (d + k h^2 / 12), as a cable runs straight over the way h from guide to guide, and a
    stretch of -T / E A, whatever the cable's length."""
    pull = np.array([0.0, 0.5, 1.0])
    found = rows(simulated(pulled_by_tension(LIGHT)), pull)
    nominal = LIGHT.nominal()["young_modulus"]
    bend = pull * ARM / (nominal * np.pi * RADIUS**4 / 4.0 - pull * (LENGTH / 8.0) ** 2 / 12.0)
    arc = LENGTH * (1.0 - pull / (nominal * np.pi * RADIUS**2))
    angle = np.maximum(bend * LENGTH, 1e-12)
    expected = np.stack([arc * (1.0 - np.cos(angle)) / angle, 0.0 * angle, arc * np.sin(angle) / angle], axis=1)
    np.testing.assert_allclose(found.position[:, 0], expected, atol=4e-4 * LENGTH)
    np.testing.assert_allclose(found.tension[:, 0], pull, atol=1e-4)


INFLATED = rb.Robot.outline(name="arm", length=LENGTH, radius=RADIUS, markers={"tip": LENGTH}, cables=1,
                            command_unit="Pa", usual_command=5e4, gravity="+z")  # fmt: skip


def test_a_pressure_beside_the_axis_bends_a_light_bar_away_to_an_arc():
    """Curvature p A e / E I and stretch p A / E A, at rest and where a motion has died out, and in a session."""
    light = INFLATED.with_changes(gravity_m_s2=(0.0, 0.0, 0.0))
    pressure, area = np.array([0.0, 1e5, 2e5]), light.chambers[0].area_m2
    modulus = light.nominal()["young_modulus"]
    angle = np.maximum(LENGTH * pressure * area * ARM / (modulus * np.pi * RADIUS**4 / 4.0), 1e-12)
    arc = LENGTH * (1.0 + pressure * area / (modulus * np.pi * RADIUS**2))
    expected = np.stack([-arc * (1.0 - np.cos(angle)) / angle, 0.0 * angle, arc * np.sin(angle) / angle], axis=1)
    still = simulated(light)
    np.testing.assert_allclose(rows(still, pressure).position[:, 0], expected, atol=1e-4 * LENGTH)
    damped = {"rayleigh_stiffness": 0.1, "rayleigh_mass": 5.0}
    moved = rows(simulated(light, "dynamic"), pressure, interval=8.0, values=damped).position[:, 0]
    np.testing.assert_allclose(moved, expected, atol=1e-4 * LENGTH)
    session = Session(still, 1, 0.1)
    session.reset(np.arange(1), {})
    np.testing.assert_allclose(session.act(pressure[:1, None] + 1e5).position[0, 0], expected[1], atol=1e-4 * LENGTH)


def test_friction_of_cables_needs_cables():
    with pytest.raises(InputError, match="acts on cables, and the robot has none"):
        rows(simulated(INFLATED, mechanisms=("coulomb_friction",)), [0.0, 1e4])


def test_rows_are_where_a_motion_comes_to_rest():
    command = np.array([0.0, 0.004, 0.008, 0.002])
    still = rows(simulated(LINE), command).position[:, 0]
    moving = simulated(LINE, "dynamic")
    time = 4.0 * np.arange(4)
    given = moving.commands(time, command[:, None], command[:1], time + 3.9)
    found = moving.rollout({"rayleigh_stiffness": jnp.asarray(0.1), "rayleigh_mass": jnp.asarray(5.0)}, given)
    np.testing.assert_allclose(still, found.position[:, 0], atol=2e-6)


def test_a_body_at_rest_has_no_damping_and_says_so():
    simulator = simulated(LINE)
    assert not any(spec.name.startswith("rayleigh") for spec in simulator.parameters)
    assert simulator.description["integrator"] == "quasi-static"
    with pytest.raises(InputError, match="acts on a body in motion"):
        rows(simulated(LINE, mechanisms=("viscoelasticity",)), [0.0, 0.001])
    with pytest.raises(InputError, match="does not allow time_step"):
        rb.Model("smooth_arm", simulator={"motion": "quasi-static", "time_step": 0.01})


def test_friction_keeps_its_path_and_elasticity_does_not():
    """The way back from a pull is not the way there; with nothing that rubs it is."""
    command = np.array([0.0, 0.002, 0.004, 0.006, 0.004, 0.002])
    plain = rows(simulated(LINE), command).position[:, 0]
    np.testing.assert_allclose(plain[1:3], plain[:-3:-1], atol=1e-7)
    rubbing = rows(simulated(LINE, mechanisms=("coulomb_friction",)), command, values={"coulomb_friction": 0.02})
    assert np.linalg.norm(rubbing.position[1, 0] - rubbing.position[-1, 0]) > 1e-4


def test_drives_act_in_time_on_a_body_at_rest():
    """A delay of a row's length shows the row before."""
    command = np.array([0.001, 0.002, 0.004, 0.003])
    plain = rows(simulated(LINE), command).position[:, 0]
    late = rows(simulated(LINE, mechanisms=("command_delay",)), command, values={"command_delay": 1.0}).position[:, 0]
    np.testing.assert_allclose(late[1:], plain[:-1], atol=1e-7)


def test_first_rows_do_not_depend_on_later_ones():
    simulator, command = simulated(LINE), np.array([0.0, 0.003, 0.006])
    time = np.arange(3.0)
    given = simulator.commands(time, command[:, None], command[:1], time)
    whole = simulator.rollout({}, given).position
    short = simulator.rollout({}, given, jnp.asarray(int(given.sample_step[1]))).position
    np.testing.assert_array_equal(short[:2], whole[:2])


def test_a_session_rests_where_rollouts_do():
    simulator = simulated(LINE)
    session = Session(simulator, 2, 0.1)
    session.reset(np.arange(2), {"young_modulus": np.array([1e6, 2e6])})
    seen = session.act(np.array([[0.004], [0.004]]))
    for lane, young in enumerate((1e6, 2e6)):
        found = rows(simulator, [0.0, 0.004], values={"young_modulus": young})
        np.testing.assert_allclose(seen.position[lane], found.position[-1], atol=1e-7)
