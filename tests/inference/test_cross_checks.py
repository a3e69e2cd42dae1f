"""NUTS and nested slice sampling: they share nothing with the sequential samplers, and agree with closed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods

from .toys import Decay, LinearGaussian

KEY = jax.random.key(41)


class Traced(LinearGaussian):
    """Its likelihood as JAX wants it."""

    def log_likelihood_at(self, u):
        return self._row_density(u[None], self.n_rows).sum()


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
    class Compiled(Traced):
        def log_likelihood_at(self, u):
            return compiled(u).sum()

    with pytest.raises(InputError, match=r'NUTS needs the gradient .* simulator.engine = "jax"'):
        methods.run(Compiled(), "nuts", {}, KEY)


@pytest.mark.parametrize(("method", "wrong"), [("nuts", {"draws": 0}), ("nested", {"live": 3})])
def test_settings_are_checked(method, wrong):
    with pytest.raises(InputError):
        methods.make_config(method, wrong)


@pytest.mark.slow
def test_nuts_has_the_posterior_of_a_linear_model():
    """2000 draws that are nearly independent: a mean errs by 0.03 deviations; the threshold is five times that."""
    problem = Traced()
    result = methods.run(problem, "nuts", {"draws": 1000}, KEY)
    mean, covariance = problem.posterior()
    for j, name in enumerate(problem.names):
        assert result.draws[name].shape == (2, 1000)
        assert result.draws[name].mean() == pytest.approx(mean[j], abs=0.15 * covariance[j, j] ** 0.5)
        assert result.draws[name].std() == pytest.approx(covariance[j, j] ** 0.5, rel=0.15)
    assert result.details["diverging"] == 0


@pytest.mark.slow
def test_nested_sampling_has_the_evidence_of_a_linear_model():
    """500 live points and some 10 nats of information: a deviation of 0.14; the threshold is four times that."""
    problem = Traced()
    result = methods.run(problem, "nested", {}, KEY)
    mean, covariance = problem.posterior()
    assert result.log_evidence[0] == pytest.approx(problem.prefix_log_evidence()[-1], abs=0.6)
    assert 0.0 < result.log_evidence[1] < 0.4
    for j, name in enumerate(problem.names):
        assert result.draws[name].mean() == pytest.approx(mean[j], abs=0.25 * covariance[j, j] ** 0.5)
