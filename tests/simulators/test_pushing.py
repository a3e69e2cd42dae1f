"""A trunk that pushes a cube, on a bar of few tetrahedra: rest, reaction, gaps, result codes."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import state_at_rest
from rfdropo_bayes.fem.constraints import NORMAL_SOFTNESS
from rfdropo_bayes.fem.pushing import find_contacts
from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.model.assembly import backend
from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.meshes import read_tetrahedra
from rfdropo_bayes.simulators.body_engine import Backend, Engine
from rfdropo_bayes.simulators.cube import push_table
from rfdropo_bayes.simulators.mesh_body import MeshTrunkSimulator, TetrahedraTable, assemble_mesh
from rfdropo_bayes.simulators.protocol import Result, Simulator
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble

TIME_STEP, HALF = 0.01, 0.0175
SOFA = Robot.load("trunk_sofa_mesh")
PLATE = -0.075
"""[m] The bar bends less than SOFA's trunk: a plate that it reaches."""
ROBOT = SOFA.model_copy(update={"push": SOFA.push.model_copy(update={"plate_height_m": PLATE})})
REST_HEIGHT = PLATE + HALF + 0.005


SUNK = NORMAL_SOFTNESS * 9.81 * TIME_STEP**2
"""[m] How far the plate gives way under a cube at rest, whatever its mass and side: h R m g h / 4 at each of 4 corners,
with R = w beta^2 / (4 pi^2) and w = 4 / m, the mean of a corner's rows."""
SOFT = {"young_modulus": 2e5}


@pytest.fixture(scope="module")
def trunk(bar_mesh) -> MeshTrunkSimulator:
    options = TetrahedraTable(mesh="bar.vtk", unit="mm", clamp_height=0.02, frames="edges", masses="equal")
    assembly = assemble_mesh(ROBOT, read_tetrahedra(bar_mesh, "mm"), options)
    return MeshTrunkSimulator(ROBOT, Engine(assembly, TIME_STEP), assembly, options, TIME_STEP)


def on(trunk, chosen: Backend) -> RobotSimulator:
    """The trunk with its cube, on a backend."""
    return trunk.with_backend(chosen).pushing()


@pytest.fixture(scope="module")
def beside(trunk) -> RobotSimulator:
    return on(trunk, Backend(threads=1))


@pytest.fixture(scope="module")
def commands(trunk):
    """Half a second of pulling the long cable at -y, slowly."""
    rows = 10
    value = np.zeros((rows, 8))
    value[:, 2] = 4e-3 * np.arange(1, rows + 1)
    return trunk.commands(0.05 * np.arange(rows), value, np.zeros(8), 0.05 * np.arange(rows + 1))


@pytest.fixture(scope="module")
def rollout(beside, commands):
    """The simulation, compiled once for all values of the cube."""
    names = ("young_modulus", "cube_mass", "friction", "cube_x", "cube_y", "cube_yaw")
    nominal = {spec.name: float(spec.nominal) for spec in beside.parameters} | SOFT
    run = jax.jit(lambda values: beside.rollout(values, commands))
    return lambda **changes: run({name: jnp.asarray(changes.get(name, nominal[name])) for name in names})


def test_it_is_a_simulator_with_the_cubes_parameters(beside, trunk):
    assert isinstance(beside, Simulator)
    names = {spec.name for spec in beside.parameters} - {spec.name for spec in trunk.parameters}
    assert names == {"cube_mass", "friction", "cube_side", "cube_x", "cube_y", "cube_z", "cube_yaw"}
    with pytest.raises(InputError, match="unknown parameter"):
        beside.rollout({"cube_weight": jnp.asarray(1.0)}, None)


