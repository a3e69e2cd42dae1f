"""SDIRK2 beside implicit Euler: order of convergence, both engines, rest, impacts, sessions, derivatives."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.fem.effects import BodyEffects
from rfdropo_bayes.fem.integrators import STAGES, Integrator
from rfdropo_bayes.fem.native.rod_engine import NativeRod
from rfdropo_bayes.fem.native.rod_session import RodSession
from rfdropo_bayes.fem.pushing import PushGeometry, push_scene, rod_spheres
from rfdropo_bayes.fem.rigid_body import Cube, cube_at
from tests.fem.energies import energies

TIME_STEP, GRAVITY, LENGTH, SIDE, PLATE, DISTANCE = 0.01, 9.81, 0.12, 0.03, -0.055, 0.005
REST = PLATE + DISTANCE + SIDE / 2


@functools.cache
def bar(elements: int = 4) -> tuple[fem.System, fem.PointMap, PushGeometry]:
    """A soft bar with three cables above a plate."""
    body = fem.uniform_rod(LENGTH, 0.01, 0.01, elements)
    angle = np.pi / 2 * np.arange(3) + 0.1
    circle = 0.008 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    guides = [place + np.array([0.0, 0.0, 1.0]) * body.station[1:, None] for place in circle]
    system = fem.System(body, fem.cable_layout(body, circle - [0.0, 0.0, 0.01], guides))
    up = np.array([0.0, 1.0, 0.0])
    scene = push_scene(rod_spheres(body), plate_normal=up, plate_height=PLATE, contact_distance=DISTANCE)
    return system, fem.attach(body, np.array([[0.0, 0.0, LENGTH]])), scene


def batched(tree):
    """Arrays with a leading axis of one."""
    return jax.tree.map(lambda value: np.asarray(value)[None], tree)


ELASTIC = BodyEffects()


def silicone(effects: BodyEffects = ELASTIC, tilt: float = 0.0, modulus: float = 0.3e6, damping: float = 0.02):
    """Material of the bar, under gravity that is tilted about z."""
    gravity = GRAVITY * np.array([np.sin(tilt), -np.cos(tilt), 0.0])
    made = fem.material(
        bar()[0], young_modulus=modulus, poisson_ratio=0.45, density=1050.0, rayleigh_mass=0.1,
        rayleigh_stiffness=damping, gravity=gravity,
    )  # fmt: skip
    return made._replace(effects=effects)


SMOOTH = {
    "elastic": ELASTIC,
    "remembering": BodyEffects(viscoelasticity=fem.Viscoelasticity(0.8, 0.05), softening_rate=1.0),
    "surrounded": BodyEffects(drag=3e3, wall=fem.Wall(1e3, 0.01, -1.5)),
    "bending": BodyEffects(bending=fem.BendingLaw(0.3, 0.2, 0.1, 0.1, 0.1)),
    "pulled": BodyEffects(cable_compliance=1e-3),
}


def errors(integrator: str, case: str, steps=(96, 192, 384)) -> np.ndarray:
    """Distance of the tip from its converged path [m], root mean square over 0.48 s, by the number of steps."""
    system, points, _ = bar()
    seconds, rows = 0.48, 24

    def path(count: int, integrator: str) -> np.ndarray:
        time = seconds / count * np.arange(1, count + 1)
        pull = 2e-3 * (1.0 - np.cos(2.0 * np.pi * time / seconds)) if case == "pulled" else np.full(count, -0.1)
        displacement = np.stack([pull, np.full(count, -0.1), np.full(count, -0.1)], axis=1)
        engine = NativeRod(system, points, seconds / count, integrator=integrator, threads=1)
        before = np.array([0.0 if case == "pulled" else -0.1, -0.1, -0.1])
        found = engine.rollout(batched(silicone(SMOOTH[case])), displacement, before=before, stride=count // rows)
        assert found.converged.all()
        return found.position[0, :, 0]

    converged = path(6144, "sdirk2")
    return np.array([np.sqrt(np.mean(np.sum((path(n, integrator) - converged) ** 2, axis=1))) for n in steps])


@pytest.mark.parametrize(
    "case", [case if case == "remembering" else pytest.param(case, marks=pytest.mark.slow) for case in SMOOTH]
)
def test_order_of_convergence(case):
    """Smooth motion: halving the step divides the error by two for Euler, by four for SDIRK2."""
    euler, sdirk2 = errors("euler", case), errors("sdirk2", case)
    np.testing.assert_allclose(np.log2(euler[:-1] / euler[1:]), 1.0, atol=0.35)
    np.testing.assert_allclose(np.log2(sdirk2[:-1] / sdirk2[1:]), 2.0, atol=0.35)
    assert sdirk2[0] < 0.2 * euler[0]


def wandering(batch: int, steps: int, cables: int, seed: int = 0) -> np.ndarray:
    """Pulls that wander at random [m]."""
    return np.cumsum(3e-4 * np.random.default_rng(seed).normal(size=(batch, steps, cables)), axis=1)


@pytest.mark.slow
def test_both_engines_give_the_same_numbers_with_all_effects():
    """Material with every effect, cables that rub, from an equilibrium under pulled cables."""
    system, points, _ = bar()
    effects = BodyEffects(
        bending=fem.BendingLaw(0.3, 0.2, 0.1, 0.1, 0.1), viscoelasticity=fem.Viscoelasticity(0.5, 0.1),
        softening_rate=0.3, drag=1e3, wall=fem.Wall(1e3, 2e-3, -1.5), cable_compliance=1e-3, coulomb_friction=0.05,
        capstan_friction=0.1,
    )  # fmt: skip
    moves = jnp.asarray(wandering(1, 25, 3)[0] + [3e-3, 0.0, 1e-3])

    @jax.jit
    def slow(material):
        prepared = fem.prepare(system, material)
        state = fem.static_equilibrium(system, prepared, moves[0])[0]._replace(commanded=moves[0])
        return fem.simulate(system, prepared, state, moves[:, None], TIME_STEP, points, integrator="sdirk2")

    given = silicone(effects)
    reference = slow(given)
    engine = NativeRod(system, points, TIME_STEP, integrator="sdirk2", threads=1)
    found = engine.rollout(batched(given), moves, start=moves[0])
    assert np.ptp(found.position[0, :, 0], axis=0).max() > 1e-3, "nothing moved"
    np.testing.assert_allclose(found.position[0, 1:], reference.position, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.tension[0, 1:], reference.tension, rtol=0.0, atol=1e-4)


def cubes(*rows: dict) -> tuple[np.ndarray, np.ndarray]:
    """State and values of cubes on the plate, or above it."""
    states, values = [], []
    for row in rows:
        place = [row.get("x", 0.3), REST + row.get("height", 0.0), 0.09]
        states.append([*place, 0.0, 0.0, 0.0, 1.0, *row.get("velocity", (0.0,) * 3), 0.0, 0.0, row.get("spin", 0.0)])
        values.append([0.05, SIDE, SIDE / np.sqrt(6.0), 0.3])
    return np.array(states), np.array(values)


@pytest.mark.slow
def test_both_engines_give_the_same_numbers_with_a_cube():
    """The bar falls and is pulled onto cubes that lie, slide and fall."""
    system, points, scene = bar()
    state, values = cubes(
        {"x": 0.0}, {"x": 0.01, "velocity": (-0.3, 0.0, 0.0)}, {"x": 0.005, "height": 0.004, "spin": 5.0}
    )
    moves = wandering(3, 40, 3) + np.linspace(0.0, 6e-3, 40)[:, None] * np.array([0.0, 0.0, 1.0])

    @jax.jit
    @jax.vmap
    def slow(displacement, state, values):
        cube = cube_at(state[:3], 0.0, scene.plate_normal)
        cube = cube._replace(orientation=state[3:7], velocity=state[7:10], spin=state[10:])
        start, around = fem.state_at_rest(system)._replace(cube=cube), {"scene": scene, "cube": Cube(*values)}
        prepared = fem.prepare(system, silicone())
        return fem.simulate(
            system, prepared, start, displacement[:, None], TIME_STEP, points, integrator="sdirk2", **around
        )

    reference = slow(moves, state, values)
    engine = NativeRod(system, points, TIME_STEP, integrator="sdirk2", threads=1, scene=scene)
    found = engine.rollout(batched(silicone()), moves, cube=(state, values))
    assert found.converged.all()
    assert np.ptp(found.pose[0, :, 2]) > 5e-5, "the bar does not reach the cube"
    np.testing.assert_allclose(found.position[:, 1:], reference.position, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.pose[:, 1:], reference.pose, rtol=0.0, atol=1e-7)


def test_a_still_bar_stays_still_for_a_minute():
    """From equilibrium under its weight and pulled cables."""
    system, points, _ = bar()
    pull = np.array([0.0, 2e-3, 1e-3])
    engine = NativeRod(system, points, TIME_STEP, integrator="sdirk2", threads=1)
    found = engine.rollout(batched(silicone()), np.tile(pull, (6000, 1)), start=pull, stride=100)
    assert np.abs(found.position - found.position[:, :1]).max() < 1e-9


@pytest.mark.slow
def test_energy_is_not_gained():
    """A bar that is let go swings, without any damping of its own: what the steps lose is little, and never gained."""
    system, _, _ = bar()
    given = silicone(damping=0.0)._replace(rayleigh_mass=jnp.zeros(()))
    free = jnp.full(3, -0.1)

    @jax.jit
    def energy():
        prepared = fem.prepare(system, given)
        start = fem.state_at_rest(system)._replace(commanded=free)

        def one(state, _):
            state = fem.step(system, prepared, state, free, TIME_STEP, integrator="sdirk2")[0]
            return state, sum(energies(system, prepared, state))

        first = sum(energies(system, prepared, start))
        return first, jax.lax.scan(one, start, None, length=150)[1]

    first, later = energy()
    scale = float(jnp.abs(later - first).max()) + GRAVITY * 1050.0 * 4.0e-4 * LENGTH * 0.02
    assert float((later - first).max()) < 0.02 * scale


def slid(
    tilt: float,
    seconds: float,
    *rows: dict,
    step: float = TIME_STEP,
    integrator: Integrator = "sdirk2",
    drag: float = 0.0,
) -> np.ndarray:
    """Poses of cubes under gravity that is tilted, beside a stiff bar; ``drag`` on all that moves [1/s]."""
    system, points, scene = bar()
    engine = NativeRod(system, points, step, integrator=integrator, threads=1, scene=scene)
    given = batched(silicone(tilt=tilt, modulus=5e6))
    given = given._replace(rayleigh_mass=np.full(1, drag))
    state, values = cubes(*rows)
    moves = np.full((len(rows), round(seconds / step), 3), -0.1)
    found = engine.rollout(given, moves, before=np.full(3, -0.1), cube=(state, values))
    assert found.converged.all()
    assert not found.diverged.any()
    return found.pose


@pytest.mark.slow
def test_cubes_fall_without_a_rebound_and_rest():
    """Dropped, and thrown: it comes up again by less than 0.2 mm, and lies within 3 um of the plate a second later."""
    pose = slid(0.0, 1.0, {"height": 0.02}, {"height": 0.005, "velocity": (0.0, -1.0, 0.0)})
    height = pose[:, :, 1] - REST
    assert height[0, 8:].max() < 2e-4
    assert height[1, 2:].max() < 2e-4
    assert np.abs(height[:, -1]).max() < 3e-6
    assert np.abs(np.diff(pose[:, -10:], axis=1)).max() < 1e-9


@pytest.mark.slow
def test_cubes_stick_and_slide_on_a_slope():
    """Below the angle of friction it stays; above it has the acceleration of the closed form."""
    critical = np.arctan(0.3)
    below, above = slid(critical - 0.01, 2.0, {}), slid(critical + 0.1, 0.6, {})
    assert np.abs(below[0, -1, :3] - below[0, 50, :3]).max() < 1e-8
    assert np.abs(below[0, -1, 0] - below[0, 0, 0]) < 1e-5
    expected = GRAVITY * (np.sin(critical + 0.1) - 0.3 * np.cos(critical + 0.1))
    np.testing.assert_allclose(np.diff(above[0, :, 0], 2)[-5:] / TIME_STEP**2, expected, rtol=1e-4)


@pytest.mark.slow
def test_a_sliding_cube_stops_where_it_should():
    """v^2 / (2 mu g) on, at any step: within 10 um, where Euler is 2.5 mm short."""
    for step in (TIME_STEP, TIME_STEP / 2):
        pose = slid(0.0, 0.4, {"velocity": (0.5, 0.0, 0.0)}, step=step)
        assert abs(pose[0, -1, 0] - 0.3 - 0.25 / (2.0 * 0.3 * GRAVITY)) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(("integrator", "order"), [("euler", 1.0), ("sdirk2", 2.0)])
def test_order_of_convergence_of_a_sliding_cube(integrator, order):
    """A cube that slides under friction and drag from 0.5 m/s: its place a quarter of a second later, from 24 to 96
    steps. It first sinks into the plate as far as contacts give way, which the step sets: single halvings are uneven,
    of SDIRK2 with orders of 2.7 and 1.5."""
    end = {
        n: slid(0.0, 0.24, {"velocity": (0.5, 0.0, 0.0)}, step=0.24 / n, integrator=integrator, drag=3.0)
        for n in (24, 48, 96, 1536)
    }
    error = [np.linalg.norm(end[n][0, -1, :3] - end[1536][0, -1, :3]) for n in (24, 48, 96)]
    assert 0.5 * np.log2(error[0] / error[2]) == pytest.approx(order, abs=0.35)


def test_a_session_is_a_rollout_taken_apart():
    """Steps in two calls are bit for bit those of one, from rest with cables that were pulled before."""
    system, points, _ = bar()
    engine = NativeRod(system, points, TIME_STEP, integrator="sdirk2", threads=1)
    given = batched(silicone(SMOOTH["remembering"]))
    moves, before = wandering(1, 12, 3) + 2e-3, np.full((1, 3), 2e-3)
    whole = engine.rollout(given, moves, before=before)
    session = RodSession(engine, 1)
    session.reset(np.array([0]), given, before=before)
    parts = [session.advance(moves[:, :5]).position[:, 1:], session.advance(moves[:, 5:]).position[:, 1:]]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole.position[:, 1:])


@pytest.mark.slow
def test_derivatives_agree_with_differences_of_the_compiled_engine():
    """Forward mode through both stages, by the logarithm of the modulus."""
    system, points, _ = bar()
    moves = jnp.asarray(wandering(1, 15, 3)[0] + 1e-3)

    def tip(logarithm):
        given = silicone()._replace(young_modulus=jnp.exp(logarithm))
        prepared = fem.prepare(system, given)
        state = fem.state_at_rest(system)
        return fem.simulate(system, prepared, state, moves[:, None], TIME_STEP, points, integrator="sdirk2").position

    at, step = np.log(0.3e6), 1e-4
    engine = NativeRod(system, points, TIME_STEP, integrator="sdirk2", threads=1)

    def compiled(logarithm):
        return engine.rollout(batched(silicone(modulus=np.exp(logarithm))), moves).position[0, 1:]

    slope = jax.jit(lambda x: jax.jvp(tip, (x,), (1.0,))[1])(at)
    expected = (compiled(at + step) - compiled(at - step)) / (2.0 * step)
    np.testing.assert_allclose(slope, expected, rtol=0.0, atol=2e-5 * np.abs(expected).max())


def test_stages_are_consistent():
    """Times add up, and what is carried on makes the weights of both stages add up to the step."""
    for stages in filter(None, STAGES.values()):
        assert sum(stage.elapsed for stage in stages) == pytest.approx(1.0)
        weight = stages[0].length * (1.0 + stages[-1].carried * (len(stages) - 1))
        assert weight + (stages[1].length if len(stages) > 1 else 0.0) == pytest.approx(1.0)
