"""Plain numpyro models as problems: coordinates, prefixes, and evidences with known answers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy.special import gammainc, gammaln, logsumexp
from scipy.stats import gamma, multivariate_normal

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.plain.plain_problem import problem_from_numpyro
from rfdropo_bayes.inference.smc import sampler
from rfdropo_bayes.inference.smc.sampler import SmcConfig

from ..toys import LinearGaussian

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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "exact"), [(shells(2), -1.7456), (shells(5), -5.6736), (shells(10), -14.5905), (eggbox, 235.856)]
)
def test_hard_evidences(model, exact):
    """Within 3 replicate deviations (of the mean of 8: false failure below 1 in 1000), themselves at most 0.15."""
    options = {"particles": 2000, "replicates": 8, "target_ess": 0.7}
    result = methods.run(problem_from_numpyro(model), "smc", options, KEY)
    value, sd = result.log_evidence
    assert sd <= 0.15
    assert abs(value - exact) < 3.0 * sd
    if model is not eggbox:  # both shells keep their halves: 16000 draws, of which replicates scatter by 0.03
        assert np.mean(result.draws["x[0]"] > 0) == pytest.approx(0.5, abs=0.05)


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


@pytest.mark.slow
def test_eight_schools_agrees_with_quadrature():
    """4000 draws give the means to 0.05; thresholds allow for the heavy tail of tau."""
    options = {"particles": 1000, "replicates": 4}
    result = methods.run(problem_from_numpyro(schools, kwargs=SCHOOLS), "smc", options, KEY)
    evidence, (mean, sd), tau = schools_by_quadrature()
    assert result.log_evidence[0] == pytest.approx(evidence, abs=0.1)
    assert result.draws["mu"].mean() == pytest.approx(mean, abs=0.3)
    assert result.draws["mu"].std() == pytest.approx(sd, rel=0.1)
    assert result.draws["tau"].mean() == pytest.approx(tau, abs=0.35)


def garch(y):
    """A volatility model as posteriordb has it: the range of one parameter ends where another says."""
    mu = numpyro.sample("mu", dist.Normal(0.0, 10.0))
    base = numpyro.sample("alpha0", dist.HalfNormal(5.0))
    shock = numpyro.sample("alpha1", dist.Uniform(0.0, 1.0))
    memory = numpyro.sample("beta1", dist.Uniform(0.0, 1.0 - shock))

    def follow(sigma, value):
        following = jnp.sqrt(base + shock * (value - mu) ** 2 + memory * sigma**2)
        return following, following

    _, sigma = jax.lax.scan(follow, 1.0, y[:-1])
    numpyro.sample("y", dist.Normal(mu, jnp.concatenate([jnp.ones(1), sigma])), obs=y)


def test_a_range_that_moves_with_another_parameter_is_no_bound():
    problem = problem_from_numpyro(garch, (np.array([4.0, 5.5, 3.2, 7.0]),))
    assert problem.bounds["alpha1"] == (0.0, 1.0)
    assert problem.bounds["beta1"] == (-np.inf, np.inf)
    prior = problem.sample_prior(KEY, 200)
    assert np.all(np.asarray(prior["beta1"]) < 1.0 - np.asarray(prior["alpha1"]))
    back = problem.from_unconstrained(problem.to_unconstrained(prior))
    np.testing.assert_allclose(back["beta1"], prior["beta1"], rtol=1e-9)


@pytest.mark.slow
def test_data_outside_their_interval_have_no_likelihood():
    """y ~ uniform(0, theta): the evidence is the integral of theta^-n from the largest y on. Four replicates of 500
    scatter by 0.1 each, their mean by 0.05; the threshold is five times that."""
    y = np.array([0.7, 2.1, 1.4, 2.9, 0.2])

    def model(y):
        theta = numpyro.sample("theta", dist.Uniform(0.0, 10.0))
        numpyro.sample("y", dist.Uniform(0.0, theta), obs=y)

    result = methods.run(problem_from_numpyro(model, (y,)), "smc", {"particles": 500, "replicates": 4}, KEY)
    assert result.draws["theta"].min() >= 2.9
    assert result.log_evidence[0] == pytest.approx(np.log((2.9**-4 - 10.0**-4) / 40.0), abs=0.25)


@pytest.mark.slow
def test_draws_come_back_in_the_shapes_of_the_sites_with_what_follows_from_them():
    def model(y):
        mu = numpyro.sample("mu", dist.Normal(0.0, 1.0))
        numpyro.sample("factor", dist.LKJCholesky(2, 2.0))
        effect = numpyro.sample("effect", dist.Normal(0.0, 1.0).expand([3]).to_event(1))
        theta = numpyro.deterministic("theta", mu + 2.0 * effect)
        numpyro.sample("y", dist.Normal(theta, 1.0), obs=y)

    problem = problem_from_numpyro(model, (np.zeros(3),))
    assert problem.to_unconstrained(problem.sample_prior(KEY, 2)).shape == (2, 5)
    prior = {name: np.asarray(column).reshape(2, 4) for name, column in problem.sample_prior(KEY, 8).items()}
    sites = problem.sites(prior)
    assert {name: value.shape for name, value in sites.items()} == {
        "mu": (2, 4),
        "factor": (2, 4, 2, 2),
        "effect": (2, 4, 3),
        "theta": (2, 4, 3),
    }
    np.testing.assert_allclose(sites["theta"][1, 2, 1], prior["mu"][1, 2] + 2.0 * prior["effect[1]"][1, 2])
    np.testing.assert_allclose(np.sum(sites["factor"] ** 2, axis=-1), 1.0)


@pytest.mark.slow
def test_prior_draws_beyond_double_precision_keep_their_share():
    """Half of the draws of a Gamma(0.001, 0.001) are below 1e-308, their logarithm infinite. The closed form is that of
    a normal with a conjugate precision; four replicates of 2000 scatter by 0.1, their mean by 0.05."""
    y, a = np.array([1.2, -0.4, 2.0, -1.1, 0.3, 0.8]), 0.001

    def model(y):
        precision = numpyro.sample("precision", dist.Gamma(a, a))
        numpyro.sample("y", dist.Normal(0.0, precision**-0.5), obs=y)

    result = methods.run(problem_from_numpyro(model, (y,)), "smc", {"particles": 2000, "replicates": 4}, KEY)
    shape, rate = a + 0.5 * len(y), a + 0.5 * np.sum(y**2)
    exact = -0.5 * len(y) * np.log(2.0 * np.pi) + a * np.log(a) - gammaln(a) + gammaln(shape) - shape * np.log(rate)
    assert result.excluded["not_representable"] > 100
    assert result.log_evidence[0] == pytest.approx(exact, abs=0.25)
    assert result.draws["precision"].mean() == pytest.approx(shape / rate, rel=0.1)


def test_what_cannot_be_represented_is_drawn_anew():
    """Of a Gamma(0.0001, 0.0001) 93 % are below 1e-308 (to 0.4 %, the deviation of 4000 tries)."""

    def model(y):
        precision = numpyro.sample("precision", dist.Gamma(1e-4, 1e-4))
        numpyro.sample("y", dist.Normal(0.0, precision**-0.5), obs=y)

    problem = problem_from_numpyro(model, (np.ones(3),))
    config = SmcConfig(particles=300)
    population = sampler.init(KEY, problem, sampler.make_plan(problem, config), config).population
    share = gammainc(1e-4, 1e-4 * np.finfo(float).tiny)
    assert len(np.unique(population.position)) == 300
    assert np.exp(population.log_weights).sum() == pytest.approx(1.0 - share, abs=0.02)


@pytest.mark.slow
def test_a_curve_is_found_under_priors_that_say_nothing():
    """Growth to an asymptote, as of the dugongs of Carlin and Gelfand (1991), whose usual priors keep 2 % of draws
    representable. Asymptote and height are normal given the others, which are summed over a grid. From the prior
    particles end on a straight line (rate 1, and a height of hundreds), 10 nats too low; replicates scatter by 0.1."""
    x = np.linspace(1.0, 30.0, 27) ** 1.1
    y = 2.65 - 0.97 * 0.87**x + 0.1 * np.random.default_rng(1).standard_normal(27)

    def model(x, y):
        asymptote = numpyro.sample("asymptote", dist.Normal(0.0, 1000.0))
        height = numpyro.sample("height", dist.Normal(0.0, 1000.0))
        rate = numpyro.sample("rate", dist.Uniform(0.5, 1.0))
        precision = numpyro.sample("precision", dist.Gamma(1e-4, 1e-4))
        numpyro.sample("y", dist.Normal(asymptote - height * rate**x, precision**-0.5), obs=y)

    slowness, log_precision = np.linspace(np.log(1e-7), np.log(0.5), 500), np.linspace(-4.0, 8.0, 300)
    density = np.empty((500, 300))
    for row, rate in zip(density, 1.0 - np.exp(slowness), strict=True):
        design = np.stack([np.ones(27), -(rate**x)], axis=1)
        for column, log_tau in enumerate(log_precision):
            tau = np.exp(log_tau)
            posterior, pull = tau * design.T @ design + 1e-6 * np.eye(2), tau * design.T @ y
            row[column] = 13.5 * np.log(tau / (2.0 * np.pi)) - 0.5 * tau * y @ y - np.log(1e6)
            row[column] += 0.5 * pull @ np.linalg.solve(posterior, pull) - 0.5 * np.linalg.slogdet(posterior)[1]
    density += gamma.logpdf(np.exp(log_precision), 1e-4, scale=1e4) + log_precision
    density += (slowness + np.log(2.0))[:, None]
    cell = (slowness[1] - slowness[0]) * (log_precision[1] - log_precision[0])
    exact = logsumexp(density) + np.log(cell)
    share = np.exp(density - logsumexp(density)).sum(axis=1)
    result = methods.run(problem_from_numpyro(model, (x, y)), "smc", {}, KEY)
    assert result.log_evidence[0] == pytest.approx(exact, abs=0.25)
    assert result.draws["rate"].mean() == pytest.approx(share @ (1.0 - np.exp(slowness)), abs=0.005)


@pytest.mark.slow
def test_laplace_and_the_bridge_take_a_plain_model():
    """No residuals, but a likelihood that JAX differentiates. A conjugate model is normal: Laplace has its evidence to
    the digit; four replicates of the bridge scatter by 0.06."""
    y = np.array([1.0, 2.5, -0.3, 1.2, 3.0, 0.4])

    def model(y):
        mu = numpyro.sample("mu", dist.Normal(0.7, 1.5).expand([2]).to_event(1))
        numpyro.sample("y", dist.Normal(mu[0] + mu[1] * jnp.arange(6.0), 0.8), obs=y)

    design = np.stack([np.ones(6), np.arange(6.0)], axis=1)
    exact = multivariate_normal.logpdf(y, design @ [0.7, 0.7], 0.64 * np.eye(6) + 2.25 * design @ design.T)
    problem = problem_from_numpyro(model, (y,))
    assert methods.run(problem, "laplace", {}, KEY).log_evidence[0] == pytest.approx(exact, abs=1e-3)
    assert methods.run(problem, "bridge", {}, KEY).log_evidence[0] == pytest.approx(exact, abs=0.15)
    with pytest.raises(InputError, match="no residuals"):
        methods.run(problem, "smc", {"start": "optimum"}, KEY)


def test_other_covariates_are_another_problem():
    first, second = (problem_from_numpyro(schools, kwargs={**SCHOOLS, "sigma": s * SCHOOLS["sigma"]}) for s in (1, 2))
    assert first.fingerprint != second.fingerprint
    assert first.fingerprint == problem_from_numpyro(schools, kwargs=SCHOOLS).fingerprint


def _no_data():
    numpyro.sample("x", dist.Normal(0.0, 1.0))


def _no_parameters():
    numpyro.sample("x", dist.Normal(0.0, 1.0), obs=1.0)


def _improper():
    x = numpyro.sample("x", dist.ImproperUniform(dist.constraints.real, (), ()))
    numpyro.sample("y", dist.Normal(x, 1.0), obs=1.0)


def _masked():
    with numpyro.handlers.mask(mask=False):
        x = numpyro.sample("x", dist.Normal(0.0, 1.0))
    numpyro.sample("y", dist.Normal(x, 1.0), obs=1.0)


def _endless():
    x = numpyro.sample("x", dist.Uniform(-jnp.inf, jnp.inf))
    numpyro.sample("y", dist.Normal(x, 1.0), obs=1.0)


def _optimised():
    x = numpyro.sample("x", dist.Normal(numpyro.param("centre", 0.0), 1.0))
    numpyro.sample("y", dist.Normal(x, 1.0), obs=1.0)


def _subsampled():
    x = numpyro.sample("x", dist.Normal(0.0, 1.0))
    with numpyro.plate("data", 10, subsample_size=5) as index:
        numpyro.sample("y", dist.Normal(x, 1.0), obs=jnp.arange(10.0)[index])


def _not_numbers():
    x = numpyro.sample("x", dist.Normal(0.0, 1.0))
    numpyro.sample("y", dist.Normal(x, 1.0), obs=np.array([1.0, np.nan, np.inf]))


def _fixed():
    x = numpyro.sample("x", dist.Delta(jnp.zeros(2)).to_event(1))
    numpyro.sample("y", dist.Normal(x[0], 1.0), obs=1.0)


def _discrete():
    x = numpyro.sample("x", dist.Poisson(3.0))
    numpyro.sample("y", dist.Normal(x, 1.0), obs=1.0)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (_no_data, "observes nothing"),
        (_no_parameters, "no parameters"),
        (_improper, "prior of site 'x' is improper"),
        (_masked, "prior of site 'x' is improper"),
        (_endless, "prior of site 'x' is improper"),
        (_optimised, "'centre' is a numpyro.param"),
        (_subsampled, "'data' takes random subsamples"),
        (_not_numbers, "2 values of the observed site 'y' are not finite numbers"),
        (_fixed, "'x' is no parameter"),
        (_discrete, "discrete"),
    ],
)
def test_models_that_cannot_be_sampled_are_refused(model, words):
    with pytest.raises(InputError, match=words):
        problem_from_numpyro(model)


def test_a_likelihood_without_second_derivatives_is_not_climbed():
    def model(y):
        rate = numpyro.sample("rate", dist.LogNormal(0.0, 1.0))
        power = jax.lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * rate), (0, 1.0))[1]
        numpyro.sample("y", dist.Normal(power, 1.0), obs=y)

    problem = problem_from_numpyro(model, (np.array([0.3, 0.4]),))
    with pytest.raises(InputError, match=r"cannot differentiate this likelihood twice: .*while_loop"):
        methods.run(problem, "laplace", {}, KEY)
    rates = methods.run(problem, "smc", {"particles": 200}, KEY).draws["rate"]
    grid = np.linspace(0.001, 3.0, 3000)
    density = np.exp(-0.5 * np.log(grid) ** 2 - np.sum((np.array([[0.3], [0.4]]) - grid**3) ** 2, axis=0) / 2.0) / grid
    assert rates.mean() == pytest.approx(grid @ density / density.sum(), abs=0.06)


def test_a_proper_prior_may_have_draws_too_large_for_a_number():
    def model(y):
        variance = numpyro.sample("variance", dist.InverseGamma(1e-3, 1e-3))
        numpyro.sample("y", dist.Normal(0.0, jnp.sqrt(variance)), obs=y)

    problem = problem_from_numpyro(model, (np.array([0.3, -0.4]),))
    assert not np.isfinite(problem.sample_prior(KEY, 100)["variance"]).all()


def test_a_circle_has_no_ends():
    def model(y):
        angle = numpyro.sample("angle", dist.VonMises(np.pi, 0.1))
        numpyro.sample("y", dist.VonMises(angle, 4.0), obs=y)

    assert problem_from_numpyro(model, (3.1,)).bounds["angle"] == (-np.inf, np.inf)


def linear_effects(y, design):
    """Many parameters, all normal: posterior and evidence in closed form."""
    effect = numpyro.sample("effect", dist.Normal(0.5, 2.0).expand([design.shape[1]]).to_event(1))
    numpyro.sample("y", dist.Normal(design @ effect, 0.7), obs=y)


@pytest.mark.slow
def test_many_parameters_are_moved_along_gradients():
    """24 of them. Two replicates of 500 scatter by 0.5 (measured), their mean by 0.35; means of 1000 draws by 0.03
    deviations if independent, by twice that here, and the largest of 24 by 0.16; deviations by 3 %."""
    rng = np.random.default_rng(2)
    design = rng.normal(size=(40, 24)) @ (np.eye(24) + 0.3 * rng.normal(size=(24, 24)))
    y = design @ rng.normal(0.5, 1.5, 24) + 0.7 * rng.normal(size=40)
    problem = problem_from_numpyro(linear_effects, (y, design))
    result = methods.run(problem, "smc", {"particles": 500, "replicates": 2}, KEY)
    marginal = 0.49 * np.eye(40) + 4.0 * design @ design.T
    exact = multivariate_normal.logpdf(y, design @ np.full(24, 0.5), marginal)
    covariance = np.linalg.inv(design.T @ design / 0.49 + 0.25 * np.eye(24))
    mean = covariance @ (design.T @ y / 0.49 + 0.25 * np.full(24, 0.5))
    draws = np.stack([result.draws[name].ravel() for name in problem.names], axis=1)
    sd = np.sqrt(np.diag(covariance))
    assert result.log_evidence[0] == pytest.approx(exact, abs=1.5)
    assert np.abs((draws.mean(axis=0) - mean) / sd).max() < 0.25
    np.testing.assert_allclose(draws.std(axis=0), sd, rtol=0.15)
    assert all(row["acceptance"] > 0.5 for row in result.trace if row.get("final"))


@pytest.mark.slow
def test_the_path_is_differentiated_between_prior_and_posterior():
    problem = problem_from_numpyro(schools, kwargs=SCHOOLS)
    u = problem.to_unconstrained(problem.sample_prior(KEY, 1))[0]
    shares = jnp.asarray([1.0, 1.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    rows, _ = problem.row_log_likelihood(problem.from_unconstrained(u[None]), 8)
    expected = problem.log_prior(u[None])[0] + rows[0, 0] + rows[0, 1] + 0.3 * rows[0, 2]
    assert float(problem.path_density(u, shares)) == pytest.approx(float(expected))
    assert np.isfinite(jax.grad(problem.path_density)(u, shares)).all()


def test_gradients_are_refused_where_there_are_none():
    with pytest.raises(InputError, match="follows gradients"):
        methods.run(LinearGaussian(), "smc", {"kernel": "hamiltonian"}, KEY)