@pytest.mark.slow
def test_the_cube_comes_to_rest_and_a_trunk_that_does_not_touch_it_moves_as_without(rollout, trunk, commands):
    aside = rollout(young_modulus=4.5e6, cube_x=0.25, cube_y=-0.03, cube_yaw=0.5)
    pose = np.asarray(aside.object_pose)
    np.testing.assert_allclose(pose[1, 1], -0.03 - 14.681e-3, atol=5e-7)  # as in SOFA's recordings
    np.testing.assert_allclose(pose[-1, :3], [0.25, REST_HEIGHT - SUNK, 0.1], atol=1e-6)
    np.testing.assert_allclose(pose[-1, 3:], [0.0, np.sin(0.25), 0.0, np.cos(0.25)], atol=1e-6)
    alone = trunk.rollout({}, commands)
    np.testing.assert_allclose(aside.position, alone.position, atol=1e-9)
    assert int(aside.status) == Result.OK


@pytest.mark.slow
def test_the_trunk_pushes_the_cube_and_the_cube_holds_the_trunk(rollout, trunk, commands):
    """A cube beside the trunk's path that is heavy and rough resists more than a light and smooth one."""
    beside = {"cube_x": -0.02, "cube_y": REST_HEIGHT}
    alone = np.asarray(trunk.rollout(SOFT, commands).position)
    light, heavy = rollout(**beside, cube_mass=0.02, friction=0.05), rollout(**beside, cube_mass=5.0, friction=0.9)
    assert int(light.status) == int(heavy.status) == Result.OK
    lifted = np.asarray(heavy.position)[-1, :, 1] - alone[-1, :, 1]
    assert lifted.max() > 2e-3
    moved = [float(jnp.linalg.norm(found.object_pose[-1, :3] - found.object_pose[0, :3])) for found in (light, heavy)]
    assert moved[0] > 2.0 * moved[1]
    assert np.asarray(light.object_pose)[:, 1].min() > REST_HEIGHT - SUNK - 1e-5


CUBES = {"cube_x": [-0.02, -0.02, 0.25, 0.005], "cube_mass": [0.02, 5.0, 0.05, 0.05], "friction": [0.05, 0.9, 0.3, 0.3]}
"""A light cube that slides away under the trunk, a heavy one that stays, one far from it, one in the middle."""
AGREEMENT = {"float64": 1e-9, "float32": 3e-5}  # [m]


