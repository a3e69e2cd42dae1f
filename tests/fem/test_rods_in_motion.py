"""Rods in motion: modes, momentum, energy, order of the integrators, batches and derivatives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from rfdropo_bayes import fem
from rfdropo_bayes.fem.cables import threads
from rfdropo_bayes.fem.dynamics import displaced, momentum, stage_body, twist_of
from rfdropo_bayes.fem.stage_solve import Way, inertia_times, linearised, matrix_times
from tests.fem.energies import energies

YOUNG, DENSITY, HALF = 4e5, 1000.0, 0.01
CABLES = 3
PULLS, SLACK = (0.004, -0.002, 0.0012), (-1.0, -1.0, -1.0)
"""Largest pulls of the cables [m], two of them taut; and of cables that all hang loose."""


def trunk(clamped: int = 1) -> fem.System:
    """Four tapering elements with three cables of different reach."""
    half = np.repeat(np.linspace(0.012, 0.008, 5)[:, None], 2, axis=1)
    middle = 0.5 * (half[1:] + half[:-1])
    area, moment = 4.0 * middle[:, 0] ** 2, 4.0 / 3.0 * middle**4
    body = fem.profile_rod(
        station=np.linspace(0.0, 0.12, 5),
        half_width=half,
        axial_area=area,
        bending_moment_area=moment,
        torsion_constant=0.140577 * 16.0 * middle[:, 0] ** 4,
        mass_area=area,
        mass_moment_area=moment,
    )
    angle = 2.0 * np.pi * np.arange(CABLES) / CABLES
    side = 0.008 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    guides = [side[i] + np.array([0.02, 0.05, 0.09, 0.12])[:many, None] * up for i, many in enumerate((4, 4, 3))]
    return fem.System(body, fem.cable_layout(body, side - 0.01 * up, guides), clamped)


def stiff_and_heavy(system: fem.System, material: fem.Material) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and mass of a straight rod over its free stations, from a stage's own equations."""
    prepared = fem.prepare(system, material)
    body = stage_body(system, prepared, fem.state_at_rest(system), 1.0)
    way, slack = Way(system.clamped_stations, True, system.cables), jnp.zeros(len(system.cables.anchor))
    line, shape = linearised(way, body, threads(system.cables), slack), body.twist.shape
    each = jnp.eye(shape[0] * shape[1]).reshape(-1, *shape)
    mass = jax.vmap(lambda d: inertia_times(body, line.frame, d).ravel())(each)
    whole = jax.vmap(lambda d: matrix_times(body, line, d).ravel())(each)
    free = np.tile(np.arange(shape[1]) >= system.clamped_stations, shape[0])
    return np.asarray(whole - mass)[np.ix_(free, free)], np.asarray(mass)[np.ix_(free, free)]


@pytest.mark.slow
def test_frequencies_are_those_of_beams():
    """Bending of a slender cantilever (Euler and Bernoulli), and its twist and stretch."""
    length, elements = 1.0, 25
    system = fem.System(fem.uniform_rod(length, HALF, HALF, elements), fem.without_cables())
    material = fem.material(system, young_modulus=YOUNG, poisson_ratio=0.0, density=DENSITY)
    squares = scipy.linalg.eigh(*stiff_and_heavy(system, material), eigvals_only=True)
    found = np.sqrt(squares[:12])
    bending = np.sqrt(YOUNG * HALF**2 / 3.0 / DENSITY) * np.array([1.87510, 4.69409, 7.85476]) ** 2
    np.testing.assert_allclose(found[[0, 2, 4]], bending, rtol=0.01)
    speed = np.sqrt(0.5 * 0.140577 * 16.0 * HALF**4 / (8.0 / 3.0 * HALF**4) * YOUNG / DENSITY)
    for wave in (np.pi / 2 * speed, np.pi / 2 * np.sqrt(YOUNG / DENSITY)):
        assert np.min(np.abs(np.sqrt(squares[:20]) / wave - 1.0)) < 2e-3


def march(system, integrator, young, state, time_step, steps, damping, pull):
    """State and energies after a number of steps to one second's share of each cable's pull; all but the system is
    traced."""
    material = fem.material(
        system,
        young_modulus=young,
        poisson_ratio=0.4,
        density=DENSITY,
        rayleigh_mass=damping,
        rayleigh_stiffness=0.01 * damping,
        gravity=(9.81, 0.0, 0.0),
    )
    prepared = fem.prepare(system, material)

    def one(index, carry):
        here, fine = carry
        command = pull * jnp.sin(20.0 * (index + 1.0) * time_step) ** 2
        here, info = fem.step(system, prepared, here, command, time_step, integrator=integrator)
        return here, fine & info.converged & ~info.diverged

    begin = state._replace(commanded=jnp.zeros(len(system.cables.anchor)))
    end, fine = jax.lax.fori_loop(0, steps, one, (begin, jnp.array(True)))
    return end, fine, energies(system, prepared, end), momentum(prepared, end, twist_of(end))


