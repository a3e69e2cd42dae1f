"""Cables: geometry, the complementarity problem, and what a cable does to a body."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.cables import guide_matrix, lengths_and_jacobian
from rfdropo_bayes.fem.constraints import CABLE_SOFTNESS, solve_constraints

solve_tensions = jax.jit(lambda compliance, slack, start: solve_constraints(compliance, slack, start, 1.0))


def enumerated(compliance: np.ndarray, slack: np.ndarray) -> np.ndarray:
    """The tensions by trying every active set."""
    count = len(slack)
    for size in range(count + 1):
        for active in map(list, itertools.combinations(range(count), size)):
            tension = np.zeros(count)
            tension[active] = np.linalg.solve(compliance[np.ix_(active, active)], -slack[active])
            if np.all(tension >= 0.0) and np.all(slack + compliance @ tension >= -1e-12):
                return tension
    raise AssertionError("a positive definite problem has a solution")


@pytest.mark.parametrize("seed", range(20))
def test_tensions_agree_with_trying_every_active_set(seed):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(6, 6))
    compliance, slack = factor @ factor.T, rng.normal(size=6)
    start = rng.uniform(-1.0, 1.0, 6)
    found = solve_tensions(jnp.asarray(compliance), jnp.asarray(slack), jnp.asarray(start))
    assert found.converged
    soft = compliance + CABLE_SOFTNESS * np.diag(np.diagonal(compliance))
    np.testing.assert_allclose(found.cable, enumerated(soft, slack), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_many_nearly_dependent_cables_never_fail(seed):
    """Eight cables that act through four routes: the compliance has rank four, and scale 1e-6."""
    rng = np.random.default_rng(seed)
    routes = rng.normal(size=(4, 4))
    factor = 1e-3 * np.concatenate([routes, routes * rng.uniform(0.4, 1.0, (4, 1))])
    compliance, slack = factor @ factor.T, 1e-3 * rng.normal(size=8)
    slack[4:] = slack[:4] * np.linalg.norm(factor[4:], axis=1) / np.linalg.norm(factor[:4], axis=1)
    found = solve_tensions(jnp.asarray(compliance), jnp.asarray(slack), jnp.asarray(rng.uniform(-1.0, 1.0, 8)))
    assert found.converged
    tension = np.asarray(found.cable)
    left = slack + compliance @ tension
    assert np.all(tension >= 0.0)
    # What a cable is too long by is its softness times its tension.
    longest = CABLE_SOFTNESS * np.diagonal(compliance) * tension
    assert np.all(left > -longest - 1e-12)
    assert np.all(np.abs(left + longest)[tension > 1e-9 * tension.max()] < 1e-12)


def test_jacobian_is_the_derivative_of_the_lengths(trunk):
    position = fem.rest_positions(trunk.body)
    position = jnp.asarray(position + 1e-3 * np.random.default_rng(0).normal(size=position.shape))
    guides = jnp.asarray(guide_matrix(trunk.cables, trunk.body.nodes))
    length, jacobian = lengths_and_jacobian(trunk.cables, guides, position)
    expected = jax.jacobian(lambda x: lengths_and_jacobian(trunk.cables, guides, x)[0])(position)
    assert np.all(np.asarray(length) > 0.0)
    np.testing.assert_allclose(jacobian, expected, atol=1e-14)


def test_pulled_cable_shortens_by_its_displacement_and_the_others_stay_slack(trunk, prepare, settle):
    material = fem.material(trunk, young_modulus=1e6, poisson_ratio=0.4, density=1000.0)
    prepared = prepare(trunk, material)
    pull = 1e-5
    state, info = settle(trunk, material, [pull, 0.0, -1e-4])
    assert info.converged
    length, _ = lengths_and_jacobian(trunk.cables, prepared.guides, state.position)
    assert prepared.rest_length[0] - length[0] == pytest.approx(pull, rel=1e-6)
    assert state.tension[0] > 0.0
    # The second has grown by nothing yet is commanded to keep its length: it is taut or slack, never in compression.
    assert state.tension[1] >= 0.0
    assert state.tension[2] == 0.0
    left = prepared.rest_length - jnp.array([pull, 0.0, -1e-4]) - length
    assert np.all(np.asarray(left) > -1e-10)
    assert np.abs(np.asarray(left * state.tension)).max() < 1e-10


def test_tension_bends_towards_the_cable_and_falls_to_zero_on_release(trunk, trace):
    material = fem.material(
        trunk, young_modulus=1e6, poisson_ratio=0.4, density=1000.0, rayleigh_mass=5.0, rayleigh_stiffness=0.02
    )
    pull = 2e-3 * np.minimum(np.arange(1, 101) / 20.0, 1.0) * (np.arange(100) < 60)
    commands = np.stack([pull, np.full(100, -0.02), np.full(100, -0.02)], axis=1)
    states, info, _, _ = trace(material, fem.state_at_rest(trunk), commands, 0.01)
    assert not np.any(info.diverged)
    assert np.all(info.converged)
    assert np.all(np.asarray(states.tension) >= 0.0)
    tip = np.asarray(states.position)[:, -4:].mean(axis=1)
    assert np.all(np.asarray(states.tension)[:60, 0] > 0.0)
    assert tip[59, 0] > 5e-3
    assert np.all(np.asarray(states.tension)[60:63, 0] == 0.0)
    assert abs(tip[-1, 0]) < 0.5 * tip[59, 0]
    # While taut, the cable has the commanded length: the linearised step misses it by the square of a step's motion.
    guides = jnp.asarray(guide_matrix(trunk.cables, trunk.body.nodes))
    rest = lengths_and_jacobian(trunk.cables, guides, fem.state_at_rest(trunk).position)[0]
    held = lengths_and_jacobian(trunk.cables, guides, states.position[59])[0]
    assert rest[0] - held[0] == pytest.approx(2e-3, rel=1e-3)


@pytest.mark.parametrize(
    ("guides", "message"),
    [
        ([np.zeros((0, 3))], "no guide"),
        ([np.array([[0.0, 0.0, 0.05], [0.0, 0.0, 0.05]])], "coincide"),
        ([np.array([[0.0, 0.0, 0.05]])] * 2, "anchors"),
    ],
)
def test_impossible_cables_are_refused(trunk, guides, message):
    with pytest.raises(InputError, match=message):
        fem.cable_layout(trunk.body, np.array([[0.01, 0.0, 0.0]]), guides)
