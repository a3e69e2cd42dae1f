"""Motion: conservation laws, modes, order of the time integration, invariances, failures."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from rfdropo_bayes import fem
from rfdropo_bayes.fem import corotational
from rfdropo_bayes.fem.dynamics import frames_and_displacements, mass_times

SILICONE = {"young_modulus": 0.3e6, "poisson_ratio": 0.45, "density": 1050.0}
DAMPING = {"rayleigh_mass": 2.0, "rayleigh_stiffness": 0.01}


def wandering_pulls(seed: int = 0) -> np.ndarray:
    """Smooth commands for three cables over a hundred steps, up to a centimetre, some below zero."""
    rng = np.random.default_rng(seed)
    time = np.arange(1, 101)[:, None] / 100.0
    return 5e-3 * time * (1.0 + np.sin(2.0 * np.pi * (rng.uniform(1.0, 3.0, 3) * time + rng.uniform(size=3))))


def dense_matrices(system: fem.System, prepared: fem.Prepared) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness of the undeformed body and mass, clamped nodes left out."""
    frame, _ = frames_and_displacements(system, prepared, fem.state_at_rest(system).position)
    stations, size = len(system.body.station), 3 * system.body.section_nodes
    matrices = []
    for blocks in (corotational.tangent(prepared.packed, frame), prepared.mass):
        full = np.zeros((stations * size,) * 2)
        for station in range(stations):
            here = slice(station * size, (station + 1) * size)
            below = slice((station - 1) * size, station * size)
            repeat = np.eye(size // blocks.diagonal.shape[1])
            full[here, here] = np.kron(blocks.diagonal[station], repeat)
            if station:
                lower = np.kron(blocks.lower[station - 1], repeat)
                full[here, below], full[below, here] = lower, lower.T
        matrices.append(full[size * system.clamped_stations :, size * system.clamped_stations :])
    return matrices[0], matrices[1]


def test_free_body_falls_as_a_stone(trunk, trace):
    """Unclamped and stress-free, implicit Euler gives v = g t and x = g h^2 n (n + 1) / 2."""
    gravity = np.array([1.0, -9.81, 2.0])
    material = fem.material(trunk, **SILICONE, gravity=gravity)
    start = fem.state_at_rest(trunk)
    states, info, _, _ = trace(material, start, np.full((100, 3), -1.0), 0.001, clamped=0)
    steps = np.arange(1, 101)[:, None, None]
    assert not np.any(info.diverged)
    np.testing.assert_allclose(states.velocity, np.broadcast_to(gravity * 0.001 * steps, (100, 28, 3)), rtol=1e-8)
    fallen = gravity * 1e-6 * steps * (steps + 1) / 2.0
    np.testing.assert_allclose(states.position - start.position, np.broadcast_to(fallen, (100, 28, 3)), rtol=1e-8)


def test_linear_momentum_is_conserved_without_supports(trunk, trace, prepare):
    """A tumbling, vibrating free body with stiffness damping; no mass damping, no weight."""
    material = fem.material(trunk, **SILICONE, rayleigh_stiffness=0.001)
    start = fem.state_at_rest(trunk)
    velocity = jnp.asarray(0.5 * np.random.default_rng(0).normal(size=(28, 3)) + [0.1, 0.2, 0.0])
    velocity += jnp.cross(jnp.array([3.0, -2.0, 5.0]), start.position)
    start = start._replace(velocity=velocity)
    states, info, energies, momentum = trace(material, start, np.full((100, 3), -10.0), 0.002, clamped=0)
    assert not np.any(info.diverged)
    expected = mass_times(trunk, prepare(trunk, material), start.velocity).sum(axis=0)
    np.testing.assert_allclose(momentum, np.broadcast_to(expected, (100, 3)), atol=1e-12)
    assert energies.kinetic[-1] > 0.1 * energies.kinetic[0]
    assert np.abs(np.asarray(states.position[-1] - start.position)).max() > 0.01


@pytest.mark.slow
def test_energy_never_grows_without_work(trunk, trace, prepare, settle):
    """Released from a strong pull. One linearised solve a step leaves up to a thousandth of the energy."""
    material = fem.material(trunk, **SILICONE, gravity=(0.0, -9.81, 0.0))
    prepared = prepare(trunk, material)
    start, info = settle(trunk, material, [0.012, 0.0, 0.0])
    assert info.converged
    first = float(sum(fem.energies(trunk, prepared, start)))
    _, _, energies, _ = trace(material, start, np.full((100, 3), -1.0), 0.005)
    total = np.concatenate([[first], sum(energies)])
    lost = total[0] - total[-1]
    assert lost > 0.0
    assert np.diff(total).max() < 1e-3 * lost


def test_scale_ridge_leaves_the_motion_alone(trunk, trace):
    """Young's modulus, density and point masses times 1.7: the same motion, tensions times 1.7."""
    point_mass = jnp.zeros(7).at[6].set(0.01).at[3].set(0.004)
    material = fem.material(trunk, **SILICONE, **DAMPING, gravity=(0.0, -9.81, 0.0))._replace(point_mass=point_mass)
    heavier = material._replace(
        young_modulus=1.7 * material.young_modulus, density=1.7 * material.density, point_mass=1.7 * point_mass
    )
    one, _, _, _ = trace(material, fem.state_at_rest(trunk), wandering_pulls(), 0.01)
    other, _, _, _ = trace(heavier, fem.state_at_rest(trunk), wandering_pulls(), 0.01)
    assert np.asarray(one.tension).max() > 0.1
    assert np.abs(np.asarray(one.position - other.position)).max() < 1e-9
    np.testing.assert_allclose(other.tension, 1.7 * one.tension, rtol=1e-6, atol=1e-6)


def test_stiffness_scale_and_young_modulus_are_the_same_thing(trunk, trace):
    material = fem.material(trunk, **SILICONE, gravity=(0.0, -9.81, 0.0))
    scaled = material._replace(young_modulus=material.young_modulus / 3.0, stiffness_scale=jnp.full(6, 3.0))
    one, _, _, _ = trace(material, fem.state_at_rest(trunk), np.zeros((100, 3)), 0.01)
    other, _, _, _ = trace(scaled, fem.state_at_rest(trunk), np.zeros((100, 3)), 0.01)
    np.testing.assert_allclose(one.position, other.position, atol=1e-12)


@settings(max_examples=8, deadline=None)
@given(quarter=st.integers(1, 3), angle=st.floats(0.0, 6.28), pull=st.floats(1.0, 20.0))
def test_turning_gravity_turns_the_motion_of_a_square_body(trunk, trace, quarter, angle, pull):
    """By multiples of 90 degrees about the axis; the slack cables do not matter."""
    turn = np.linalg.matrix_power(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), quarter)
    gravity = pull * np.array([np.cos(angle), np.sin(angle), -0.5])
    start, slack = fem.state_at_rest(trunk), np.full((100, 3), -1.0)
    one = trace(fem.material(trunk, **SILICONE, gravity=gravity), start, slack, 0.01)[0]
    other = trace(fem.material(trunk, **SILICONE, gravity=turn @ gravity), start, slack, 0.01)[0]
    tip = [np.asarray(states.position)[:, -4:].mean(axis=1) for states in (one, other)]
    assert np.abs(tip[0][:, :2]).max() > 1e-3
    np.testing.assert_allclose(tip[1], tip[0] @ turn.T, atol=1e-9)


