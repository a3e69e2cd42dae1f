"""Fits of many draws at once: closed form of a linear model, a general optimiser on a bent one."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from rfdropo_bayes.prediction.own_fit import TOLERANCE, fit_own

N, K, M = 40, 5, 20


def problem():
    rng = np.random.default_rng(0)
    slope = rng.normal(size=(M, K)) + 0.2 * rng.normal(size=(N, M, K))
    return slope, 3.0 * rng.normal(size=(N, M)), rng.normal(size=(N, K))


def test_a_linear_model_ends_at_the_closed_form():
    slope, measured, centre = problem()
    fit = fit_own(lambda x, draw: np.einsum("nij,nj->ni", slope[draw], x) - measured[draw], centre)
    assert fit.converged.all()
    for draw in range(N):
        normal = slope[draw].T @ slope[draw] + np.eye(K)
        exact = np.linalg.solve(normal, slope[draw].T @ measured[draw] + centre[draw])
        away = fit.point[draw] - exact
        assert 0.5 * away @ normal @ away < 2 * TOLERANCE
    np.testing.assert_allclose(fit.slope, slope, atol=1e-8)


def test_a_bent_model_ends_where_a_general_optimiser_does():
    slope, measured, centre = problem()

    def residuals(x, draw):
        return np.einsum("nij,nj->ni", slope[draw], x + 0.25 * np.sin(2.0 * x)) - measured[draw]

    fit = fit_own(residuals, centre)
    assert fit.converged.all()
    for draw in range(8):

        def whole(x, draw=draw):
            return np.concatenate([residuals(x[None], np.array([draw]))[0], x - centre[draw]])

        found = 0.5 * np.sum(whole(fit.point[draw]) ** 2)
        assert found < least_squares(whole, fit.point[draw]).cost + 5 * TOLERANCE


def test_a_draw_without_residuals_is_not_said_to_have_converged():
    """Nor one on whose cliff no step leads down; the others do not suffer."""
    slope, measured, centre = problem()

    def residuals(x, draw):
        found = np.einsum("nij,nj->ni", slope[draw], x) - measured[draw]
        return np.where((draw == 3)[:, None], np.nan, found)

    fit = fit_own(residuals, centre)
    np.testing.assert_array_equal(np.flatnonzero(~fit.converged), [3])
