"""The trunk whose body is a mesh: both engines, batches, options and mechanisms, on a bar of few tetrahedra."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import REGISTRY, mechanisms_named
from rfdropo_bayes.policies.episodes import Episodes, Settings
from rfdropo_bayes.policies.randomisation import Point
from rfdropo_bayes.policies.tasks import task_named
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.meshes import read_tetrahedra
from rfdropo_bayes.simulators.body_engine import Backend, Engine
from rfdropo_bayes.simulators.commands import animated_on_grid
from rfdropo_bayes.simulators.mechanisms import bodies_of, obstacle
from rfdropo_bayes.simulators.mesh_body import MeshTrunkSimulator, TetrahedraTable, assemble_mesh
from rfdropo_bayes.simulators.protocol import Result, Simulator

TIME_STEP = 0.01
SOFA = {"frames": "edges", "masses": "equal", "drives": "sofa", "drive_rate": 1e-3}
LONG = ("long_0", "long_1", "long_2", "long_3")
ROBOT = Robot.load("trunk_sofa_mesh")


@pytest.fixture(scope="module")
def mesh(bar_mesh):
    return read_tetrahedra(bar_mesh, "mm")


def table(**options) -> TetrahedraTable:
    return TetrahedraTable(**{"mesh": "bar.vtk", "unit": "mm", "clamp_height": 0.02, "marker_cables": LONG} | options)


def trunk(mesh, *, engine="numba", robot=ROBOT, mechanisms=(), precision="float64", **options):
    chosen = table(**options)
    assembly = assemble_mesh(robot, mesh, chosen)
    made = Engine(assembly, TIME_STEP, Backend(engine, precision))
    return MeshTrunkSimulator(robot, made, assembly, chosen, TIME_STEP, mechanisms_named(mechanisms))


def pulls(simulator, rows: int = 6):
    """An action of 5 mm every 0.05 s."""
    value = np.zeros((rows, 8))
    value[:, 1] = 5e-3 * np.arange(1, rows + 1)
    value[2:, 4] = -5e-3
    return simulator.commands(0.05 * np.arange(rows), value, np.zeros(8), 0.05 * np.arange(rows + 1))


@pytest.fixture(scope="module")
def sofa(mesh):
    return trunk(mesh, **SOFA)


def test_it_is_a_simulator_with_the_robots_parameters(sofa):
    assert isinstance(sofa, Simulator)
    names = [spec.name for spec in sofa.parameters]
    assert {"young_modulus", "poisson_ratio", "trunk_mass", "rayleigh_mass", "rayleigh_stiffness"} < set(names)
    assert {"offset_x", "offset_y", "offset_z"} < set(names)
    with pytest.raises(InputError, match="unknown parameter"):
        sofa.rollout({"young_modolus": jnp.asarray(4e6)}, pulls(sofa))


@pytest.mark.slow
def test_markers_start_at_the_mean_of_the_guides_and_the_first_stays(sofa):
    observation = sofa.rollout({}, pulls(sofa))
    guides = np.mean(sofa.robot.guides()[:4], axis=0)
    np.testing.assert_allclose(observation.position[0, 1:], guides, atol=1e-12)
    np.testing.assert_allclose(observation.position[:, 0], 0.0, atol=1e-12)
    assert float(jnp.abs(observation.position[-1, -1] - observation.position[0, -1]).max()) > 1e-3
    assert int(observation.status) == Result.OK
    assert float(observation.tension.max()) > 0.1


def test_it_has_no_episodes_and_says_so(sofa):
    task, settings = task_named("TrunkReach-v0"), Settings()
    with pytest.raises(InputError, match="a body of tetrahedra cannot run in control sessions"):
        Episodes(sofa, task, 1, Point({}), settings)


@pytest.mark.slow
def test_a_batch_is_one_call_and_a_lost_rollout_leaves_its_neighbours_alone(sofa):
    commands = pulls(sofa)
    young = jnp.array([3e6, 4.5e6, jnp.nan, 6e6, 7e6])
    batch = jax.jit(jax.vmap(lambda e: sofa.rollout({"young_modulus": e}, commands)))
    assert str(jax.make_jaxpr(batch)(young)).count("pure_callback[") == 1
    together = batch(young)
    np.testing.assert_array_equal(together.status, [0, 0, Result.DIVERGED, 0, 0])
    for sample in (0, 1, 4):
        alone = sofa.rollout({"young_modulus": young[sample]}, commands)
        np.testing.assert_array_equal(alone.position, together.position[sample])
    assert np.isfinite(together.position).all()


@pytest.mark.slow
def test_a_prefix_has_the_rows_of_the_whole(sofa):
    commands = pulls(sofa)
    whole, part = sofa.rollout({}, commands), sofa.rollout({}, commands, jnp.asarray(10))
    np.testing.assert_array_equal(part.position[:3], whole.position[:3])


@pytest.mark.slow
def test_single_precision_stays_close(mesh, sofa):
    commands = pulls(sofa)
    single = trunk(mesh, precision="float32", **SOFA).rollout({}, commands)
    np.testing.assert_allclose(single.position, sofa.rollout({}, commands).position, atol=3e-6)


@pytest.mark.slow
def test_pretension_pulls_before_any_command(mesh, sofa):
    commands = pulls(sofa)._replace(step=np.zeros((30, 8)))
    slack = sofa.rollout({}, commands).tension
    tight = sofa.rollout({"initial_displacement_long_0": jnp.asarray(2e-3)}, commands).tension
    assert float(tight[-1, 0]) > float(slack[-1, 0]) + 0.1


def test_drives_of_the_robot_stop_at_their_limits(mesh):
    simulator = trunk(mesh)
    value = np.zeros((2, 8))
    value[:, 0] = 1.0
    commands = simulator.commands([0.0, 0.05], value, np.zeros(8), [0.0, 0.05, 0.1])
    values = simulator.complete({})
    assert float(simulator.displacements(values, commands).max()) == pytest.approx(0.07)


@pytest.mark.slow
def test_body_mechanisms_are_nested_and_act(mesh, sofa):
    names = ["payload", "stiffness_gradient", "base_tilt"]
    extended = trunk(mesh, mechanisms=names, **SOFA)
    commands = pulls(sofa)
    base = sofa.rollout({}, commands).position
    np.testing.assert_array_equal(extended.rollout({}, commands).position, base)
    loaded = extended.material(extended.complete({"payload_mass": jnp.asarray(0.1)})).node_mass
    heavier = np.asarray(loaded - sofa.material(sofa.complete({})).node_mass)
    assert heavier.sum() == pytest.approx(0.1)
    assert np.all(mesh.position[heavier > 0.0, 2] > 0.18)
    for name, value in (("payload_mass", 0.1), ("stiffness_gradient", 2.0), ("base_tilt_x", 0.3)):
        moved = extended.rollout({name: jnp.asarray(value)}, commands).position
        assert float(jnp.abs(moved - base).max()) > 1e-5


@pytest.mark.parametrize("masses", ["equal", "volume"])
def test_masses_add_up_to_the_trunks(mesh, masses):
    simulator = trunk(mesh, masses=masses)
    material = simulator.material(simulator.complete({"trunk_mass": jnp.asarray(0.3)}))
    assert float(material.node_mass.sum()) == pytest.approx(0.3)


def test_options_that_do_not_fit_are_refused(mesh):
    for options, message in (
        ({"marker_cables": ("long_9",)}, "no cable 'long_9'"),
        ({"marker_cables": ("long_0", "short_4")}, "of some cables but not of all"),
        ({"drive_rate": 1e-3}, "drive_rate has no effect"),
        ({"clamp_height": -1.0}, "no node is fixed"),
    ):
        with pytest.raises(InputError, match=message):
            assemble_mesh(ROBOT, mesh, table(**options))
    with pytest.raises(InputError, match="starts in equilibrium"):
        assemble_mesh(Robot.load("trunk_physical"), mesh, table())


def test_animated_commands_follow_their_own_clock():
    time = 0.05 * np.arange(4)
    value, initial = 5e-3 * np.arange(2.0, 6.0)[:, None], np.array([5e-3])
    grid = animated_on_grid(time, value, initial, 0.05 * np.arange(5), time_step=0.01)
    assert len(grid.step) == 20
    updates = np.diff(grid.step[:, 0], prepend=initial[0])
    assert set(np.round(updates / 1e-3).astype(int)) <= {1, 2}
    held = animated_on_grid(time[:1], value[:1], initial, np.array([0.0, 0.2]), time_step=0.01)
    assert held.step[-1, 0] == pytest.approx(value[0, 0], rel=0.1)
    for uneven in ([0.0, 0.05, 0.11, 0.15], [0.05, 0.1, 0.15, 0.2], [0.0, 0.01, 0.02, 0.03]):
        with pytest.raises(InputError, match="not evenly spaced"):
            animated_on_grid(np.array(uneven), value, initial, 0.05 * np.arange(6), time_step=0.01)


def test_a_mass_at_a_station_has_its_centre_at_the_height_of_the_station(sofa):
    """However coarse the mesh is there, and however long the layers beside the station are: a payload is at the tip."""
    height = sofa.assembly.system.body.rest[:, 2]
    station = np.asarray(sofa.robot.body.station_m)
    share = sofa.assembly.station_share
    assert (share >= 0.0).all()
    np.testing.assert_allclose(share.sum(axis=0), 1.0, rtol=1e-12)
    np.testing.assert_allclose(height @ share, np.clip(station, height.min(), height.max()), atol=1e-12)


@pytest.mark.parametrize("name", sorted(REGISTRY))
def test_every_mechanism_says_whether_it_runs_on_a_mesh(sofa, name):
    (mechanism,) = mechanisms_named([name], ROBOT)
    simulator = replace(sofa, mechanisms=(mechanism,))
    if "tetrahedra" in bodies_of(mechanism):
        jax.eval_shape(lambda commands: simulator.rollout({}, commands), pulls(sofa))
    else:
        assert obstacle(mechanism, "tetrahedra", "numba") is not None
        with pytest.raises(InputError, match="rods only"):
            jax.eval_shape(lambda commands: simulator.rollout({}, commands), pulls(sofa))


def test_drives_that_sofa_limits_go_with_its_own_steps_only(mesh):
    """Their limit is one of a step of implicit Euler; the robot's own drives take any integrator, which is recorded."""
    assembly = assemble_mesh(ROBOT, mesh, table(**SOFA))
    with pytest.raises(InputError, match="drives that SOFA limits"):
        Engine(assembly, TIME_STEP, integrator="sdirk2")
    free = Engine(assemble_mesh(ROBOT, mesh, table()), TIME_STEP, integrator="sdirk2")
    assert free.describe()["integrator"] == "sdirk2"
    assert "integrator" not in replace(free, integrator="euler").describe()
