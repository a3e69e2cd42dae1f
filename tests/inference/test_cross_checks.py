"""NUTS and nested slice sampling: they share nothing with the sequential samplers, and agree with them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy.stats import multivariate_normal

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.plain.plain_problem import problem_from_numpyro

from .plain.test_plain_problem import SCHOOLS, schools, schools_by_quadrature
from .toys import Decay

KEY = jax.random.key(41)


def regression(x, y):
    """A linear regression as posteriordb has them: three coefficients and an unknown noise."""
    slope = numpyro.sample("slope", dist.Normal(0.0, 2.0).expand([3]).to_event(1))
    sigma = numpyro.sample("sigma", dist.HalfNormal(2.0))
    numpyro.sample("y", dist.Normal(x @ slope, sigma), obs=y)


def regression_data():
    rng = np.random.default_rng(2)
    x = np.column_stack([np.ones(40), rng.normal(size=(40, 2))])
    return {"x": x, "y": x @ np.array([0.5, -1.2, 2.0]) + 0.7 * rng.normal(size=40)}


def conjugate(y):
    mu = numpyro.sample("mu", dist.Normal(0.7, 1.5))
    numpyro.sample("y", dist.Normal(mu, 0.8), obs=y)


@pytest.mark.parametrize("method", ["nuts", "nested"])
def test_a_likelihood_that_cannot_be_traced_is_refused(method):
    with pytest.raises(InputError, match="no likelihood that JAX can trace"):
        methods.run(Decay(), method, {}, KEY)


@jax.custom_jvp
def compiled(x):
    """As compiled rollouts are: not traced, with differences along a direction for its derivative."""
    return jax.pure_callback(np.asarray, jax.ShapeDtypeStruct(jnp.shape(x), x.dtype), x, vmap_method="broadcast_all")


@compiled.defjvp
def _compiled_differences(primals, tangents):
    (x,), (direction,) = primals, tangents
    step = 1e-5 / jnp.maximum(jnp.abs(direction), 1e-12)
    return compiled(x), (compiled(x + step * direction) - compiled(x)) / step


def test_nuts_refuses_rollouts_whose_derivatives_are_differences():
    def model(y):
        numpyro.sample("y", dist.Normal(compiled(numpyro.sample("mu", dist.Normal(0.7, 1.5))), 0.8), obs=y)

    with pytest.raises(InputError, match=r'NUTS needs the gradient .* simulator.engine = "jax"'):
        methods.run(problem_from_numpyro(model, args=(np.array([0.1, 0.4]),)), "nuts", {}, KEY)


@pytest.mark.parametrize(("method", "wrong"), [("nuts", {"chains": 0}), ("nested", {"live": 3})])
def test_settings_are_checked(method, wrong):
    with pytest.raises(InputError):
        methods.make_config(method, wrong)


@pytest.mark.slow
def test_smc_and_nuts_agree_on_a_regression():
    """4000 draws of SMC, 1000 of NUTS: means agree to 0.1 posterior deviations, deviations to 10 %; five times the
    scatter of either."""
    problem = problem_from_numpyro(regression, kwargs=regression_data())
    chains = methods.run(problem, "nuts", {"chains": 2, "draws": 1000}, KEY)
    particles = methods.run(problem, "smc", {"particles": 1000, "replicates": 4}, KEY)
    for name in problem.names:
        first, second = chains.draws[name].ravel(), particles.draws[name].ravel()
        assert abs(first.mean() - second.mean()) < 0.2 * second.std()
        assert first.std() == pytest.approx(second.std(), rel=0.15)
    assert chains.details["diverging"] == 0


@pytest.mark.slow
def test_nuts_has_the_means_of_eight_schools():
    problem = problem_from_numpyro(schools, kwargs=SCHOOLS)
    result = methods.run(problem, "nuts", {"chains": 2, "draws": 1500}, KEY)
    _, (mean, sd), tau = schools_by_quadrature()
    assert result.draws["mu"].mean() == pytest.approx(mean, abs=0.4)
    assert result.draws["mu"].std() == pytest.approx(sd, rel=0.15)
    assert result.draws["tau"].mean() == pytest.approx(tau, abs=0.6)


@pytest.mark.slow
def test_nested_sampling_has_the_evidence_of_a_conjugate_model():
    """500 live points and 2 nats of information: a deviation of 0.06; the threshold is five times that."""
    y = np.array([1.0, 2.5, -0.3, 1.2, 3.0, 0.4])
    result = methods.run(problem_from_numpyro(conjugate, (y,)), "nested", {}, KEY)
    covariance = 0.64 * np.eye(6) + 2.25
    exact = multivariate_normal.logpdf(y, np.full(6, 0.7), covariance)
    assert result.log_evidence[0] == pytest.approx(exact, abs=0.3)
    assert 0.0 < result.log_evidence[1] < 0.2
    precision = 1.0 / 2.25 + 6.0 / 0.64
    assert result.draws["mu"].mean() == pytest.approx((0.7 / 2.25 + y.sum() / 0.64) / precision, abs=0.1)
    assert result.draws["mu"].std() == pytest.approx(precision**-0.5, rel=0.15)
