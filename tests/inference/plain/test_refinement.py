"""Plain models in two passes, against closed forms: priors far wider than the posterior, and shapes no fit covers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy.stats import multivariate_normal, multivariate_t

from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.modes.climb import Laplace
from rfdropo_bayes.inference.plain import refinement
from rfdropo_bayes.inference.plain.plain_problem import CentredProblem, centred, problem_from_numpyro
from rfdropo_bayes.inference.plain.refinement import _clusters
from rfdropo_bayes.inference.smc.bridge import ModeMixture

from .test_plain_problem import SCHOOLS, schools_by_quadrature

KEY = jax.random.key(8)
SD, NOISE = 100.0, 0.5


def regression(design, y):
    effect = numpyro.sample("effect", dist.Normal(0.3, SD).expand([design.shape[1]]).to_event(1))
    numpyro.sample("y", dist.Normal(design @ effect, NOISE), obs=y)


def wide_data(d, n):
    rng = np.random.default_rng(4)
    design = rng.normal(size=(n, d)) @ (np.eye(d) + 0.4 * rng.normal(size=(d, d)))
    return design, design @ rng.normal(0.0, 2.0, d) + NOISE * rng.normal(size=n)


def closed_form(design, y):
    """Log evidence, and mean and covariance of the posterior."""
    d = design.shape[1]
    precision = design.T @ design / NOISE**2 + np.eye(d) / SD**2
    rest, score = y - design @ np.full(d, 0.3), design.T @ (y - design @ np.full(d, 0.3)) / NOISE**2
    away = np.linalg.solve(precision, score)
    logs = len(y) * np.log(2.0 * np.pi * NOISE**2) + d * np.log(SD**2) + np.linalg.slogdet(precision)[1]
    return -0.5 * (logs + rest @ rest / NOISE**2 - score @ away), 0.3 + away, np.linalg.inv(precision)


@pytest.mark.slow
def test_priors_a_thousand_times_wider_than_the_posterior():
    """Eight coefficients. The first pass scatters by half a nat, the second by 0.05 or less (measured); means of 1200
    draws by 0.03 deviations, the largest of eight by 0.08, deviations by 2 %. One replicate is none: there are four."""
    design, y = wide_data(8, 60)
    problem = problem_from_numpyro(regression, (design, y))
    result = methods.run(problem, "smc", {"particles": 300}, KEY)
    assert result.draws["effect[0]"].shape == (4, 300)
    exact, mean, covariance = closed_form(design, y)
    value, sd = result.log_evidence
    assert sd <= 0.15
    assert abs(value - exact) < 3.0 * sd
    assert result.details["log_evidence_first_pass"][1] > 2.0 * sd
    assert result.prefix_log_evidence[-1] == value
    draws = np.stack([result.draws[name].ravel() for name in problem.names], axis=1)
    width = np.sqrt(np.diag(covariance))
    assert np.abs((draws.mean(axis=0) - mean) / width).max() < 0.15
    np.testing.assert_allclose(draws.std(axis=0), width, rtol=0.12)
    values = {name: jnp.asarray(result.draws[name][1, :5]) for name in problem.names}
    np.testing.assert_allclose(result.log_likelihood[1, :5], problem.row_log_likelihood(values, 60)[0], rtol=1e-9)


@pytest.mark.slow
def test_many_rows_come_in_together(monkeypatch):
    """Replicates scatter by 0.03 (measured). The evidence of prefixes is that of the whole alone."""
    monkeypatch.setattr(refinement, "MOST_ROWS", 30)
    design, y = wide_data(2, 40)
    result = methods.run(problem_from_numpyro(regression, (design, y)), "smc", {"particles": 300}, KEY)
    exact, mean, _ = closed_form(design, y)
    assert result.log_evidence[0] == pytest.approx(exact, abs=0.15)
    assert np.isnan(result.prefix_log_evidence[:-1]).all()
    assert result.log_likelihood.shape == (4, 300, 40)
    assert len(result.block_scores) == 1
    assert result.draws["effect[1]"].mean() == pytest.approx(mean[1], abs=0.03)


def test_covariates_of_unlike_sizes_keep_their_evidence():
    """A slope over years that are not centred, beside its intercept: their covariance has eigenvalues 1e-11 apart.
    Replicates scatter by 0.01 to 0.03 (measured)."""
    rng = np.random.default_rng(5)
    design = np.column_stack([np.ones(60), 1952.0 + np.arange(60.0)])
    scale = np.array([100.0, 0.1])

    def line(design, y):
        effect = numpyro.sample("effect", dist.Normal(0.0, scale).to_event(1))
        numpyro.sample("y", dist.Normal(design @ effect, NOISE), obs=y)

    y = design @ np.array([-30.0, 0.02]) + NOISE * rng.normal(size=60)
    spread = NOISE**2 * np.eye(60) + (design * scale**2) @ design.T
    rows = [5, 20, 40, 60]
    exact = [multivariate_normal.logpdf(y[:h], cov=spread[:h, :h], allow_singular=False) for h in rows]
    result = methods.run(problem_from_numpyro(line, (design, y)), "smc", {"particles": 300}, KEY)
    np.testing.assert_allclose(result.prefix_log_evidence[np.array(rows) - 1], exact, atol=0.15)
    assert result.log_evidence[1] < 0.1


def test_a_student_t_is_normalised_whatever_the_sizes_of_its_coordinates():
    """Against scipy's in coordinates of one size, from where it differs by the Jacobian."""
    rng = np.random.default_rng(6)
    size = 10.0 ** np.array([-7.0, 0.0, 5.0])
    covariance = np.cov(rng.normal(size=(10, 3)).T)
    problem = problem_from_numpyro(regression, wide_data(3, 4))
    z = rng.normal(size=(20, 3))
    mixture = ModeMixture(problem, [Laplace(np.zeros(3), covariance * np.outer(size, size), 0.0)], 1.2, 5.0, 0.0)
    expected = multivariate_t.logpdf(z, np.zeros(3), 1.44 * covariance, df=5.0) - np.log(size).sum()
    np.testing.assert_allclose(mixture.log_density(z * size), expected, rtol=1e-9)