def test_first_three_modes_of_a_slender_beam(prepare):
    """Generalised eigenproblem of the assembled matrices against Euler and Bernoulli, L / h = 50."""
    half, beta = 0.01, np.array([1.875104, 4.694091, 7.854757])
    system = fem.System(fem.uniform_body(1.0, half, half, 40, 2), fem.without_cables())
    material = fem.material(system, young_modulus=1e6, poisson_ratio=0.0, density=1000.0)
    stiffness, mass = dense_matrices(system, prepare(system, material))
    found = np.sqrt(scipy.linalg.eigh(stiffness, mass, eigvals_only=True, subset_by_index=[0, 5]))
    expected = beta**2 * np.sqrt(1e6 * half**2 / 3.0 / 1000.0)
    np.testing.assert_allclose(found, np.repeat(expected, 2), rtol=0.02)


def test_small_vibration_is_the_exact_one_of_implicit_euler(trunk, trace, prepare):
    """One mode with Rayleigh damping: every step solves (1 + h a + h (h + b) w^2) v' = v - h w^2 x, x' = x + h v'."""
    material = fem.material(trunk, **SILICONE, rayleigh_mass=0.3, rayleigh_stiffness=0.002)
    stiffness, mass = dense_matrices(trunk, prepare(trunk, material))
    squares, modes = scipy.linalg.eigh(stiffness, mass)
    start, h = fem.state_at_rest(trunk), 0.005
    for mode in (0, 2):
        shape = np.concatenate([np.zeros(12), modes[:, mode]]).reshape(-1, 3)
        amplitude = 1e-7 / np.abs(shape).max()
        moved = start._replace(position=start.position + amplitude * shape)
        states, _, _, _ = trace(material, moved, np.full((100, 3), -1.0), h)
        x, v, expected = amplitude, 0.0, []
        for _ in range(100):
            v = (v - h * squares[mode] * x) / (1.0 + h * 0.3 + h * (h + 0.002) * squares[mode])
            x += h * v
            expected.append(x)
        motion = np.asarray(states.position - start.position).reshape(100, -1)[:, 12:] @ (mass @ modes[:, mode])
        np.testing.assert_allclose(motion, expected, atol=2e-4 * amplitude)


