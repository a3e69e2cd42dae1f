"""Draws of a normal approximation, weighted by the exact posterior: a curved ridge against quadrature."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from rfdropo_bayes.cautions import Code
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.modes.mixture import draw_mixture
from rfdropo_bayes.inference.modes.optimisation import Laplace
from rfdropo_bayes.inference.modes.reweighting import FIRST, Reweighted, reweighted, reweighting_cautions

from ..toys import LinearGaussian

KEY = jax.random.key(3)
ROWS, NOISE, SEEN, CENTRE, SPREAD = 4, 0.15, 2.0, 1.4, 0.5
N = 2000


class Product(LinearGaussian):
    """A product of two parameters is observed: the posterior is a piece of a hyperbola."""

    def __init__(self, fails_above: float = np.inf, centre: float = CENTRE, unit: float = 1.0) -> None:
        super().__init__(n_rows=ROWS, d=2)
        self.unit = np.array([1.0, unit])
        self.mean, self.sd = centre * self.unit, SPREAD * self.unit
        self.fails_above = fails_above

    def log_prior(self, u):
        return -0.5 * np.sum(((np.asarray(u) - self.mean) / self.sd) ** 2, axis=1)

    def row_log_likelihood(self, values, horizon):
        u = np.asarray(self.to_unconstrained(values))
        rows = -0.5 * ((SEEN - (u / self.unit).prod(axis=1)) / NOISE) ** 2 - np.log(NOISE)
        return np.repeat(rows[:, None], horizon, axis=1), (u[:, 0] > self.fails_above).astype(int)


def normal_at_the_optimum(centre: float = CENTRE) -> Laplace:
    """Of a density that is symmetric in the two parameters: where both are the same."""
    grid = np.linspace(1.0, 2.0, 100_001)
    density = -0.5 * ROWS * ((SEEN - grid**2) / NOISE) ** 2 - ((grid - centre) / SPREAD) ** 2
    both = grid[np.argmax(density)]
    precision = np.eye(2) / SPREAD**2 + ROWS / NOISE**2 * both**2 * np.ones((2, 2))
    return Laplace(np.full(2, both), np.linalg.inv(precision), 0.0)


def quadrature() -> tuple[float, float, float]:
    """Mean and deviation of one parameter, and the mean of the product's error in noises."""
    grid = np.linspace(-1.0, 4.0, 2001)
    a, b = np.meshgrid(grid, grid, indexing="ij")
    error = (SEEN - a * b) / NOISE
    weight = np.exp(-0.5 * ROWS * error**2 - 0.5 * ((a - CENTRE) ** 2 + (b - CENTRE) ** 2) / SPREAD**2)
    weight /= weight.sum()
    mean = float(np.sum(weight * a))
    return mean, float(np.sqrt(np.sum(weight * (a - mean) ** 2))), float(np.sqrt(np.sum(weight * error**2)))


def test_a_curved_ridge_is_what_quadrature_says():
    """Means of n effective draws scatter by a deviation over sqrt(n); four times that is allowed."""
    problem, mode, ledger = Product(), normal_at_the_optimum(), Ledger()
    raw = draw_mixture([mode], N, KEY)
    found = reweighted(problem, [mode], N, KEY, ledger, N)
    mean, sd, error = quadrature()
    scatter = 4.0 / np.sqrt(found.effective)
    assert abs(found.position[:, 0].mean() - mean) < scatter * sd
    assert found.position[:, 0].std() == pytest.approx(sd, rel=scatter)

    def errors(u):
        return np.sqrt(np.mean(((SEEN - u.prod(axis=1)) / NOISE) ** 2))

    assert errors(found.position) == pytest.approx(error, rel=scatter)
    assert errors(raw) > 1.5 * error  # the normal leaves the ridge
    assert 300.0 < found.effective < 1800.0
    assert (ledger.evaluations, found.candidates) == (N, N)
    np.testing.assert_allclose(found.rows.sum(axis=1).max(), -ROWS * np.log(NOISE), atol=0.01)


def test_units_of_parameters_do_not_matter():
    """A size of a law in metres has a variance of 1e-12 beside others of 1."""
    mode, unit = normal_at_the_optimum(), np.array([1.0, 1e-6])
    small = Laplace(mode.mean * unit, mode.covariance * np.outer(unit, unit), 0.0)
    plain = reweighted(Product(), [mode], N, KEY, Ledger(), N)
    scaled = reweighted(Product(unit=1e-6), [small], N, KEY, Ledger(), N)
    np.testing.assert_allclose(scaled.position / unit, plain.position, rtol=1e-6)
    assert scaled.effective == pytest.approx(plain.effective, rel=1e-6)


def test_a_normal_posterior_needs_no_weights():
    """The first candidates say so: the draws are the normal's own, and nothing more is spent."""
    problem, ledger = LinearGaussian(d=2), Ledger()
    mean, covariance = problem.posterior()
    found = reweighted(problem, [Laplace(mean, covariance, 0.0)], N, KEY, ledger, N)
    assert (ledger.evaluations, found.candidates, found.rows) == (FIRST, FIRST, None)
    assert found.effective == pytest.approx(N, rel=1e-6)
    assert len(np.unique(found.position[:, 0])) == N
    np.testing.assert_allclose(np.cov(found.position.T), covariance, atol=0.1 * covariance.max())
    assert reweighting_cautions(found) == []


def test_a_normal_of_half_the_width_is_weighted():
    """Of one coordinate alone: its 100 first draws are worth about 60, which is not all of them."""
    problem, ledger = LinearGaussian(d=2), Ledger()
    mean, covariance = problem.posterior()
    narrow = Laplace(mean, covariance / 4.0, 0.0)
    found = reweighted(problem, [narrow], N, KEY, ledger, N)
    assert ledger.evaluations == N
    np.testing.assert_allclose(np.sqrt(np.diag(np.cov(found.position.T))), np.sqrt(np.diag(covariance)), rtol=0.15)


def test_failed_rollouts_get_no_draw_and_are_counted():
    ledger = Ledger()
    found = reweighted(Product(CENTRE), [normal_at_the_optimum()], N, KEY, ledger, N)
    assert found.position[:, 0].max() <= CENTRE
    assert sum(ledger.excluded.values()) > 100
    assert reweighted(Product(-9.0), [normal_at_the_optimum()], N, KEY, ledger, N) is None


def test_optima_have_equal_shares_whatever_their_masses():
    """A prior around zero makes both signs equally likely; one beside zero does not."""
    mode = normal_at_the_optimum(0.0)
    for centre in (0.0, 0.2):
        found = reweighted(Product(centre=centre), [mode, mode._replace(mean=-mode.mean)], N, KEY, Ledger(), N)
        assert np.mean(found.position[:, 0] > 0.0) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("effective", "candidates", "words", "grave"),
    [
        (2000, 2000, None, False),
        (60, 75, "worth 60 of 75", False),
        (60, 2000, "does not describe", False),
        (3, 9, "3 of 9", True),
    ],
)
def test_the_effective_number_is_said(effective, candidates, words, grave):
    nothing = np.empty((0, 1))
    found = reweighting_cautions(Reweighted(nothing, nothing, effective, candidates))
    assert [(caution.code, caution.grave) for caution in found] == [(Code.NORMAL_DIFFERS, grave)] * (words is not None)
    assert words is None or words in found[0].sentence
    assert ("does not describe" in found[0].sentence if found else False) == (effective < 0.1 * candidates)
    assert "to check" in reweighting_cautions(None)[0].sentence