def agree(found, expected, k: int, precision: str) -> None:
    """Rollout k of ``CUBES`` is the one expected."""
    tolerance = AGREEMENT[precision]
    np.testing.assert_allclose(found.position[k], expected.position, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(found.object_pose[k, :, :3], expected.object_pose[:, :3], rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(found.object_pose[k, :, 3:], expected.object_pose[:, 3:], rtol=0.0, atol=30 * tolerance)
    assert int(found.status[k]) == int(expected.status) == Result.OK


@pytest.mark.slow
@pytest.mark.parametrize("precision", list(AGREEMENT))
def test_a_batch_gives_the_numbers_of_its_rollouts(rollout, trunk, commands, precision):
    """Cubes of all kinds, as a batch, against rollouts in double precision; and bit for bit the same on two threads."""
    scene = {name: jnp.asarray(value) for name, value in (SOFT | {"cube_y": REST_HEIGHT}).items()}
    batch = {name: jnp.asarray(values) for name, values in CUBES.items()}
    engines = [on(trunk, Backend("numba", precision, threads)) for threads in (1, 2)]
    one, two = (jax.jit(lambda values, e=e: e.rollout(values | scene, commands)) for e in engines)
    found = jax.vmap(one)(batch)
    for k in range(4):
        cube = {name: float(values[k]) for name, values in CUBES.items()}
        agree(found, rollout(**cube, cube_y=REST_HEIGHT), k, precision)
        alone = one({name: values[k] for name, values in batch.items()})
        np.testing.assert_array_equal(alone.position, found.position[k])
        np.testing.assert_array_equal(alone.object_pose, found.object_pose[k])
    again = jax.vmap(two)({name: jnp.tile(values, 5) for name, values in batch.items()})
    np.testing.assert_array_equal(again.object_pose[4:8], found.object_pose)


@pytest.mark.slow
def test_touching_surfaces_keep_their_distance(rollout):
    """The trunk lies on the cube: no point comes nearer than the contact distance, beyond the step's linearisation."""
    found = rollout(cube_mass=5.0, friction=0.9, cube_y=REST_HEIGHT)
    centre = np.asarray(found.object_pose)[-1, :3]
    markers = np.asarray(found.position)[-1]
    over = (np.abs(markers[:, 0] - centre[0]) < 0.015) & (np.abs(markers[:, 2] - centre[2]) < 0.015)
    assert over.any()
    assert markers[over, 1].min() > centre[1] + HALF + 0.005 + 0.009  # the bar's half width is 13 mm


def test_contacts_act_equally_on_both_sides():
    """Every row pushes rod and cube with opposite forces: momentum is kept; normal rows keep angular momentum, and
    friction acts on the two surfaces, which are apart by the gap and the contact distance."""
    assembly = assemble(ROBOT, Discretisation(TIME_STEP))
    pushing = TrunkSimulator(ROBOT, Engine(assembly, TIME_STEP), assembly, Discretisation(TIME_STEP)).pushing()
    scene, rest = pushing.engine.scene, state_at_rest(assembly.system)
    values = pushing.complete({"cube_y": jnp.asarray(-0.035), "cube_yaw": jnp.asarray(0.3)})
    cube, start = pushing.body_inputs(values)[1]
    touch = jax.jit(lambda: find_contacts(scene, cube, start, rest.position, rest.orientation))()
    rows = np.moveaxis(np.asarray(touch.rows), 2, 0)  # (row, station, 6)
    on_trunk, on_cube = rows.reshape(-1, 3, *rows.shape[1:]), np.asarray(touch.on_cube)
    between = slice(8, 8 + (len(on_cube) - 8) // 2)
    beside = slice(between.stop, None)
    np.testing.assert_allclose(on_trunk[between, ..., :3].sum(axis=2), -on_cube[between, :, :3], atol=1e-12)
    assert np.abs(on_trunk[:8]).max() == 0.0
    assert np.abs(on_cube[beside]).max() == 0.0
    arms = np.asarray(rest.position) - np.asarray(start.position)
    torque = (np.cross(arms, on_trunk[between, ..., :3]) + on_trunk[between, ..., 3:]).sum(axis=2)
    gap = np.asarray(touch.gap)[between] + scene.contact_distance
    frame = np.asarray(touch.frame)[between]
    apart = gap[:, None, None] * np.cross(frame[:, :1], frame)
    np.testing.assert_allclose(torque, -on_cube[between, :, 3:] + apart, atol=1e-9)


@pytest.mark.slow
def test_a_rod_pushes_too():
    """The same robot as a rod, softened: it lies on a heavy cube that its outline keeps at a distance."""
    discretisation = Discretisation(TIME_STEP)
    assembly = assemble(ROBOT, discretisation)
    trunk = TrunkSimulator(ROBOT, Engine(assembly, TIME_STEP), assembly, discretisation)
    reference, compiled = (on(trunk, Backend(name)) for name in ("jax", "numba"))
    rows = 8
    value = np.zeros((rows, 8))
    value[:, 2] = 3e-3 * np.arange(1, rows + 1)
    commands = trunk.commands(0.05 * np.arange(rows), value, np.zeros(8), 0.05 * np.arange(rows + 1))
    run = jax.jit(lambda values: reference.rollout(values, commands))
    scene = {"cube_mass": 5.0, "friction": 0.9, "cube_y": REST_HEIGHT, "young_modulus": 4.5e6}
    cases = [{name: jnp.asarray(v) for name, v in (scene | {"cube_x": x}).items()} for x in (0.25, 0.0)]
    aside, below = map(run, cases)
    for case, expected in zip(cases, (aside, below), strict=True):
        found = compiled.rollout(case, commands)
        np.testing.assert_allclose(found.position, expected.position, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(found.object_pose, expected.object_pose, rtol=0.0, atol=1e-9)
    alone = trunk.rollout({}, commands)
    assert int(aside.status) == int(below.status) == Result.OK
    before = np.asarray(alone.position)[..., 1].min(axis=1) > PLATE + 0.025
    assert before.sum() >= 3
    np.testing.assert_allclose(aside.position[before], alone.position[before], atol=1e-9)
    lifted = np.asarray(below.position)[-1, :, 1] - np.asarray(alone.position)[-1, :, 1]
    assert lifted.max() > 2e-3
    near = np.abs(np.asarray(below.position)[-1, :, 2] - 0.1) < 0.012
    assert np.asarray(below.position)[-1, near, 1].min() > REST_HEIGHT + HALF + 0.005 + 0.006


@pytest.mark.slow
def test_a_rollout_that_is_lost_says_so(rollout):
    assert int(rollout(cube_mass=float("nan")).status) == Result.DIVERGED


class Standing(NamedTuple):
    """An engine whose trunk and cube stand still, and whose rollout ends as it is told."""

    markers: int
    ending: dict
    lanes: int = 1
    is_rod: bool = False
    at_rest: bool = False
    scene: str = "a cube on a plate"

    def describe(self) -> dict:
        return {"engine": "none"}

    def motion(self, material, start, displacement, steps, cube, loads=None) -> Motion:
        rows = len(displacement) + 1
        pose = jnp.concatenate([cube.start.position, cube.start.orientation])
        ending = {"diverged": False, "converged": True, "imbalance": 0.0} | self.ending
        ending = {name: jnp.asarray(value) for name, value in ending.items()}
        return Motion(
            jnp.zeros((rows, self.markers, 3)), jnp.zeros((rows, 8)), pose=jnp.tile(pose, (rows, 1)), **ending
        )


@pytest.mark.parametrize(
    ("ending", "result"),
    [
        ({}, Result.OK),
        ({"converged": False}, Result.CONTACT_NOT_CONVERGED),
        ({"imbalance": 1.0, "converged": False}, Result.NOT_IN_EQUILIBRIUM),
        ({"diverged": True, "converged": False}, Result.DIVERGED),
    ],
)
def test_a_rollout_says_how_it_ended(trunk, commands, ending, result):
    simulator = replace(trunk, engine=Standing(len(trunk.marker_names), ending))
    observation = simulator.rollout({"cube_yaw": jnp.asarray(0.4)}, commands)
    assert int(observation.status) == result
    np.testing.assert_allclose(observation.object_pose[-1, 3:], [0.0, np.sin(0.2), 0.0, np.cos(0.2)], atol=1e-12)
    assert simulator.description["engine"] == "none"
    assert simulator.description["object"] == "cube"


def test_the_engine_is_the_one_that_was_asked_for(trunk):
    for asked in ({}, {"engine": "numba", "precision": "float32"}):
        built = on(trunk, backend(SimulatorTable(push=True, **asked), False))
        assert built.description["engine"] == "numba"
        assert built.description["precision"] == asked.get("precision", "float64")
    with pytest.raises(InputError, match="JAX has no body of tetrahedra"):
        on(trunk, Backend("jax"))


def test_a_robot_without_a_cube_is_refused():
    with pytest.raises(InputError, match="no cube to push"):
        push_table(Robot.load("smooth_arm"))


def test_a_cube_that_was_measured_stands_on_the_plate(beside):
    """At the distance that surfaces keep, wherever the measured height is: else the first step throws it up."""
    placed = beside.with_object_at({}, np.array([0.01, -0.03, 0.12, 0.0, 0.0, 0.0, 1.0]))
    assert float(placed["cube_x"]) == pytest.approx(0.01)
    assert float(placed["cube_y"]) == pytest.approx(REST_HEIGHT)
    assert float(placed["cube_z"]) == pytest.approx(0.12)