def test_time_integration_converges_with_the_first_order(trunk, trace):
    """Fall from straight over a quarter period with little damping: 25, 50 and 100 steps."""
    material = fem.material(trunk, **SILICONE, rayleigh_stiffness=0.001, gravity=(0.0, -9.81, 0.0))
    duration, tips = 0.02, []
    for steps in (25, 50, 100):
        states = trace(material, fem.state_at_rest(trunk), np.full((100, 3), -1.0), duration / steps)[0]
        tips.append(np.asarray(states.position)[steps - 1, -4:, 1].mean())
    assert abs(tips[2]) > 5e-4
    assert np.log2((tips[0] - tips[1]) / (tips[1] - tips[2])) == pytest.approx(1.0, abs=0.15)


def test_a_force_held_in_the_steps_leads_to_its_equilibrium(trunk, trace, settle):
    material = fem.material(trunk, **SILICONE, rayleigh_mass=20.0, gravity=(0.0, -9.81, 0.0))
    end = fem.attach(trunk.body, np.array([[0.0, 0.0, 0.12]]))
    force = fem.spread_forces(end, jnp.array([[0.02, 0.0, 0.01]]), trunk.body.nodes)
    slack = np.full((100, 3), -1.0)
    rest, info = settle(trunk, material, slack[0], force)
    assert info.converged
    states = trace(material, fem.state_at_rest(trunk), slack, 0.2, force=force)[0]
    assert np.abs(np.asarray(rest.position - fem.state_at_rest(trunk).position)).max() > 5e-3
    np.testing.assert_allclose(states.position[-1], rest.position, atol=1e-8)


@pytest.fixture(scope="module")
def markers(trunk):
    """Points along the axis."""
    return fem.attach(trunk.body, np.array([[0.0, 0.0, z] for z in (0.04, 0.08, 0.12)]))


@pytest.fixture(scope="module")
def prefix(trunk, markers):
    """Function (density, pulls (10, 2, 3), horizon) -> batch of rollouts of the first rows."""

    def run(density, pulls, horizon):
        material = fem.material(trunk, **{**SILICONE, "density": density}, **DAMPING, gravity=(0.0, -9.81, 0.0))
        prepared = fem.prepare(trunk, material)
        start = fem.state_at_rest(trunk)
        return fem.simulate(trunk, prepared, start, pulls, 0.01, markers, horizon=horizon)

    return jax.jit(jax.vmap(run, (0, None, None)))


