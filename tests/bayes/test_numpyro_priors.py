"""Priors given as distributions of numpyro: each is the table that has the same density, written to a file and back."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.distributions.transforms import AffineTransform, ExpTransform, SigmoidTransform

import rfdropo_bayes as rb
from rfdropo_bayes.bayes.priors import log_density, prior_from_table, table_of
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec

WIDE = ParameterSpec("size", "m", -1e3, 1e3, 0.0, {}, "anything")
TRUNCATED = {"distribution": "TruncatedNormal", "loc": 1.0, "scale": 2.0}


@pytest.mark.parametrize(
    ("prior", "table"),
    [
        (dist.LogNormal(0.0, 0.5), {"distribution": "LogNormal", "median": 1.0, "sigma": 0.5}),
        (dist.Normal(1.0, 2.0), {"distribution": "Normal", "loc": 1.0, "scale": 2.0}),
        (dist.HalfNormal(2.0), {"distribution": "HalfNormal", "scale": 2.0}),
        (dist.Uniform(1.0, 3.0), {"distribution": "Uniform", "low": 1.0, "high": 3.0}),
        (dist.LogUniform(1.0, 3.0), {"distribution": "LogUniform", "low": 1.0, "high": 3.0}),
        (dist.TruncatedNormal(1.0, 2.0, low=0.5, high=3.0), {**TRUNCATED, "low": 0.5, "high": 3.0}),
        (dist.TruncatedNormal(1.0, 2.0, low=0.5), {**TRUNCATED, "low": 0.5}),
        (dist.TruncatedNormal(1.0, 2.0, high=3.0), {**TRUNCATED, "high": 3.0}),
        (dist.Normal(np.ones(1), jnp.array(2.0)), {"distribution": "Normal", "loc": 1.0, "scale": 2.0}),
        (dist.TruncatedNormal(jnp.ones((1, 1)), 2.0, low=np.float32(0.5)), {**TRUNCATED, "low": 0.5}),
        (dist.HalfNormal(2.0 * np.ones(1)).to_event(1), {"distribution": "HalfNormal", "scale": 2.0}),
        (dist.Uniform(1.0, 3.0).expand([1]), {"distribution": "Uniform", "low": 1.0, "high": 3.0}),
        (
            dist.TransformedDistribution(dist.Normal(0.0, 0.5), ExpTransform()),
            {"distribution": "LogNormal", "median": 1.0, "sigma": 0.5},
        ),
        (
            dist.TransformedDistribution(dist.Normal(0.0, 1.0), AffineTransform(1.0, -2.0)),
            {"distribution": "Normal", "loc": 1.0, "scale": 2.0},
        ),
        (
            dist.TransformedDistribution(dist.HalfNormal(1.0), AffineTransform(3.0, -2.0)),
            {**TRUNCATED, "loc": 3.0, "high": 3.0},
        ),
        (
            dist.TransformedDistribution(dist.LogNormal(0.0, 0.5), AffineTransform(0.0, 3.0)),
            {"distribution": "LogNormal", "median": 3.0, "sigma": 0.5},
        ),
        (
            dist.TransformedDistribution(dist.Uniform(0.0, 1.0), [AffineTransform(0.0, 2.0), ExpTransform()]),
            {"distribution": "LogUniform", "low": 1.0, "high": np.exp(2.0)},
        ),
        ({**TRUNCATED, "loc": np.ones(1), "scale": jnp.array(2.0)}, TRUNCATED),
        (None, {}),
    ],
)
def test_a_distribution_is_the_table_of_the_same_density(prior, table):
    found = table_of(prior, where="")
    assert found == pytest.approx(table)
    assert all(isinstance(value, str | float) for value in found.values())
    if isinstance(prior, dist.Distribution):
        at = np.linspace(1.1, 2.9, 5)
        values = [np.sum(prior.log_prob(np.full(prior.shape(), value))) for value in at]
        np.testing.assert_allclose(prior_from_table(WIDE, found, where="").log_prob(at), values, rtol=1e-5)
        np.testing.assert_allclose(log_density(WIDE, found, at), values, rtol=1e-5)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (dist.Gamma(1.0), "Gamma cannot be a prior"),
        (dist.TruncatedCauchy(0.0, 1.0, low=0.0), "LeftTruncatedDistribution cannot be a prior"),
        (dist.TruncatedDistribution(dist.StudentT(4.0), low=0.0), "LeftTruncatedDistribution cannot be a prior"),
        (dist.TransformedDistribution(dist.Normal(0.0, 1.0), SigmoidTransform()), "TransformedDistribution cannot"),
        (dist.Normal(np.zeros(2), 1.0), "Normal has 2 elements, shape \\(2,\\); a prior is of one number"),
        (dist.Normal(np.zeros(3), 1.0).to_event(1), "Independent has 3 elements"),
        ({"distribution": "Normal", "loc": np.zeros(2), "scale": 1.0}, "loc has 2 elements"),
        (1.0, "float cannot be a prior"),
    ],
)
def test_what_no_table_describes_is_refused_by_name(prior, message):
    with pytest.raises(InputError, match=message):
        table_of(prior, where="priors, size")


def test_a_truncated_normal_ends_where_it_says_and_at_the_hard_bounds():
    spec = WIDE._replace(low=0.0)
    space = build_scopes([spec], {"size": {**TRUNCATED, "low": -1.0, "high": 1.5}}, {}, [])
    parameter = space["size"]
    assert parameter.ends == (0.0, 1.5)
    assert (parameter.spec.low, parameter.spec.high) == (0.0, 1.5)
    for ends in ({"low": 2.0, "high": 1.0}, {"high": -1.0}):
        with pytest.raises(InputError, match=r"not below high|of the prior lies within the bounds"):
            prior_from_table(spec, {**TRUNCATED, **ends}, where="")


def test_a_written_model_has_the_same_prior():
    prior = dist.TruncatedNormal(np.array([3e6]), 1e6, low=2e6, high=5e6)
    model = rb.Model("smooth_arm", priors={"young_modulus": prior})
    table = model.tables()["model"]["priors"]["young_modulus"]
    assert rb.Model("smooth_arm", priors={"young_modulus": table}).parameters.equals(model.parameters)
    assert (table["low"], table["high"]) == (2e6, 5e6)
