"""Forces and energies of whole simulators: the weight of a mesh, the push on a cube, the same on both engines."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.mesh_points import NodePoints
from rfdropo_bayes.model.assembly import build_robot_simulator
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.meshes import read_tetrahedra
from rfdropo_bayes.simulators.body_engine import Backend, Engine
from rfdropo_bayes.simulators.mesh_body import MeshTrunkSimulator, TetrahedraTable, assemble_mesh
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble

TIME_STEP, PLATE = 0.01, -0.075
SOFA = Robot.load("trunk_sofa_mesh")
ROBOT = SOFA.model_copy(update={"push": SOFA.push.model_copy(update={"plate_height_m": PLATE})})
SOFT = {"young_modulus": jnp.asarray(2e5), "rayleigh_mass": jnp.asarray(0.3)}


@pytest.fixture(scope="module")
def trunk(bar_mesh) -> MeshTrunkSimulator:
    options = TetrahedraTable(mesh="bar.vtk", unit="mm", clamp_height=0.02)
    assembly = assemble_mesh(ROBOT, read_tetrahedra(bar_mesh, "mm"), options)
    engine = Engine(assembly, TIME_STEP, Backend(precision="float32"))
    return MeshTrunkSimulator(ROBOT, engine, assembly, options, TIME_STEP)


def every_step(simulator, rows: int):
    """The long cable at -y, pulled by 4 mm every five steps, observed in every step."""
    value = np.zeros((rows // 5, 8))
    value[:, 2] = 4e-3 * np.arange(1, rows // 5 + 1)
    return simulator.commands(0.05 * np.arange(rows // 5), value, np.zeros(8), TIME_STEP * np.arange(rows + 1))


@pytest.mark.slow
def test_the_base_of_a_mesh_holds_what_moves_it(trunk):
    """The change of momentum of all nodes is what base, cables, weight and drag make of it; energy comes from work."""
    commands, values = every_step(trunk, 20), trunk.complete(SOFT)
    found = jax.jit(trunk.balance)(SOFT, commands)
    material, assembly = trunk.material(values), trunk.assembly
    nodes = assembly.system.body.nodes
    engine = trunk.engine.recording(NodePoints(np.arange(nodes)[:, None], np.ones((nodes, 1))))
    motion = engine.motion(*trunk.inputs(values, commands))
    mass, position = np.asarray(material.node_mass), np.asarray(motion.position)
    momentum = np.einsum("n,rni->ri", mass, np.diff(position, axis=0, prepend=position[:1]) / TIME_STEP)
    layout = assembly.system.cables
    guide = np.einsum("ck,rcki->rci", layout.guide_weight[:, 0], position[:-1, layout.guide_node[:, 0]])
    towards = layout.anchor - guide
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    cables = np.einsum("rc,rci->ri", np.asarray(motion.tension)[1:], towards)
    weight = mass.sum() * np.asarray(material.gravity)
    expected = np.diff(momentum, axis=0) / TIME_STEP + 0.3 * momentum[1:] - weight - cables
    assert np.abs(cables).max() > 0.05
    np.testing.assert_allclose(found.base_force[1:], expected, atol=1e-8)
    assert np.abs(found.contact_force).max() < 1e-8
    given = np.asarray(found.cable_work - (found.total_energy - found.total_energy[0]))
    assert given[-1] > float(found.damping_loss[-1]) > 0.0
    assert np.all(np.diff(given) > -1e-9)


@pytest.mark.slow
def test_what_the_cube_is_pushed_by_pushes_the_trunk_back(trunk):
    """Without friction only the trunk moves a cube along the plate."""
    beside = trunk.with_backend(Backend()).pushing()
    commands = every_step(beside, 50)
    height = PLATE + 0.0175 + 0.005
    values = SOFT | {"friction": jnp.asarray(0.0), "cube_x": jnp.asarray(-0.02), "cube_y": jnp.asarray(height)}
    found, seen = beside.balance(values, commands), beside.rollout(values, commands)
    velocity = np.diff(np.asarray(seen.object_pose)[:, :3], axis=0, prepend=np.asarray(seen.object_pose)[:1, :3])
    velocity /= TIME_STEP
    mass = float(beside.complete({})["cube_mass"])
    pushed = mass * (velocity[1:] - velocity[:-1] / (1.0 + 0.3 * TIME_STEP)) / TIME_STEP
    along = np.asarray(found.contact_force)[1:, [0, 2]]
    assert np.abs(along).max() > 0.01
    np.testing.assert_allclose(pushed[:, [0, 2]], -along, atol=1e-8)
    assert found.contact_force[:, 1].max() > 0.1


@pytest.mark.slow
def test_both_engines_balance_alike():
    robot, discretisation = Robot.load("smooth_arm"), Discretisation(TIME_STEP)
    assembly = assemble(robot, discretisation)
    fast = TrunkSimulator(robot, Engine(assembly, TIME_STEP, from_equilibrium=True), assembly, discretisation)
    slow = replace(fast, engine=replace(fast.engine, backend=Backend("jax")))
    channels = len(robot.channel_names)
    value = 2e-3 * np.outer(np.arange(4), np.arange(channels) % 2)
    commands = fast.commands(0.05 * np.arange(4), value, np.zeros(channels), 0.05 * np.arange(5))
    one, other = (jax.jit(simulator.balance)({}, commands) for simulator in (fast, slow))
    for name, ours, theirs in zip(one._fields, one, other, strict=True):
        scale = max(1e-3, float(np.abs(theirs).max()))
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-6 * scale, err_msg=name)
    assert np.abs(one.base_force).max() > 0.1


def test_only_the_states_of_implicit_euler_tell_the_velocities_of_a_mesh(trunk):
    """Another integrator is refused rather than taken for it."""
    other = replace(trunk, engine=replace(trunk.engine, integrator="sdirk2"))
    with pytest.raises(InputError, match="of a mesh are not available with integrator 'sdirk2'"):
        other.balance({}, every_step(trunk, 5))


@pytest.mark.slow
def test_an_arm_that_hangs_still_is_carried_by_its_base_under_sdirk2():
    """And one that is pulled gets its energy from the cables: 1 % is lost to the steps, of implicit Euler 25 %."""
    robot = Robot.load("smooth_arm").with_changes(initial_state="equilibrium")
    arm = build_robot_simulator(ModelSpec(robot))
    assert arm.engine.integrator == "sdirk2"
    rows, channels = 20, len(robot.channel_names)
    slack = np.full(channels, -5e-3)
    value = np.tile(slack, (rows, 1))
    value[10:, 1] = 2e-3
    commands = arm.commands(0.05 * np.arange(rows), value, slack, 0.05 * np.arange(rows + 1))
    found = jax.jit(arm.balance)({}, commands)
    weight = robot.nominal()["trunk_mass"] * robot.gravity
    np.testing.assert_allclose(found.base_force[:10], np.tile(-weight, (10, 1)), atol=1e-3 * np.linalg.norm(weight))
    euler = replace(arm, engine=replace(arm.engine, integrator="euler"))
    other = jax.jit(euler.balance)({}, commands)
    shares = [abs(float(each.other_loss[-1] / each.cable_work[-1])) for each in (found, other)]
    assert shares[0] < 0.03
    assert shares[1] > 0.1
