"""A rod that pushes cubes, on the compiled engine: the numbers of the reference engine, and of each lane."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.effects import BendingLaw, BodyEffects, Viscoelasticity, Wall
from rfdropo_bayes.fem.native.rod_engine import NativeRod
from rfdropo_bayes.fem.pushing import PushGeometry, push_scene, rod_spheres
from rfdropo_bayes.fem.rigid_body import Cube, cube_at, solid_gyration_radius

BATCH, STEPS, TIME_STEP, LENGTH, ELEMENTS, SIDE, PLATE = 11, 60, 0.01, 0.12, 6, 0.03, -0.055
AGREEMENT = {"float64": 1e-9, "float32": 3e-5}  # [m]


@functools.cache
def bar() -> tuple[fem.System, fem.PointMap, PushGeometry]:
    """A soft bar with three cables above a plate."""
    body = fem.uniform_rod(LENGTH, 0.01, 0.01, ELEMENTS)
    angle = np.pi / 2 * np.arange(3) + 0.1
    circle = 0.008 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    guides = [place + np.array([0.0, 0.0, 1.0]) * body.station[1::2, None] for place in circle]
    system = fem.System(body, fem.cable_layout(body, circle - [0.0, 0.0, 0.01], guides))
    up = np.array([0.0, 1.0, 0.0])
    scene = push_scene(rod_spheres(body), plate_normal=up, plate_height=PLATE, contact_distance=0.005)
    return system, fem.attach(body, np.array([[0.0, 0.0, LENGTH], [0.003, 0.002, 0.06]])), scene


@functools.cache
def case() -> tuple[fem.Material, np.ndarray, np.ndarray, np.ndarray]:
    """Materials, commands, and cubes (state, values) of all kinds: under the bar, beside it, and one far away."""
    random = np.random.default_rng(0)
    material = fem.Material(
        young_modulus=3e5 * np.exp(0.3 * random.normal(size=BATCH)),
        poisson_ratio=random.uniform(0.3, 0.48, BATCH),
        density=random.uniform(800.0, 1200.0, BATCH),
        rayleigh_mass=np.full(BATCH, 0.1),
        rayleigh_stiffness=random.uniform(0.01, 0.05, BATCH),
        gravity=np.tile([0.0, -9.81, 0.0], (BATCH, 1)),
        stiffness_scale=np.ones((BATCH, ELEMENTS)),
        point_mass=np.zeros((BATCH, ELEMENTS + 1)),
        axial_scale=np.ones(BATCH),
    )
    pull = np.linspace(0.0, 6e-3, STEPS)[:, None] * np.array([0.0, 0.0, 1.0])
    displacement = np.cumsum(3e-4 * random.normal(size=(BATCH, STEPS, 3)), axis=1) + pull
    x, z, yaw = (
        random.uniform(-0.025, 0.025, BATCH),
        random.uniform(0.06, 0.11, BATCH),
        random.uniform(-0.5, 0.5, BATCH),
    )
    x[0] = 0.3
    zero = np.zeros(BATCH)
    centre = np.stack([x, np.full(BATCH, PLATE + SIDE / 2 + 0.006), z], axis=1)
    turn = np.stack([zero, np.sin(yaw / 2), zero, np.cos(yaw / 2)], axis=1)
    mass, friction = 0.5 * np.exp(random.uniform(-4.0, 0.0, BATCH)), random.uniform(0.05, 0.8, BATCH)
    side = np.full(BATCH, SIDE)
    values = np.stack([mass, side, side / np.sqrt(6.0), friction], axis=1)
    return material, displacement, np.concatenate([centre, turn, np.zeros((BATCH, 6))], axis=1), values


def engine(precision: str = "float64", threads: int = 1) -> NativeRod:
    system, points, scene = bar()
    return NativeRod(system, points, TIME_STEP, precision=precision, threads=threads, scene=scene)


def reference():
    """Rollouts of a batch on the reference engine."""
    system, points, scene = bar()

    @jax.jit
    @jax.vmap
    def run(material, displacement, state, values):
        mass, side, _, friction = values
        cube = cube_at(state[:3], 0.0, scene.plate_normal)._replace(orientation=state[3:7])
        start = fem.state_at_rest(system)._replace(cube=cube)
        solid = Cube(mass, side, solid_gyration_radius(side), friction)
        prepared, rows = fem.prepare(system, material), displacement[:, None]
        return fem.simulate(system, prepared, start, rows, TIME_STEP, points, scene=scene, cube=solid)

    return run


@pytest.mark.slow
def test_agrees_with_the_reference():
    system, points, _ = bar()
    material, displacement, state, values = case()
    wanted = reference()(material, jnp.asarray(displacement), jnp.asarray(state), jnp.asarray(values))
    slid = np.linalg.norm(wanted.pose[:, -1, :3] - wanted.pose[:, 0, :3], axis=1)
    assert np.sum(slid > 5e-4) >= 3
    plain = NativeRod(system, points, TIME_STEP, threads=1).rollout(material, displacement)
    lifted = np.abs(plain.position[:, 1:] - wanted.position).max(axis=(1, 2, 3))
    assert np.all(wanted.converged)
    assert np.sum(lifted > 2e-3) >= 5
    for precision, tolerance in AGREEMENT.items():
        found = engine(precision).rollout(material, displacement, cube=(state, values))
        assert np.abs(found.position[:, 1:] - wanted.position).max() < tolerance
        assert np.abs(found.pose[:, 1:, :3] - wanted.pose[..., :3]).max() < tolerance
        assert found.converged.all()
        assert not found.diverged.any()
    np.testing.assert_array_equal(found.pose[:, 0], state[:, :7].astype(np.float32))


@pytest.mark.slow
def test_batch_and_threads_do_not_matter():
    """Bit for bit: alone, in any order, on two threads; and a cube far away changes nothing beyond what each of the 60
    problems leaves: SETTLED of the largest velocity, below 1 m/s, times the time step is 1e-13 m."""
    material, displacement, state, values = case()
    whole = engine().rollout(material, displacement, cube=(state, values))
    plain = NativeRod(*bar()[:2], TIME_STEP, threads=1).rollout(material, displacement)
    np.testing.assert_allclose(whole.position[0], plain.position[0], rtol=0.0, atol=1e-12)
    order = np.random.default_rng(1).permutation(BATCH)
    shuffled = jax.tree.map(lambda value: value[order] if np.ndim(value) else value, material)
    other = engine(threads=2).rollout(shuffled, displacement[order], cube=(state[order], values[order]))
    alone = engine().rollout(
        jax.tree.map(lambda value: value[3], material), displacement[3], cube=(state[3], values[3])
    )
    for one, two, three in zip(jax.tree.leaves(whole), jax.tree.leaves(other), jax.tree.leaves(alone), strict=True):
        np.testing.assert_array_equal(one[order], two)
        np.testing.assert_array_equal(one[3:4], three)


@pytest.mark.slow
def test_lost_cubes_leave_their_neighbours_alone():
    """A cube whose mass is not a number is marked, and touches no other lane."""
    material, displacement, state, values = case()
    whole = engine().rollout(material, displacement, cube=(state, values))
    bad = values.copy()
    bad[2, 0] = np.nan
    found = engine().rollout(material, displacement, cube=(state, bad))
    assert found.diverged[2]
    for one, two in zip(jax.tree.leaves(whole), jax.tree.leaves(found), strict=True):
        assert np.all(np.isfinite(two))
        np.testing.assert_array_equal(np.delete(one, 2, axis=0), np.delete(two, 2, axis=0))


@pytest.mark.slow
def test_every_effect_of_the_body_and_the_cables_goes_with_a_cube():
    """Bending law, viscosity, softening, drag, wall, compliance and both kinds of friction at once, in both engines."""
    material, displacement, state, values = case()
    random, few = np.random.default_rng(3), slice(0, 4)

    def drawn(high: float) -> np.ndarray:
        return random.uniform(0.1 * high, high, 4)

    effects = BodyEffects(
        bending=BendingLaw(*(drawn(0.2) for _ in range(5))),
        viscoelasticity=Viscoelasticity(drawn(0.3), drawn(0.3)),
        softening_rate=drawn(0.1),
        drag=drawn(100.0),
        wall=Wall(drawn(1e3), drawn(0.02), drawn(3.0)),
        cable_compliance=drawn(1e-3),
        coulomb_friction=drawn(0.2),
        capstan_friction=drawn(0.3),
    )
    rich = jax.tree.map(lambda value: value[few], material._replace(effects=BodyEffects()))._replace(effects=effects)
    inputs = rich, jnp.asarray(displacement[few]), jnp.asarray(state[few]), jnp.asarray(values[few])
    wanted = reference()(*inputs)
    for precision, tolerance in AGREEMENT.items():
        found = engine(precision).rollout(rich, displacement[few], cube=(state[few], values[few]))
        assert np.abs(found.position[:, 1:] - wanted.position).max() < tolerance
        assert np.abs(found.pose[:, 1:, :3] - wanted.pose[..., :3]).max() < tolerance
        assert found.converged.all()
    plain = engine().rollout(rich._replace(effects=BodyEffects()), displacement[few], cube=(state[few], values[few]))
    assert np.abs(plain.position[:, 1:] - wanted.position).max(axis=(1, 2, 3)).min() > 1e-4


def test_what_does_not_fit_is_named():
    material, displacement, state, values = case()
    with pytest.raises(InputError, match="state has shape"):
        engine().rollout(material, displacement, cube=(state[:, :7], values))
    with pytest.raises(InputError, match="a scene and a cube must be given together"):
        engine().rollout(material, displacement)
