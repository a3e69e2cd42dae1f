"""Cables: geometry, and the complementarity problem by both of its solutions."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.cables import courses, lengths, rest_lengths, routes, station_rows, threads
from rfdropo_bayes.fem.components import rotation, turned
from rfdropo_bayes.fem.constraints import CABLE_SOFTNESS
from rfdropo_bayes.fem.lanes import laned
from rfdropo_bayes.fem.stage_solve import settle_cables

from .constraint_solution import solve_constraints

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


@pytest.mark.slow
def test_a_batch_of_cables_is_solved_as_each():
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(40, 5, 4))
    compliance, slack = factor @ np.swapaxes(factor, 1, 2), rng.normal(size=(40, 5))
    start = np.maximum(rng.normal(size=(40, 5)), 0.0)
    softness = CABLE_SOFTNESS * np.einsum("bii->bi", compliance)
    found, converged = jax.jit(jax.vmap(laned(settle_cables)))(compliance, slack, softness, start)
    expected = jax.vmap(solve_tensions)(compliance, slack, start).cable
    assert np.all(np.asarray(converged) == 1.0)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8)


BODY = fem.uniform_rod(0.1, 0.01, 0.01, 4)
ANCHORS = np.array([[0.01, 0.0, -0.01], [0.0, 0.008, 0.0], [-0.008, 0.0, 0.0]])
GUIDES = {
    "at the same stations": [[[0.01, 0.0, 0.05], [0.01, 0.0, 0.1]], [[0.0, 0.008, 0.05], [0.0, 0.008, 0.1]]],
    "anywhere": [[[0.01, 0.0, 0.03], [0.009, 0.0, 0.06], [0.008, 0.0, 0.1]], [[0.0, 0.008, 0.07]]],
}


@pytest.mark.parametrize("places", list(GUIDES))
def test_rows_are_the_derivatives_of_the_lengths(places):
    guides = [np.array(points) for points in GUIDES[places]]
    layout = fem.cable_layout(BODY, ANCHORS[:2], guides)
    rng = np.random.default_rng(0)
    straight = np.stack([np.zeros(5), np.zeros(5), BODY.station])
    position = jnp.asarray(straight + 2e-3 * rng.normal(size=(3, 5)))
    quaternion = turned(jnp.eye(4)[:, :1] + jnp.zeros((4, 5)), jnp.asarray(0.2 * rng.normal(size=(3, 5))))
    thread = threads(layout)

    def length(change):
        frame = rotation(turned(quaternion, change[3:]))
        return lengths(courses(layout, thread, position + change[:3], frame))

    @jax.jit
    def course_and_rows(place, turn):
        course = courses(layout, thread, place, rotation(turn))
        return course, station_rows(layout, thread, course.lever, course.pull, 5)

    course, rows = course_and_rows(position, quaternion)
    expected = jax.jit(jax.jacobian(length))(jnp.zeros((6, 5)))
    np.testing.assert_allclose(jnp.moveaxis(rows, 2, 0), jnp.swapaxes(expected, 1, 2), atol=1e-13)
    on_lanes = jax.jit(jax.vmap(laned(lambda p, q, t: courses(layout, t, p, rotation(q))), (0, 0, None)))
    many = on_lanes(position[None], quaternion[None], thread)
    np.testing.assert_allclose(many.length[0], course.length, rtol=1e-14)
    listing = jax.jit(laned(lambda lever, pull, t: station_rows(layout, t, lever, pull, 5)))
    listed = listing(course.lever, course.pull, thread)
    np.testing.assert_allclose(listed, rows, atol=1e-15)
    for route, points, anchor, rest in zip(
        routes(layout, BODY), guides, ANCHORS, rest_lengths(layout, BODY), strict=False
    ):
        np.testing.assert_allclose(route, np.vstack([anchor, points]), atol=1e-12)
        assert rest == pytest.approx(np.linalg.norm(np.diff(route, axis=0), axis=1).sum())


@pytest.mark.parametrize(
    ("guides", "message"),
    [
        ([np.zeros((0, 3))], "no guide"),
        ([np.array([[0.0, 0.0, 0.05], [0.0, 0.0, 0.05]])], "coincide"),
        ([np.array([[0.0, 0.0, 0.05]])] * 2, "anchors"),
    ],
)
def test_impossible_cables_are_refused(guides, message):
    with pytest.raises(InputError, match=message):
        fem.cable_layout(BODY, np.array([[0.01, 0.0, 0.0]]), guides)