def test_draws_of_a_mixture_say_nothing_by_their_order():
    """Halves of the particles move by each other. Of 4000 draws 1000 are of the first mode, in either half 500 +- 14 if
    the order is random: 6 deviations."""
    problem = problem_from_numpyro(regression, wide_data(2, 4))
    modes = [Laplace(np.full(2, place), np.eye(2), weight) for place, weight in ((-50.0, 0.0), (50.0, np.log(3.0)))]
    draws = ModeMixture(problem, modes, 1.1, 5.0, 0.0).sample(KEY, 4000)
    assert abs(int((draws[:, 0] < 0.0).sum()) - 1000) <= 1
    assert abs(int((draws[:2000, 0] < 0.0).sum()) - 500) < 6.0 * 14.0


@pytest.mark.parametrize(("count", "width"), [(1, 1.0), (2, 0.01), (3, 0.2), (12, 0.05)])
def test_clusters_are_counted(count, width):
    """Normals far apart, one of them of another width; copies are no cluster."""
    rng = np.random.default_rng(7)
    member = rng.integers(count, size=3000)
    centres = 8.0 * np.column_stack([np.cos(np.arange(count)), np.sin(1.3 * np.arange(count)), np.arange(count)])
    u = centres[member] + np.where(member == 0, width, 1.0)[:, None] * rng.normal(size=(3000, 3))
    found = _clusters(np.concatenate([u, np.repeat(u[:1], 200, axis=0)]), 0)
    assert len(found) == count
    if count > 1:
        nearest = min(found, key=lambda mode: np.abs(mode.mean - centres[0]).max())
        np.testing.assert_allclose(np.sqrt(np.diag(nearest.covariance)), width, rtol=0.2)
        share = np.exp(nearest.log_evidence)
        assert share == pytest.approx(np.mean(member == 0), abs=0.01)


def two_places(y):
    """The sign of one parameter is not known, and the prior is wide: two modes of unequal mass."""
    place = numpyro.sample("place", dist.Normal(20.0, 50.0).expand([2]).to_event(1))
    numpyro.sample("y", dist.Normal(jnp.stack([jnp.abs(place[0]), place[1]]), 0.2), obs=y)


@pytest.mark.slow
def test_both_modes_are_kept_by_the_second_pass():
    """Replicates of 500 scatter in the share of a mode by 0.04, their mean by 0.02."""
    y = np.array([15.0, -3.0])
    problem = problem_from_numpyro(two_places, (y,))
    result = methods.run(problem, "smc", {"particles": 500, "replicates": 4}, KEY)
    spread = np.hypot(50.0, 0.2)
    plus, minus, rest = dist.Normal(20.0, spread).log_prob(np.array([15.0, -15.0, -3.0]))
    exact = float(np.logaddexp(plus, minus) + rest)
    assert result.log_evidence[1] <= 0.15
    assert result.log_evidence[0] == pytest.approx(exact, abs=0.2)
    assert np.mean(result.draws["place[0]"] > 0.0) == pytest.approx(1.0 / (1.0 + np.exp(minus - plus)), abs=0.09)


@pytest.mark.slow
def test_a_start_at_the_prior_is_one_pass():
    problem = problem_from_numpyro(regression, wide_data(1, 5))
    result = methods.run(problem, "smc", {"particles": 50, "start": "prior"}, KEY)
    assert result.draws["effect[0]"].shape == (1, 50)
    assert "log_evidence_first_pass" not in result.details


