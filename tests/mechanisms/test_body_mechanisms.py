"""Body mechanisms: null values through the active path, and derivatives there, on a trunk that moves."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.fem import Material
from rfdropo_bayes.mechanisms import REGISTRY
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.body_engine import Backend, Engine
from rfdropo_bayes.simulators.mechanisms import BodyMechanism
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble

BODY = sorted(name for name, kind in REGISTRY.items() if isinstance(kind(), BodyMechanism))
PLACED = {"wall_distance": 0.005, "prony_time": 0.3}  # where they are felt
NOTHING = [name for name in Material._fields if name != "gravity"]
UNSEEN = {"base_tilt_y"}  # turns gravity about itself, as the arm's is along y
STEP = {"coulomb_friction": 1e-7, "cable_compliance": 1e-9}  # of a difference; 1e-5 for others


def simulator(*names: str) -> TrunkSimulator:
    robot = Robot.load("smooth_arm")
    discretisation = Discretisation(0.02)
    assembly = assemble(robot, discretisation)
    engine = Engine(assembly, 0.02, Backend("jax"), from_equilibrium=True)
    return TrunkSimulator(robot, engine, assembly, discretisation, tuple(REGISTRY[name]() for name in names))


def recorded(trunk: TrunkSimulator):
    clock = np.arange(0.0, 0.6, 0.1)
    value = 0.012 * np.column_stack([np.sin(8 * clock + phase) for phase in range(len(trunk.channel_names))])
    return trunk.commands(clock, value, np.zeros(value.shape[1]), np.arange(0.1, 0.61, 0.1))


@pytest.mark.slow
def test_all_at_once_null_values_and_derivatives():
    """Every mechanism of the body present in one simulator: null values change nothing, derivatives are differences."""
    base, extended = simulator(), simulator(*BODY)
    commands = recorded(base)
    names = [spec.name for name in BODY for spec in REGISTRY[name]().parameters]
    free = [spec.name for name in BODY for spec in REGISTRY[name]().parameters if not spec.grid]

    def position(values):
        return extended.rollout(PLACED | dict(zip(free, values, strict=True)), commands).position

    expected = jax.jit(lambda: base.rollout({}, commands))()
    null = jnp.zeros(len(free))
    run = jax.jit(jax.vmap(position))
    assert set(PLACED) <= set(names)
    slope = np.asarray(jax.jit(jax.jacfwd(position))(null))
    steps = np.array([STEP.get(name, 1e-5) for name in free])
    found = np.asarray(run(jnp.concatenate([null[None], jnp.diag(steps)])))
    np.testing.assert_allclose(found[0], expected.position, rtol=0.0, atol=1e-12)
    assert int(expected.status) == 0
    for i, name in enumerate(free):
        difference = (found[1 + i] - found[0]) / steps[i]
        largest = np.abs(difference).max()
        assert (largest > 0.0) == (name not in UNSEEN), name
        np.testing.assert_allclose(slope[..., i], difference, rtol=0.0, atol=2e-2 * largest, err_msg=name)


@pytest.mark.parametrize("name", BODY)
def test_parameters_state_their_null_value(name):
    for spec in REGISTRY[name]().parameters:
        assert spec.nominal == 0.0 or spec.grid
        assert all(spec.low < value < spec.high for value in spec.grid)


@pytest.mark.parametrize(("robot", "axes"), [("smooth_arm", "xz"), ("asl_trunk", "xy")])
def test_a_base_tilts_about_the_axes_across_gravity(robot, axes):
    described = Robot.load(robot)
    tilt = REGISTRY["base_tilt"].for_robot(described)
    assert [spec.name for spec in tilt.parameters] == [f"base_tilt_{axis}" for axis in axes]
    gravity = jnp.asarray(described.gravity)
    for spec in tilt.parameters:
        values = {s.name: jnp.asarray(0.3 if s is spec else 0.0) for s in tilt.parameters}
        turned = tilt.embody(values, Material(gravity=gravity, **dict.fromkeys(NOTHING)), None).gravity
        assert float(jnp.linalg.norm(turned)) == pytest.approx(9.81)
        assert float(turned @ gravity) == pytest.approx(9.81**2 * np.cos(0.3))


def embodied(name, **values):
    """Factors on the stiffness of the elements of a uniform arm, and the arm."""
    assembly = assemble(Robot.load("smooth_arm"), Discretisation(0.02))
    body = assembly.system.body
    plain = SimpleNamespace(stiffness_scale=jnp.ones(body.elements))
    plain._replace = lambda **given: SimpleNamespace(**given)
    material = REGISTRY[name]().embody({key: jnp.asarray(value) for key, value in values.items()}, plain, body)
    return np.asarray(material.stiffness_scale), body


def test_a_base_that_gives_adds_its_compliance_to_that_of_the_body():
    scale, body = embodied("base_compliance", base_compliance=0.3)
    compliance = np.diff(body.station) / body.bending_moment_area.mean(axis=1)
    np.testing.assert_allclose(np.sum(compliance / scale), 1.3 * np.sum(compliance), rtol=1e-6)


def test_a_soft_part_is_soft_at_its_place_alone():
    scale, body = embodied("soft_part", soft_part=-1.0, soft_part_place=0.5)
    middle = 0.5 * (body.station[1:] + body.station[:-1])
    s = (middle - body.station[0]) / body.length
    assert scale[np.argmin(np.abs(s - 0.5))] < 0.5
    np.testing.assert_allclose(scale[np.abs(s - 0.5) > 0.3], 1.0, atol=1e-3)
