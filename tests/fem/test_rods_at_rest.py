"""Rods at rest: closed forms and published shapes of beams, large rotations, friction's path, derivatives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.fem.effects import BodyEffects, Wall
from rfdropo_bayes.fem.native.rod_engine import NativeRod

ELEMENTS, HALF, YOUNG, DENSITY = 16, 0.01, 1e6, 1000.0
STIFFNESS, AREA = YOUNG * 4.0 * HALF**4 / 3.0, 4.0 * HALF**2
SYSTEM = fem.System(fem.uniform_rod(1.0, HALF, HALF, ELEMENTS), fem.without_cables())
# Bisshopp and Drucker (1945): P L^2 / E I -> deflection / L, shortening / L.
END_LOAD = {1.0: (0.30172, 0.05643), 2.0: (0.49346, 0.16064), 5.0: (0.71379, 0.38763), 10.0: (0.81061, 0.55500)}
# Heavy elastica: w L^3 / E I -> x / L, y / L.
OWN_WEIGHT = {1.0: (0.99125, 0.12347), 2.0: (0.96689, 0.23851), 5.0: (0.84666, 0.49591), 10.0: (0.65635, 0.70020)}
# Princeton beam, by load [N]: tip along the section's height and thickness [m], for loads from 0 to 90 degrees between
# both, every 15. Beam elements of ANSYS in Obrezkov et al. (2022), Nonlinear Dynamics 109, on ANCF beam elements.
PRINCETON = {
    8.896: (
        (0.0107142, 0.0106133, 0.0101117, 0.0088372, 0.0066047, 0.0035389, 0.0),
        (0.0, 0.0420823, 0.0793948, 0.1089879, 0.1298876, 0.1421944, 0.1462460),
    ),
    13.345: (
        (0.0160642, 0.0164583, 0.0166587, 0.0151862, 0.0115784, 0.0062490, 0.0),
        (0.0, 0.0643581, 0.1177360, 0.1564672, 0.1818616, 0.1960971, 0.2006777),
    ),
}
# Column above its buckling load (Timoshenko and Gere, Theory of Elastic Stability, table 2-4): P / Pcr -> x / L, y / L.
COLUMN = {1.152: (0.741, 0.593), 1.293: (0.560, 0.719)}


def loads() -> tuple[np.ndarray, np.ndarray]:
    """Wrenches at the tip and gravity of all cases: end loads, own weights, columns, small force, torque, rolled up."""
    tip, gravity = np.zeros((13, 6)), np.zeros((13, 3))
    for row, load in enumerate(END_LOAD):
        tip[row, 0] = load * STIFFNESS
    for row, load in enumerate(OWN_WEIGHT):
        gravity[4 + row, 0] = load * STIFFNESS / (DENSITY * AREA)
    for row, load in enumerate(COLUMN):
        tip[8 + row, [0, 2]] = 1e-4 * STIFFNESS, -load * STIFFNESS * np.pi**2 / 4.0
    tip[10, [0, 5]] = 1e-4 * STIFFNESS, 1e-3
    tip[11:, 4] = np.pi * STIFFNESS, 2.0 * np.pi * STIFFNESS
    return tip, gravity


@pytest.fixture(scope="module")
def settled():
    """States and infos of all cases."""

    @jax.jit
    @jax.vmap
    def run(tip, gravity):
        material = fem.material(SYSTEM, young_modulus=YOUNG, poisson_ratio=0.0, density=DENSITY, gravity=gravity)
        force = jnp.zeros((ELEMENTS + 1, 6)).at[-1].set(tip)
        return fem.static_equilibrium(SYSTEM, fem.prepare(SYSTEM, material), jnp.zeros(0), force, 200)

    return run(*loads())


@pytest.mark.slow
def test_large_deflections_are_the_published_ones(settled):
    state, info = settled
    assert np.all(info.converged)
    tip = np.asarray(state.position)[:, -1]
    for row, (deflection, shortening) in enumerate(END_LOAD.values()):
        np.testing.assert_allclose(tip[row], [deflection, 0.0, 1.0 - shortening], atol=2e-3)
    for row, (height, deflection) in enumerate(OWN_WEIGHT.values()):
        np.testing.assert_allclose(tip[4 + row], [deflection, 0.0, height], atol=2e-3)


def test_a_column_buckles_as_eulers(settled):
    tip = np.asarray(settled[0].position)[:, -1]
    for row, (height, deflection) in enumerate(COLUMN.values()):
        np.testing.assert_allclose(tip[8 + row, [0, 2]], [deflection, height], atol=0.01)


def test_small_loads_follow_timoshenko_and_saint_venant(settled):
    state = settled[0]
    shear = 0.5 * YOUNG
    torsion = fem.solid_torsion_constant(HALF, HALF) * shear
    expected = 1e-4 * STIFFNESS * (1.0 / (3.0 * STIFFNESS) + 1.0 / (5.0 / 6.0 * shear * AREA))
    assert state.position[10, -1, 0] == pytest.approx(expected, rel=1e-3)  # (T L / E I)^2 = 0.006, of the torque
    twist = 2.0 * np.arctan2(state.orientation[10, -1, 3], state.orientation[10, -1, 0])
    assert twist == pytest.approx(1e-3 / torsion, rel=1e-3)


def rolled_up(elements: int, turns: float) -> np.ndarray:
    """Tip of a rod of length 1 under the moment of so many turns. Every element turns by p, sin p = M h / E I, and its
    chord is as much shorter than h as a chord is than its arc."""
    length = 1.0 / elements
    turn = np.arcsin(2.0 * np.pi * turns * length)
    chord = length * (1.0 - np.sin(turn / 2.0) ** 2 / 6.0)
    middle = (np.arange(elements) + 0.5) * turn
    return chord * np.array([np.sin(middle).sum(), 0.0, np.cos(middle).sum()])


def test_a_moment_rolls_a_rod_up(settled):
    """Under the moments of a half and of a whole turn, the tip is that of an arc; by a whole turn it meets the base as
    the elements grow short, by their square."""
    assert np.all(settled[1].converged[11:])
    assert np.all(settled[1].iterations[11:] <= 40)
    for row, turns in ((11, 0.5), (12, 1.0)):
        np.testing.assert_allclose(settled[0].position[row, -1], rolled_up(ELEMENTS, turns), atol=1e-5)
    away = [np.linalg.norm(rolled_up(elements, 1.0)) for elements in (64, 128)]
    assert np.log2(away[0] / away[1]) == pytest.approx(2.0, abs=0.05)


def test_a_beam_bends_and_twists_as_the_princeton_beam():
    """A load at the tip, askew to the axes of the section, bends the beam about both and twists it; 1 % of the way."""
    system = fem.System(fem.uniform_rod(0.508, 0.5 * 12.3777e-3, 0.5 * 3.2024e-3, 20), fem.without_cables())
    material = fem.material(system, young_modulus=71.7e9, poisson_ratio=0.31, density=1e-3)
    mass = material.point_mass.at[-1].set(1.0)
    angle = np.deg2rad(np.arange(0.0, 91.0, 15.0))
    way = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    gravity = np.concatenate([load * way for load in PRINCETON])
    rows = jax.tree.map(lambda part: np.repeat(np.asarray(part)[None], len(gravity), 0), material)
    rows = rows._replace(gravity=gravity, point_mass=np.tile(mass, (len(gravity), 1)))
    engine = NativeRod(system, fem.attach(system.body, np.array([[0.0, 0.0, 0.508]])), 0.01, integrator="quasi-static")
    found = engine.rollout(rows, np.zeros((len(gravity), 1, 0)))
    expected = np.concatenate([np.transpose(tip) for tip in PRINCETON.values()])
    assert np.all(found.converged)
    away = np.linalg.norm(found.position[:, -1, 0, :2] - expected, axis=1)
    assert np.all(away < 0.01 * np.linalg.norm(expected, axis=1))


def one_cable(elements: int) -> fem.System:
    """A bar of 200 mm with a cable beside its axis, guided at both of its halves and the tip."""
    body = fem.uniform_rod(0.2, 0.01, 0.01, elements)
    guides = np.array([[0.008, 0.0, 0.05], [0.008, 0.0, 0.1], [0.008, 0.0, 0.15], [0.008, 0.0, 0.2]])
    return fem.System(body, fem.cable_layout(body, np.array([[0.008, 0.0, -0.005]]), [guides]))


SMALL = one_cable(4)
PULLS = np.array([0.002, 0.004, 0.003, 0.0, -0.002])


def quasi_static(friction, young):
    """Tip and tension in rows of pulls that go there and back."""
    effects = BodyEffects(capstan_friction=friction, wall=Wall(1e3, 0.03, 0.0), cable_compliance=1e-5)
    material = fem.material(SMALL, young_modulus=young, poisson_ratio=0.3, density=DENSITY, gravity=(0.0, 4.0, 0.0))
    prepared = fem.prepare(SMALL, material._replace(effects=effects))
    points = fem.attach(SMALL.body, np.array([[0.0, 0.0, 0.2]]))
    start = fem.state_at_rest(SMALL)
    rows = fem.simulate(
        SMALL, prepared, start, jnp.asarray(PULLS)[:, None, None], 1.0, points, integrator="quasi-static"
    )
    return rows.position[:, 0], rows.tension[:, 0], rows.converged


@pytest.fixture(scope="module")
def rows_at_rest():
    """`quasi_static`, its derivatives by both parameters forward, and of one number in reverse."""

    @jax.jit
    def run(friction, young):
        found = quasi_static(friction, young)
        moved = [jax.jvp(quasi_static, (friction, young), change)[1] for change in ((1.0, 0.0), (0.0, 1.0))]
        back = jax.grad(lambda f, y: jnp.sum(quasi_static(f, y)[0][2]), (0, 1))(friction, young)
        return found, moved, back

    return run


@pytest.mark.slow
def test_quasi_static_rows_keep_the_path_of_friction_and_have_derivatives(rows_at_rest):
    (_, tension, converged), moved, back = rows_at_rest(0.2, 4e5)
    assert converged
    there, again = np.asarray(tension)[[1, 2]]
    assert there > again > 0.0
    assert tension[-1] == 0.0
    steps = (1e-4, 0.0), (0.0, 4.0)
    for change, found, reverse in zip(steps, moved, back, strict=True):
        ahead, behind = (rows_at_rest(0.2 + k * change[0], 4e5 + k * change[1])[0] for k in (1, -1))
        size = 2.0 * max(change)
        for part in range(2):
            difference = (np.asarray(ahead[part]) - behind[part]) / size
            np.testing.assert_allclose(found[part], difference, rtol=2e-3, atol=2e-4 * np.abs(difference).max())
        assert reverse == pytest.approx(float(jnp.sum(found[0][2])), rel=1e-8)


@pytest.mark.slow
def test_order_of_convergence_of_a_pulled_body_in_elements():
    tips = []
    for elements in (8, 16, 32, 64):
        system = one_cable(elements)
        material = fem.material(system, young_modulus=1e6, poisson_ratio=0.0, density=DENSITY)
        state, info = jax.jit(
            lambda pull, system=system, material=material: fem.static_equilibrium(
                system, fem.prepare(system, material), pull
            )
        )(jnp.array([0.006]))
        assert info.converged
        tips.append(float(state.position[-1, 0]))
    order = np.log2(np.abs(np.diff(tips)[:-1] / np.diff(tips)[1:]))
    assert np.all((order > 1.8) & (order < 2.2))