def hierarchy(y, spread):
    """Effects written centred, and coefficients that belong to no hierarchy."""
    mu = numpyro.sample("mu", dist.Normal(0.0, 5.0))
    tau = numpyro.sample("tau", dist.HalfCauchy(5.0))
    effect = numpyro.sample("effect", dist.Normal(mu, tau).expand([len(y)]).to_event(1))
    numpyro.sample("y", dist.Normal(effect, spread), obs=y)


@pytest.mark.slow
def test_other_coordinates_are_the_same_density():
    """The Jacobian by differentiation, and the way there and back."""
    problem = problem_from_numpyro(hierarchy, (SCHOOLS["y"], SCHOOLS["sigma"]))
    share = np.array([1.0, 1.0, *np.linspace(0.0, 0.9, 8)])
    other = CentredProblem(problem, share, 1)
    values = problem.sample_prior(KEY, 3)
    u, v = problem.to_unconstrained(values), other.to_unconstrained(values)
    assert np.abs(np.asarray(u - v)).max() > 0.1
    np.testing.assert_allclose(other.from_unconstrained(v)["effect[7]"], values["effect[7]"], rtol=1e-9)
    slope = np.linalg.slogdet(jax.vmap(jax.jacfwd(other._own))(v))[1]
    np.testing.assert_allclose(other.log_prior(v), problem.log_prior(u) + slope, rtol=1e-9)
    whole = jnp.ones(8)
    np.testing.assert_allclose(other.path_density(v[1], whole), problem.path_density(u[1], whole) + slope[1], rtol=1e-9)


@pytest.mark.slow
def test_effects_are_centred_as_far_as_the_data_speak_of_them():
    """A normal likelihood of deviation 0.01 knows an effect better than a spread near 3 does, one of 1000 does not."""
    spread = np.array([0.01, 1000.0, 3.0])
    problem = problem_from_numpyro(hierarchy, (np.array([4.0, 0.0, -2.0]), spread))
    rng = np.random.default_rng(3)
    u = np.column_stack([rng.normal(size=50), np.log(3.0) + 0.1 * rng.normal(size=50), rng.normal(size=(50, 3))])
    share = np.asarray(centred(problem, u).share)
    np.testing.assert_allclose(share, [1.0, 1.0, 1.0, 0.0, 0.5], atol=0.02)
    flat = problem_from_numpyro(regression, wide_data(2, 5))
    assert centred(flat, rng.normal(size=(50, 2))) is flat


def test_effects_that_are_normal_in_logarithms_have_a_centre_there():
    def model(y):
        mu = numpyro.sample("mu", dist.Normal(0.0, 1.0))
        tau = numpyro.sample("tau", dist.HalfNormal(1.0))
        rate = numpyro.sample("rate", dist.LogNormal(mu, tau).expand([3]).to_event(1))
        numpyro.sample("y", dist.Poisson(rate), obs=y)

    problem = problem_from_numpyro(model, (np.array([1, 2, 5]),))
    values = {"mu": 0.7, "tau": 0.4} | {f"rate[{j}]": 2.0 for j in range(3)}
    u = problem.to_unconstrained({name: jnp.array([value]) for name, value in values.items()})[0]
    location, scale = (dict(zip(problem.names, np.asarray(part), strict=True)) for part in problem.location_scale(u))
    assert location["rate[1]"] == pytest.approx(0.7)
    assert scale["rate[1]"] == pytest.approx(0.4)
    assert (location["tau"], scale["tau"]) == (0.0, 1.0)


@pytest.mark.slow
def test_a_series_in_time_is_no_hierarchy():
    def walk(y):
        x = 0.0
        for t in range(12):
            x = numpyro.sample(f"x{t}", dist.Normal(x, 1.0))
        numpyro.sample("y", dist.Normal(x, 1.0), obs=y)

    problem = problem_from_numpyro(walk, (np.array([1.0]),))
    assert centred(problem, np.random.default_rng(1).normal(size=(20, 12))) is problem


@pytest.mark.slow
def test_centred_schools_agree_with_quadrature():
    """Written centred they are a funnel. Replicates scatter by 0.01 to 0.05 nat (two seeds), for which 0.15 is allowed,
    their mean by half of that; means of 4000 draws by 0.02 deviations, which are 3.3 for mu and about 3 for tau."""
    problem = problem_from_numpyro(hierarchy, (SCHOOLS["y"], SCHOOLS["sigma"]))
    result = methods.run(problem, "smc", {"particles": 1000, "replicates": 4}, KEY)
    evidence, (mean, sd), tau = schools_by_quadrature()
    assert result.log_evidence[1] < 0.15
    assert result.log_evidence[0] == pytest.approx(evidence, abs=0.06)
    assert result.draws["mu"].mean() == pytest.approx(mean, abs=0.33)
    assert result.draws["mu"].std() == pytest.approx(sd, rel=0.1)
    assert result.draws["tau"].mean() == pytest.approx(tau, abs=0.3)
    assert result.cautions == []
