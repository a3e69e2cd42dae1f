"""Priors from tables: densities against SciPy, and every way a table can be wrong."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfdropo_bayes.bayes.priors import prior_from_table
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec

YOUNG = ParameterSpec("young_modulus", "Pa", 1e6, 5e7, 4.5e6, {}, "stiffness")
POISSON = ParameterSpec("poisson_ratio", "-", 0.1, 0.499, 0.45, {}, "compressibility")


def test_a_lognormal_is_truncated_to_the_hard_bounds():
    prior = prior_from_table(YOUNG, {"distribution": "LogNormal", "median": 4.5e6, "sigma": 0.5}, where="here")
    bell = stats.lognorm(0.5, scale=4.5e6)
    at = np.array([1.5e6, 4.5e6, 2e7])
    expected = bell.logpdf(at) - np.log(bell.cdf(5e7) - bell.cdf(1e6))
    np.testing.assert_allclose(prior.log_prob(at), expected, rtol=1e-9)
    draws = np.asarray(prior.sample(jax.random.key(0), (2000,)))
    assert draws.min() >= 1e6
    assert draws.max() <= 5e7


def test_a_normal_is_truncated_to_the_hard_bounds():
    prior = prior_from_table(POISSON, {"distribution": "Normal", "loc": 0.45, "scale": 0.05}, where="here")
    bell = stats.norm(0.45, 0.05)
    expected = bell.logpdf(0.4) - np.log(bell.cdf(0.499) - bell.cdf(0.1))
    np.testing.assert_allclose(prior.log_prob(0.4), expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("spec", "table", "message"),
    [
        (YOUNG, {"distribution": "Lognormal", "median": 4.5e6, "sigma": 0.5}, "did you mean 'LogNormal'"),
        (YOUNG, {"distribution": "LogNormal", "mean": 4.5e6, "sigma": 0.5}, "takes no argument 'mean'"),
        (YOUNG, {"distribution": "LogNormal", "median": 4.5e6}, "lacks sigma"),
        (YOUNG, {"distribution": "LogNormal", "median": 4.5e6, "sigma": 0.0}, "not positive"),
        (YOUNG, {"distribution": "LogNormal", "median": 4.5e3, "sigma": 0.5}, "0 % of the prior lies within"),
        (POISSON, {"distribution": "Uniform", "low": 0.4, "high": 0.6}, "reaches outside the bounds"),
        (POISSON, {"distribution": "Uniform", "low": 0.45, "high": 0.4}, "not below"),
        (POISSON, {"distribution": "Normal", "loc": float("nan"), "scale": 0.1}, "not a finite number"),
        (POISSON, {"distribution": "Normal", "loc": "half", "scale": 0.1}, "not a finite number"),
    ],
)
def test_an_unusable_table_says_what_is_wrong_and_where(spec, table, message):
    with pytest.raises(InputError, match=message) as caught:
        prior_from_table(spec, table, where="[model.priors] here")
    assert str(caught.value).startswith("[model.priors] here: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("low", "high"), [(0.0, 20.0), (0.05, 20.0), (0.0, np.inf), (0.05, np.inf)])
def test_a_log_normal_prior_ends_at_the_hard_bounds(low, high):
    """However far a search goes in unconstrained coordinates, and with a density that integrates to one there."""
    spec = ParameterSpec("drag", "1/s", low, high, 0.1, {"distribution": "LogNormal", "median": 0.1, "sigma": 1.0}, "")
    space = build_scopes([spec], {"drag": {}}, {}, ["a"])
    u = jnp.linspace(-30.0, 30.0, 60001)[:, None]
    value = np.asarray(space.from_unconstrained(u)["drag"])
    assert low <= value.min() < value.max() <= high
    density = np.exp(np.asarray(space.log_prior_unconstrained(u)))
    assert np.trapezoid(density, np.asarray(u)[:, 0]) == pytest.approx(1.0, abs=1e-6)
    prior = space["drag"].prior
    assert bool(prior.support(0.5 * (max(low, 0.01) + 1.0)))
    assert not bool(prior.support(high + 1.0)) or high == np.inf
