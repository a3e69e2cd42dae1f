"""Evidence of effects of unknown size: against quadrature, and what it says of small effects of several parameters."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from rfdropo_bayes.discrepancy.unknown_size import SCALES, linear_evidence, scale_gain


def test_the_evidence_of_one_linear_effect_is_its_integral():
    """Likelihood of an effect of size a, integrated over its prior of every scale."""
    rng = np.random.default_rng(1)
    effect, noise = rng.standard_normal((40, 1)), rng.standard_normal(40)
    for size in (0.0, 0.3, 3.0):
        residual = size * effect[:, 0] + noise

        def ratio(a: float, scale: float, residual: np.ndarray = residual) -> float:
            gained = 0.5 * (residual @ residual - np.sum((residual - a * effect[:, 0]) ** 2))
            return float(np.exp(gained) * norm.pdf(a, scale=scale))

        integrals = [quad(ratio, -40.0, 40.0, args=(s,), points=[size, 0.0], limit=400)[0] for s in SCALES]
        assert linear_evidence(effect, residual) == pytest.approx(np.log(np.mean(integrals)), abs=1e-5)


def test_the_evidence_of_several_effects_is_the_density_of_the_data():
    rng = np.random.default_rng(2)
    effect, residual = rng.standard_normal((12, 3)), 2.0 * rng.standard_normal(12)
    under = [multivariate_normal(cov=np.eye(12) + s**2 * effect @ effect.T).logpdf(residual) for s in SCALES]
    without = multivariate_normal(cov=np.eye(12)).logpdf(residual)
    assert linear_evidence(effect, residual) == pytest.approx(logsumexp(under) - np.log(len(SCALES)) - without)


def test_an_effect_of_several_parameters_is_likelier_than_a_half_of_it():
    """Four sizes of hundredths of a deviation of their prior; the direction of one takes a half of the misfit."""
    rng = np.random.default_rng(3)
    effect, _ = np.linalg.qr(rng.standard_normal((400, 4)))
    effect *= 200.0
    residual = effect @ np.array([0.03, 0.015, -0.015, 0.015])  # 32 nats at best, 18 of them by its first part
    family, half = linear_evidence(effect, residual), linear_evidence(effect[:, :1], residual)
    assert family > half + 3.0
    under = [multivariate_normal(cov=np.eye(400) + e @ e.T).logpdf(residual) for e in (effect, effect[:, :1])]
    assert under[0] < under[1]  # with the prior's own scale the half wins


def test_a_size_of_one_sign_has_the_evidence_of_half_its_prior():
    effect = np.random.default_rng(5).standard_normal((40, 1))
    for size in (1.5, -0.5):
        residual = size * effect[:, 0] + 0.5

        def ratio(a: float, scale: float, residual: np.ndarray = residual) -> float:
            gained = 0.5 * (residual @ residual - np.sum((residual - a * effect[:, 0]) ** 2))
            return float(2.0 * np.exp(gained) * norm.pdf(a, scale=scale))

        integrals = [quad(ratio, 0.0, 40.0, args=(s,), points=[0.0, 1.5], limit=400)[0] for s in SCALES]
        assert linear_evidence(effect, residual, 1) == pytest.approx(np.log(np.mean(integrals)), abs=1e-5)
        assert linear_evidence(-effect, residual, -1) == pytest.approx(linear_evidence(effect, residual, 1))


def test_a_refit_has_the_evidence_of_the_linear_effect():
    """`scale_gain` of a mode under the prior, added to its evidence there."""
    rng = np.random.default_rng(6)
    effect, residual = 5.0 * rng.standard_normal((30, 3)), 3.0 * rng.standard_normal(30)
    covariance = np.linalg.inv(np.eye(3) + effect.T @ effect)
    mode = covariance @ effect.T @ residual
    alone = 0.5 * residual @ effect @ mode + 0.5 * np.linalg.slogdet(covariance)[1]
    assert alone + scale_gain(mode, covariance) == pytest.approx(linear_evidence(effect, residual))


def test_no_effect_is_no_evidence_and_no_parameter_no_gain():
    effect = np.random.default_rng(4).standard_normal((100, 2))
    assert -5.0 < linear_evidence(effect, np.zeros(100)) < 0.0
    assert scale_gain(np.zeros(0), np.zeros((0, 0))) == 0.0


def test_two_effects_have_more_evidence_than_one_of_them_beside_a_family_that_fits_as_well():
    """The family holds the second effect; the drop of the sum of squares alone prefers it. One fixed draw."""
    rng = np.random.default_rng(3)
    first, second, others = (rng.normal(size=(400, k)) for k in (1, 1, 11))
    residual = 0.4 * first[:, 0] + 0.4 * second[:, 0] + rng.normal(size=400)
    pair, family = np.hstack([first, second]), np.hstack([first, second, others])
    drop, larger = (np.linalg.lstsq(each, residual, rcond=None)[1][0] for each in (pair, family))
    assert larger < drop
    assert linear_evidence(pair, residual) > linear_evidence(family, residual) + 1.0
