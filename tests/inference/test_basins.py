"""Climbs on one summit are told from climbs on several."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.inference import laplace, methods
from rfdropo_bayes.inference.basins import one_point, one_ridge, summits

from .toys import LateVerdict, LinearGaussian, Ratio, TwoModes, Washboard

KEY = jax.random.key(3)


def density_of(problem):
    def density(u):
        values = problem.from_unconstrained(jnp.asarray(u))
        rows, _ = problem.row_log_likelihood(values, problem.n_rows)
        return np.asarray(problem.log_prior(jnp.asarray(u))) + np.asarray(rows).sum(axis=1)

    return density


def unconstrained(problem, **values):
    return np.asarray(problem.to_unconstrained({k: jnp.array([v]) for k, v in values.items()}))[0]


def test_a_ridge_that_ends_at_two_bounds_is_one_summit():
    problem = Ratio()
    # The logarithm of the ratio is a regression on the gain.
    ratio = np.exp(problem.gain @ problem.data / (problem.gain @ problem.gain))
    ends = [unconstrained(problem, stiffness=s, mass=s / ratio) for s in (2.6, 3.1)]
    assert one_ridge(problem, KEY)(density_of(problem), *ends)
    beside = unconstrained(problem, stiffness=3.1, mass=1.01 * 3.1 / ratio)
    assert not one_ridge(problem, KEY)(density_of(problem), ends[0], beside)


@pytest.mark.parametrize(
    ("problem", "first", "second"),
    [
        (TwoModes(2), [-1.0, -0.5], [1.0, -0.5]),
        (Washboard(2), [-1.3, 3.4], [-0.3, 3.4]),
        (Washboard(2), [-1.3, 3.4], [-1.3 + 5.0, 3.4]),
        (LateVerdict(), [-1.0], [1.0]),
    ],
)
def test_summits_with_a_valley_between_are_two(problem, first, second):
    assert not one_ridge(problem, KEY)(density_of(problem), np.array(first), np.array(second))


def test_a_climb_that_came_to_rest_further_down_is_kept():
    problem = LinearGaussian(n_rows=6, d=1, noise=0.1)
    mean, covariance = problem.posterior()
    same, density = one_ridge(problem, KEY), density_of(problem)
    sd = np.sqrt(covariance[0])
    assert same(density, mean, mean + sd)  # half a nat
    assert not same(density, mean, mean + 3.0 * sd)  # four and a half


def test_lost_rollouts_between_two_climbs_join_nothing():
    lost = lambda u: np.where(np.abs(u[:, 0]) < 0.5, np.nan, 0.0)  # noqa: E731
    problem = LinearGaussian(n_rows=6, d=1)
    assert not one_ridge(problem, KEY)(lost, np.array([-1.0]), np.array([1.0]))


def test_the_highest_climb_of_each_summit_is_kept_in_order():
    positions = np.array([[0.0], [5.0], [5.01], [0.01], [9.0]])
    heights = np.array([1.0, 3.0, 4.0, 2.0, -np.inf])
    np.testing.assert_array_equal(summits(positions, heights, lambda u: u[:, 0], one_point), [2, 3, 4])


@pytest.mark.slow
def test_a_summit_that_half_of_the_recording_hides_is_found(monkeypatch):
    """All particles of the survey end in the wide valley, at +1; the last rows put the truth at -1. Of the starts from
    an earlier prefix each lies in the narrow valley with a probability of about a tenth to a half."""
    config = {"survey": 128, "starts": 8, "rollouts": 8000.0}
    found = methods.run(LateVerdict(), "laplace", config, KEY)
    assert found.optimum["x0"] == pytest.approx(-1.0, abs=1e-3)
    monkeypatch.setattr(laplace, "SURVEYS", 1)
    misled = methods.run(LateVerdict(), "laplace", config, KEY)
    assert misled.optimum["x0"] == pytest.approx(1.0, abs=0.1)
    assert misled.log_evidence[0] < found.log_evidence[0] - 10.0
