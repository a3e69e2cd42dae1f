"""Plain numpyro models as problems: coordinates, prefixes, and evidences with known answers."""

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
from rfdropo_bayes.inference.numpyro_problem import problem_from_numpyro

KEY = jax.random.key(6)
SCHOOLS = {
    "y": np.array([28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0]),
    "sigma": np.array([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0]),
}


def schools(y, sigma):
    mu = numpyro.sample("mu", dist.Normal(0.0, 5.0))
    tau = numpyro.sample("tau", dist.HalfCauchy(5.0))
    with numpyro.plate("school", 8):
        effect = numpyro.sample("effect", dist.Normal(0.0, 1.0))
        numpyro.sample("y", dist.Normal(mu + tau * effect, sigma), obs=y)


def shells(d):
    """Two Gaussian shells of radius 2 and width 0.1 at +-3.5 on the first axis, in a box of half width 6."""
    centres = np.zeros((2, d))
    centres[:, 0] = [3.5, -3.5]

    def model():
        x = numpyro.sample("x", dist.Uniform(-6.0, 6.0).expand([d]).to_event(1))
        radius = jnp.linalg.norm(x - centres, axis=1)
        numpyro.factor("shells", jax.scipy.special.logsumexp(dist.Normal(2.0, 0.1).log_prob(radius)))

    return model


def eggbox():
    x = numpyro.sample("x", dist.Uniform(0.0, 10.0 * jnp.pi))
    y = numpyro.sample("y", dist.Uniform(0.0, 10.0 * jnp.pi))
    numpyro.factor("box", (2.0 + jnp.cos(x / 2.0) * jnp.cos(y / 2.0)) ** 5)


def test_components_bounds_and_rows_of_a_vector_model():
    problem = problem_from_numpyro(schools, kwargs=SCHOOLS)
    assert problem.names == ("mu", "tau", *(f"effect[{j}]" for j in range(8)))
    assert problem.bounds["tau"] == (0.0, np.inf)
    assert problem.bounds["effect[3]"] == (-np.inf, np.inf)
    assert problem.n_rows == 8
    prior = problem.sample_prior(KEY, 5)
    u = problem.to_unconstrained(prior)
    back = problem.from_unconstrained(u)
    for name in problem.names:
        np.testing.assert_allclose(back[name], prior[name])
    rows, status = problem.row_log_likelihood(prior, 3)
    effect = np.asarray(prior["mu"]) + np.asarray(prior["tau"]) * np.asarray(prior["effect[2]"])
    expected = dist.Normal(effect, SCHOOLS["sigma"][2]).log_prob(SCHOOLS["y"][2])
    np.testing.assert_allclose(rows[:, 2], expected)
    assert rows.shape == (5, 3)
    assert not status.any()


def test_the_prior_is_a_density_in_the_unconstrained_space():
    """It integrates to one, Jacobian included."""

    def model(y):
        scale = numpyro.sample("scale", dist.LogNormal(0.3, 0.5))
        numpyro.sample("y", dist.Normal(0.0, scale), obs=y)

    problem = problem_from_numpyro(model, (np.array([1.0, 2.0]),))
    grid = np.linspace(-8.0, 8.0, 4001)
    assert np.trapezoid(np.exp(problem.log_prior(jnp.asarray(grid[:, None]))), grid) == pytest.approx(1.0, abs=1e-6)


def test_a_conjugate_model_has_its_evidence_at_every_prefix():
    y = np.array([1.0, 2.5, -0.3, 1.2, 3.0, 0.4])

    def model(y):
        mu = numpyro.sample("mu", dist.Normal(0.7, 1.5))
        numpyro.sample("y", dist.Normal(mu, 0.8), obs=y)

    result = methods.run(problem_from_numpyro(model, (y,)), "smc", {"particles": 1000, "replicates": 6}, KEY)
    covariance = 0.64 * np.eye(6) + 2.25
    exact = [multivariate_normal.logpdf(y[:h], np.full(h, 0.7), covariance[:h, :h]) for h in range(1, 7)]
    np.testing.assert_allclose(result.prefix_log_evidence, exact, atol=0.1)


