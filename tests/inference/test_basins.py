"""Climbs on one summit are told from climbs on several."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.modes import first_climbs
from rfdropo_bayes.inference.modes.basins import Climb, one_point, one_ridge, summits

from .toys import LateVerdict, LinearGaussian, Ratio, TwoModes, Washboard

KEY = jax.random.key(3)


def density_of(problem):
    def density(u):
        values = problem.from_unconstrained(jnp.asarray(u))
        rows, _ = problem.row_log_likelihood(values, problem.n_rows)
        return np.asarray(problem.log_prior(jnp.asarray(u))) + np.asarray(rows).sum(axis=1)

    return density


def one_summit(problem, first, second):
    density = density_of(problem)
    climbs = [Climb(np.array(u), density(np.array(u)[None])[0]) for u in (first, second)]
    return one_ridge(problem, KEY)(density, *climbs)


def unconstrained(problem, **values):
    return np.asarray(problem.to_unconstrained({k: jnp.array([v]) for k, v in values.items()}))[0]


def test_a_ridge_that_ends_at_two_bounds_is_one_summit():
    problem = Ratio()
    # The logarithm of the ratio is a regression on the gain.
    ratio = np.exp(problem.gain @ problem.data / (problem.gain @ problem.gain))
    ends = [unconstrained(problem, stiffness=s, mass=s / ratio) for s in (2.6, 3.1)]
    assert one_summit(problem, *ends)
    beside = unconstrained(problem, stiffness=3.1, mass=1.01 * 3.1 / ratio)
    assert not one_summit(problem, ends[0], beside)


@pytest.mark.parametrize("apart", range(1, 31))
def test_crests_of_one_height_at_even_distances_are_several(apart):
    problem = Washboard(2)
    problem.width = 1000.0
    problem.sd = np.full(2, 1000.0)
    assert not one_summit(problem, problem.centre, problem.centre + np.array([apart, 0.0]))


def test_two_modes_that_say_the_same_are_two():
    assert not one_summit(TwoModes(2), [-1.0, -0.5], [1.0, -0.5])


def test_a_climb_that_came_to_rest_further_down_is_kept():
    problem = LinearGaussian(n_rows=6, d=1, noise=0.1)
    mean, covariance = problem.posterior()
    sd = np.sqrt(covariance[0])
    assert one_summit(problem, mean, mean + sd)  # half a nat
    assert not one_summit(problem, mean, mean + 3.0 * sd)  # four and a half


@pytest.mark.parametrize("heights", [(0.0, -10.0), (-np.inf, -np.inf), (0.0, np.nan)])
def test_climbs_of_unlike_heights_cost_no_rollouts(heights):
    problem = LinearGaussian(n_rows=6, d=1)
    climbs = [Climb(np.array([place]), height) for place, height in zip((-1.0, 1.0), heights, strict=True)]
    assert not one_ridge(problem, KEY)(lambda u: pytest.fail("evaluated"), *climbs)


def test_lost_rollouts_between_two_climbs_join_nothing():
    lost = lambda u: np.where(np.abs(u[:, 0]) < 0.5, np.nan, 0.0)  # noqa: E731
    problem = LinearGaussian(n_rows=6, d=1)
    assert not one_ridge(problem, KEY)(lost, Climb(np.array([-1.0]), 0.0), Climb(np.array([1.0]), 0.0))


def test_the_highest_climb_of_each_summit_is_kept_in_order():
    positions = np.array([[0.0], [5.0], [5.01], [0.01], [9.0]])
    heights = np.array([1.0, 3.0, 4.0, 2.0, -np.inf])
    np.testing.assert_array_equal(summits(positions, heights, lambda u: u[:, 0], one_point), [2, 3, 4])


@pytest.mark.slow
def test_a_summit_that_half_of_the_recording_hides_is_found(monkeypatch):
    """All particles of the survey end in the wide basin, at +1; the last rows put the truth at -1. Of the starts from
    an earlier prefix each lies in the narrow basin with a probability of about a tenth to a half."""
    config = {"survey": 128, "starts": 8, "rollouts": 8000.0}
    found = methods.run(LateVerdict(), "laplace", config, KEY)
    assert found.optimum["x0"] == pytest.approx(-1.0, abs=1e-3)
    monkeypatch.setattr(first_climbs, "SURVEYS", 1)
    misled = methods.run(LateVerdict(), "laplace", config, KEY)
    assert misled.optimum["x0"] == pytest.approx(1.0, abs=0.1)
    assert misled.log_evidence[0] < found.log_evidence[0] - 10.0