def test_a_prefix_is_the_beginning_of_the_whole(trunk, trace, markers, prefix):
    pulls = jnp.asarray(wandering_pulls()[:20].reshape(10, 2, 3))
    density = jnp.array([1050.0, 900.0, 1200.0])
    whole, part = prefix(density, pulls, 10), prefix(density, pulls, 4)
    np.testing.assert_array_equal(part.position[:, :4], whole.position[:, :4])
    np.testing.assert_array_equal(part.tension[:, :4], whole.tension[:, :4])
    assert np.all(np.asarray(part.position[:, 4:]) == 0.0)
    material = fem.material(trunk, **SILICONE, **DAMPING, gravity=(0.0, -9.81, 0.0))
    states = trace(material, fem.state_at_rest(trunk), wandering_pulls(), 0.01)[0]
    every_second = jax.vmap(lambda x: fem.point_positions(markers, x))(states.position[1:20:2])
    np.testing.assert_allclose(whole.position[0], every_second, atol=1e-10)


def test_a_diverged_rollout_is_reported_and_spoils_no_other(prefix):
    """A density of NaN, and a negative one, beside a good one."""
    pulls = jnp.asarray(wandering_pulls()[:20].reshape(10, 2, 3))
    batch = prefix(jnp.array([1050.0, np.nan, -1050.0]), pulls, 10)
    alone = prefix(jnp.array([1050.0, 1050.0, 1050.0]), pulls, 10)
    assert np.asarray(batch.diverged).tolist()[:2] == [False, True]
    assert not np.any(alone.diverged)
    np.testing.assert_allclose(batch.position[0], alone.position[0], atol=1e-12)
    assert np.all(np.isfinite(batch.position))
    assert np.all(np.isfinite(batch.tension))


def sensitivity_of(trunk, markers):
    """Tip path and tensions as a function of six parameters in units of their nominal values."""
    pulls = jnp.asarray(wandering_pulls()[:20].reshape(5, 4, 3))

    def run(factors):
        material = fem.material(
            trunk,
            young_modulus=0.3e6 * factors[0],
            poisson_ratio=0.45 * factors[1],
            density=1050.0 * factors[2],
            rayleigh_mass=2.0 * factors[3],
            rayleigh_stiffness=0.01 * factors[4],
            gravity=(0.0, -9.81, 0.0),
        )
        prepared = fem.prepare(trunk, material)
        state, _ = fem.static_equilibrium(trunk, prepared, pulls[0, 0] * factors[5])
        rollout = fem.simulate(trunk, prepared, state, pulls * factors[5], 0.01, markers)
        return jnp.concatenate([rollout.position.ravel(), 0.1 * rollout.tension.ravel()])

    return run


@pytest.fixture(scope="module")
def directional(trunk, markers):
    """Function (factors, direction) -> value and directional derivative."""
    run = sensitivity_of(trunk, markers)
    return jax.jit(lambda factors, direction: jax.jvp(run, (factors,), (direction,)))


@pytest.fixture(scope="module")
def differences(directional):
    """Central differences of the six sensitivities."""
    step, columns = 1e-5, []
    for axis in np.eye(6):
        ahead, behind = (directional(1.0 + sign * step * axis, axis)[0] for sign in (1.0, -1.0))
        columns.append(np.asarray(ahead - behind) / (2.0 * step))
    return np.stack(columns, axis=1)


def test_forward_derivatives_agree_with_differences(directional, differences):
    found = np.stack([np.asarray(directional(np.ones(6), axis)[1]) for axis in np.eye(6)], axis=1)
    scale = np.abs(differences).max(axis=0)
    assert np.all(scale > 1e-6)
    assert np.all(np.abs(found - differences).max(axis=0) < 2e-5 * scale)


@pytest.mark.slow
def test_reverse_derivatives_agree_with_differences(trunk, markers, differences):
    run = sensitivity_of(trunk, markers)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=differences.shape[0]))
    found = jax.jit(jax.grad(lambda factors: weight @ run(factors)))(jnp.ones(6))
    expected = np.asarray(weight) @ differences
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=2e-5 * np.abs(expected).max())