@pytest.mark.slow
def test_a_simplex_has_fewer_coordinates_than_components():
    counts = np.array([30, 50, 20])

    def model(counts):
        share = numpyro.sample("share", dist.Dirichlet(jnp.array([1.0, 2.0, 3.0])))
        numpyro.sample("counts", dist.Multinomial(100, share), obs=counts)

    problem = problem_from_numpyro(model, (counts,))
    assert problem.names == ("share[0]", "share[1]", "share[2]")
    assert problem.to_unconstrained(problem.sample_prior(KEY, 4)).shape == (4, 2)
    result = methods.run(problem, "smc", {"particles": 500, "replicates": 4}, KEY)
    exact = dist.DirichletMultinomial(jnp.array([1.0, 2.0, 3.0]), 100).log_prob(counts)
    assert result.log_evidence[0] == pytest.approx(float(exact), abs=0.15)
    posterior_mean = (counts + np.array([1.0, 2.0, 3.0])) / 106.0
    means = [result.draws[name].mean() for name in problem.names]
    np.testing.assert_allclose(means, posterior_mean, atol=0.01)


def test_gaussian_shells_in_two_dimensions():
    """Five replicates of 1000 scatter by 0.06; both shells hold half of the mass."""
    options = {"particles": 1000, "replicates": 4, "max_moves": 8}
    result = methods.run(problem_from_numpyro(shells(2)), "smc", options, KEY)
    assert result.log_evidence[0] == pytest.approx(-1.7456, abs=0.15)
    assert np.mean(result.draws["x[0]"] > 0) == pytest.approx(0.5, abs=0.08)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "exact"), [(shells(2), -1.7456), (shells(5), -5.6736), (shells(10), -14.5905), (eggbox, 235.856)]
)
def test_hard_evidences(model, exact):
    """Within 3 replicate deviations (of the mean of 8: false failure below 1 in 1000), themselves at most 0.15."""
    options = {"particles": 2000, "replicates": 8, "target_ess": 0.7}
    value, sd = methods.run(problem_from_numpyro(model), "smc", options, KEY).log_evidence
    assert sd <= 0.15
    assert abs(value - exact) < 3.0 * sd


def schools_by_quadrature():
    """Log evidence and the mean and deviation of mu and tau: given tau all is normal, so one integral is left."""
    y, sigma = SCHOOLS["y"], SCHOOLS["sigma"]
    tau = np.concatenate([np.linspace(0.0, 100.0, 20001)[:-1], np.geomspace(100.0, 1e6, 4001)])
    precision = 1.0 / (sigma**2 + tau[:, None] ** 2)
    total = precision.sum(axis=1) + 1.0 / 25.0
    mean = (precision * y).sum(axis=1) / total
    log_marginal = 0.5 * np.log(precision / (2 * np.pi)).sum(axis=1) - 0.5 * np.log(25.0 * total)
    log_marginal += -0.5 * (precision * y**2).sum(axis=1) + 0.5 * total * mean**2
    density = np.exp(log_marginal) * 2.0 / (5.0 * np.pi * (1.0 + (tau / 5.0) ** 2))
    evidence = np.trapezoid(density, tau)

    def average(f):
        return np.trapezoid(f * density, tau) / evidence

    mu, second = average(mean), average(mean**2 + 1.0 / total)
    return np.log(evidence), (mu, np.sqrt(second - mu**2)), average(tau)


def test_eight_schools_agrees_with_quadrature():
    """4000 draws give the means to 0.05; thresholds allow for the heavy tail of tau."""
    options = {"particles": 1000, "replicates": 4}
    result = methods.run(problem_from_numpyro(schools, kwargs=SCHOOLS), "smc", options, KEY)
    evidence, (mean, sd), tau = schools_by_quadrature()
    assert result.log_evidence[0] == pytest.approx(evidence, abs=0.1)
    assert result.draws["mu"].mean() == pytest.approx(mean, abs=0.3)
    assert result.draws["mu"].std() == pytest.approx(sd, rel=0.1)
    assert result.draws["tau"].mean() == pytest.approx(tau, abs=0.35)


def _no_data():
    numpyro.sample("x", dist.Normal(0.0, 1.0))


def _no_parameters():
    numpyro.sample("x", dist.Normal(0.0, 1.0), obs=1.0)


def _improper():
    x = numpyro.sample("x", dist.ImproperUniform(dist.constraints.real, (), ()))
    numpyro.sample("y", dist.Normal(x, 1.0), obs=1.0)


def _discrete():
    x = numpyro.sample("x", dist.Poisson(3.0))
    numpyro.sample("y", dist.Normal(x, 1.0), obs=1.0)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (_no_data, "observes nothing"),
        (_no_parameters, "no parameters"),
        (_improper, "cannot be sampled"),
        (_discrete, "discrete"),
    ],
)
def test_models_that_cannot_be_sampled_are_refused(model, words):
    with pytest.raises(InputError, match=words):
        problem_from_numpyro(model)