@pytest.fixture(scope="module")
def marched():
    """`march` of the trunk by an integrator, compiled once for each."""
    compiled = {name: jax.jit(lambda *given, name=name: march(trunk(), name, *given)) for name in ("euler", "sdirk2")}

    def run(name, time_step, steps, damping=1.0, pull=PULLS):
        return compiled[name](YOUNG, fem.state_at_rest(trunk()), time_step, steps, damping, jnp.asarray(pull))

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "pull", "least", "most"),
    [
        ("euler", SLACK, 0.8, 1.2),
        ("euler", PULLS, 0.8, 1.2),
        ("sdirk2", SLACK, 1.8, 2.2),
        # Lengths that are imposed make an index of three, at which SDIRK2 loses part of its second order.
        ("sdirk2", PULLS, 1.4, 2.2),
    ],
)
def test_order_in_time(marched, integrator, pull, least, most):
    tips = []
    for halving in range(4):
        end, fine, *_ = marched(integrator, 2e-3 / 2**halving, 30 * 2**halving, 1.0, pull)
        assert fine
        tips.append(np.asarray(end.position)[-1])
    errors = np.linalg.norm(np.diff(tips, axis=0), axis=1)
    assert least < np.log2(errors[-2] / errors[-1]) < most


@pytest.mark.slow
def test_energy_is_kept_with_tiny_steps_and_no_damping(marched):
    rest = energies(
        trunk(),
        fem.prepare(
            trunk(),
            fem.material(trunk(), young_modulus=YOUNG, poisson_ratio=0.4, density=DENSITY, gravity=(9.81, 0.0, 0.0)),
        ),
        fem.state_at_rest(trunk()),
    )
    drifts = []
    for halving in range(2):
        _, fine, energy, _ = marched("sdirk2", 2e-4 / 2**halving, 300 * 2**halving, 0.0, SLACK)
        assert fine
        drifts.append(abs(float(sum(energy) - sum(rest))) / abs(float(energy.gravitational - rest.gravitational)))
    assert drifts[0] < 1e-3
    assert drifts[1] < 0.4 * drifts[0]


@pytest.mark.slow
def test_a_free_body_keeps_its_momentum_and_spin():
    system = trunk(0)._replace(cables=fem.without_cables())
    material = fem.material(system, young_modulus=YOUNG, poisson_ratio=0.4, density=DENSITY, rayleigh_stiffness=1e-3)
    prepared = fem.prepare(system, material)
    rng = np.random.default_rng(0)
    state = displaced(fem.state_at_rest(system), jnp.asarray(0.003 * rng.normal(size=(5, 6))))
    state = state._replace(
        velocity=jnp.asarray(rng.normal(size=(5, 3))), spin=jnp.asarray(rng.normal(size=(5, 3))), commanded=jnp.zeros(0)
    )

    def whole(state):
        own = momentum(prepared, state, twist_of(state))
        return jnp.sum(own[:, :3], axis=0), jnp.sum(own[:, 3:] + jnp.cross(state.position, own[:, :3]), axis=0)

    @jax.jit
    def after(time_step, steps):
        def one(_, here):
            return fem.step(system, prepared, here, jnp.zeros(0), time_step, integrator="sdirk2")[0]

        return whole(jax.lax.fori_loop(0, steps, one, state))

    before = whole(state)
    coarse, fine = after(1e-3, 20), after(2.5e-4, 80)
    np.testing.assert_allclose(coarse[0], before[0], rtol=1e-9)
    np.testing.assert_allclose(fine[1], before[1], rtol=0.02)
    lost = [np.linalg.norm(np.asarray(found[1] - before[1])) for found in (coarse, fine)]
    assert lost[1] < 0.4 * lost[0]


@pytest.mark.slow
def test_batches_are_loops_and_derivatives_those_of_differences():
    system, points = trunk(), fem.attach(trunk().body, np.array([[0.01, 0.0, 0.1]]))
    pull = 0.004 * np.linspace(0.0, 1.0, 5)[1:, None] * np.array([1.0, -0.5, 0.3])

    def tip(young, damping):
        material = fem.material(
            system, young_modulus=young, poisson_ratio=0.4, density=DENSITY, rayleigh_mass=0.3,
            rayleigh_stiffness=damping, gravity=(9.81, 0.0, 0.0),
        )  # fmt: skip
        start = fem.state_at_rest(system)
        rows = fem.simulate(system, fem.prepare(system, material), start, jnp.asarray(pull)[:, None], 0.01, points)
        return jnp.sum(rows.position[-1]) + 0.01 * jnp.sum(rows.tension[-1])

    young, damping = jnp.array([3e5, 5e5]), jnp.array([0.01, 0.02])
    both = jax.jit(jax.vmap(jax.value_and_grad(tip, (0, 1))))
    value, slopes = both(young, damping)
    alone = jax.jit(tip)
    moved = jax.jit(lambda y, d: jax.jvp(tip, (y, d), (1.0, 0.0))[1])
    for k in range(2):
        assert value[k] == pytest.approx(float(alone(young[k], damping[k])), rel=1e-12)
        for which, size in ((0, 1.0), (1, 1e-6)):
            change = [size if which == part else 0.0 for part in range(2)]
            ahead, behind = (alone(young[k] + s * change[0], damping[k] + s * change[1]) for s in (1, -1))
            assert slopes[which][k] == pytest.approx(float(ahead - behind) / (2 * size), rel=1e-5)
        assert moved(young[k], damping[k]) == pytest.approx(float(slopes[0][k]), rel=1e-9)
