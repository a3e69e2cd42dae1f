"""Normal approximations joined with a prior: exact where rounding allows, usable where it does not."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.stats import ortho_group

from rfdropo_bayes.inference.modes.optimisation import Laplace
from rfdropo_bayes.inference.smc.bridge import NARROWEST, ModeMixture, covering, joint_covariance, prior_moments

from ..toys import LinearGaussian

KEY = jax.random.key(31)


def turned(values, seed=0):
    axes = ortho_group.rvs(len(values), random_state=seed)
    return (axes * np.array(values)) @ axes.T, axes


@pytest.mark.parametrize("seed", range(3))
def test_information_and_prior_add_up(seed):
    information, _ = turned([1e4, 3.0, 0.0, 50.0], seed)
    prior, _ = turned([4.0, 0.1, 1.0, 9.0], seed + 10)
    expected = np.linalg.inv(information + np.linalg.inv(prior))
    np.testing.assert_allclose(joint_covariance(information, prior), expected, rtol=1e-8, atol=1e-12)


def test_negative_information_is_none():
    information, _ = turned([5.0, -1e-3, -40.0])
    found = np.linalg.eigvalsh(joint_covariance(information, np.eye(3)))
    np.testing.assert_allclose(found, [1.0 / 6.0, 1.0, 1.0])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("exponent", [11, 14, 17, 20, 30])
def test_what_a_cliff_does_not_tell_is_left_to_the_prior(exponent, seed):
    """In any direction, and any height of the cliff: rounding leaves 1e4 of the zeros beside 1e20."""
    information, axes = turned([10.0**exponent, 0.0, 0.0, 0.0], seed)
    found = axes.T @ joint_covariance(information, np.eye(4)) @ axes
    np.testing.assert_allclose(np.sqrt(np.diag(found))[1:], 1.0, rtol=0.02)


def test_units_do_not_matter():
    information, axes = turned([1e11, 0.0, 0.0])
    units = np.diag([1e3, 1.0, 1e-3])
    found = joint_covariance(np.linalg.inv(units) @ information @ np.linalg.inv(units), units @ units)
    deviations = np.sqrt(np.diag(axes.T @ np.linalg.solve(units, found) @ np.linalg.inv(units) @ axes))
    np.testing.assert_allclose(deviations, [10.0**-5.5, 1.0, 1.0], rtol=1e-2)


@pytest.mark.parametrize("sizes", [[0.0, 1.0], [1.0, 1.0], [1.0, 1e-9]])
def test_a_prior_of_dependent_coordinates_is_taken(sizes):
    """Draws of which one coordinate follows from another have a singular covariance."""
    drawn = np.random.default_rng(0).normal(size=(2, 500))
    prior = np.cov(np.stack([drawn[0], sizes[0] * drawn[0] + 1e-12 * drawn[1], sizes[1] * drawn[1]]))
    np.linalg.cholesky(joint_covariance(np.diag([4.0, 1.0, 0.0]), prior))


@pytest.mark.parametrize("exponent", [14, 20, 30])
def test_a_cliff_of_any_height_leaves_a_density(exponent):
    """Its differences once promised more than double precision holds beside a prior, and the fit failed."""
    problem = LinearGaussian(n_rows=5, d=4)
    information, _ = turned([10.0**exponent, 1e3, 1.0, 0.0])
    mode = Laplace(problem.mean + 0.1, np.diag(problem.sd**2), 2.0, information, np.ones(4))
    mode_again, wide = covering(problem, [mode], KEY)
    assert mode_again is mode
    assert wide.log_evidence == pytest.approx(mode.log_evidence)
    root = np.linalg.cholesky(prior_moments(problem, KEY)[1])
    whitened = np.linalg.solve(root, np.linalg.solve(root, wide.covariance).T)
    spread = np.sqrt(np.linalg.eigvalsh(whitened))
    assert spread[0] >= 0.5 * NARROWEST * spread[-1]
    mixture = ModeMixture(problem, [mode, wide], 1.5, 5.0, 0.05)
    assert np.isfinite(mixture.log_density(mixture.sample(KEY, 100))).all()
