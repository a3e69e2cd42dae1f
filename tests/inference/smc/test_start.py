"""Posteriors thousands of times sharper than the prior, under a budget that a way from the prior would exhaust."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from rfdropo_bayes.cautions import Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.modes import mode_search as laplace
from rfdropo_bayes.inference.modes.optimisation import Laplace, optimisation_cost
from rfdropo_bayes.inference.smc import sampler
from rfdropo_bayes.inference.smc import start as starts
from rfdropo_bayes.inference.smc.bridge import ModeMixture
from rfdropo_bayes.inference.smc.sampler import SmcConfig
from rfdropo_bayes.inference.smc.start import Way, way_from_prior

from ..toys import Decay, LinearGaussian, Ratio, Spring, TwoModes, Washboard

KEY = jax.random.key(31)


def sharp(ridge: float = 1e-3) -> LinearGaussian:
    """Six parameters known to 1e-4 of their prior, two of them through a ridge a thousand times longer than wide."""
    problem = LinearGaussian(n_rows=40, d=6, noise=1e-4)
    problem.design[:, 1] = problem.design[:, 0] + ridge * problem.design[:, 1]
    rng = np.random.default_rng(5)
    truth = problem.mean + problem.sd * rng.normal(size=6)
    problem.data = problem.design @ truth + problem.noise * rng.normal(size=40)
    return problem


def log_evidence(problem: LinearGaussian) -> float:
    """Closed form by the posterior's own normalisation, which stays accurate for a near-singular marginal."""
    mean, covariance = problem.posterior()
    u = mean[None]
    density = float(problem.log_prior(u)[0]) + float(
        np.sum(problem.row_log_likelihood(problem.from_unconstrained(u), problem.n_rows)[0])
    )
    return density + 3.0 * np.log(2.0 * np.pi) + 0.5 * np.linalg.slogdet(covariance)[1]


@pytest.fixture(scope="module")
def fitted():
    problem = sharp()
    return problem, methods.run(problem, "smc", {"rollouts": 8000, "blocks": 3}, KEY)


@pytest.mark.slow
def test_a_sharp_ridge_is_sampled_within_its_budget(fitted):
    """Evidence: replicates of 100 scatter by 0.1, their mean by 0.05. Means of 400 draws: by 0.05 deviations if
    independent, by about twice that after resampling; thresholds are four times that."""
    problem, result = fitted
    assert result.details["algorithm"] == "smc_from_optima"
    assert result.rollouts <= 8000
    assert result.log_evidence[0] == pytest.approx(log_evidence(problem), abs=0.25)
    assert result.log_evidence[1] < 0.4
    mean, covariance = problem.posterior()
    draws = np.stack([result.draws[name].ravel() for name in problem.names], axis=1)
    assert np.abs((draws.mean(axis=0) - mean) / np.sqrt(np.diag(covariance))).max() < 0.4
    np.testing.assert_allclose(draws.std(axis=0), np.sqrt(np.diag(covariance)), rtol=0.25)
    assert abs(np.corrcoef(draws[:, 0], draws[:, 1])[0, 1]) > 0.999
    assert not result.cautions


@pytest.mark.slow
def test_from_the_prior_the_same_budget_is_exhausted():
    """Why the start is chosen at all: the leap at the end, which the report must then name."""
    result = methods.run(sharp(), "smc", {"rollouts": 8000, "blocks": 3, "start": "prior"}, KEY)
    assert Code.BUDGET_SPENT in [caution.code for caution in result.cautions]


@pytest.mark.slow
def test_a_broad_posterior_is_still_reached_from_the_prior():
    result = methods.run(LinearGaussian(), "smc", {"rollouts": 60000, "blocks": 2}, KEY)
    assert result.details["algorithm"] == "smc_from_prior"
    assert result.rollouts <= 60000


@pytest.mark.slow
def test_both_modes_survive_a_start_at_the_optima():
    """A share of 0.61 from 4 replicates of about 100: scatter 0.05."""
    problem = TwoModes()
    result = methods.run(problem, "smc", {"rollouts": 10000, "blocks": 1, "start": "optimum"}, KEY)
    evidence, share = problem.mode_evidence()
    assert result.log_evidence[0] == pytest.approx(evidence, abs=0.25)
    assert np.mean(result.draws["x0"] > 0) == pytest.approx(share, abs=0.2)


@pytest.mark.slow
def test_a_ridge_between_two_bounds_is_filled_from_end_to_end():
    """The optimum lies at one end of the ridge, and the curvature there knows nothing of its length. A distribution
    function of 400 draws, of which a quarter count: its mean scatters by 0.03, its deviation by 0.02."""
    problem = Ratio()
    result = methods.run(problem, "smc", {"rollouts": 10000, "start": "optimum", "blocks": 1}, KEY)
    place, evidence = problem.along_the_ridge(result.draws["mass"].ravel())
    assert place.mean() == pytest.approx(0.5, abs=0.12)
    assert place.std() == pytest.approx(12.0**-0.5, abs=0.08)
    assert result.log_evidence[0] == pytest.approx(evidence, abs=0.3)


def test_a_small_budget_finishes_one_optimisation_rather_than_beginning_four():
    problem = LinearGaussian(d=6)
    small, large = (starts._optimising(problem, SmcConfig(rollouts=budget)) for budget in (3000.0, 40000.0))
    assert (small.starts, large.starts) == (1, 4)
    assert (small.pilot_particles, large.pilot_particles) == (0, 128)
    assert small.rollouts == 750.0


@pytest.mark.slow
def test_a_pilot_run_finds_the_highest_of_many_modes():
    """Optimisations from the best of starts_of_draws draws end eight nats or more below it. The evidence of 2
    replicates of about 150 scatters by 0.1.
    """
    problem = Washboard()
    near = methods.run(problem, "laplace", {"prior_draws": 64, "blocks": 2}, KEY)
    result = methods.run(problem, "smc", {"rollouts": 12000, "start": "optimum", "blocks": 2}, KEY)
    assert near.log_evidence[0] < problem.log_evidence() - 7.0
    assert result.log_evidence[0] == pytest.approx(problem.log_evidence(), abs=0.4)
    for name, centre in zip(problem.names, problem.centre, strict=True):
        assert np.mean(result.draws[name]) == pytest.approx(centre, abs=0.05)
    assert result.rollouts <= 12000


def test_optimisations_expect_half_of_their_number_at_the_next_horizon():
    """Four optimisations at a quarter of the rows, two at half, one at all: each of the first gets a twelfth."""
    optimisations = laplace.begin(np.zeros((4, 3)), np.zeros(4), Ledger(), 0.0)
    config = laplace.LaplaceConfig(rollouts=1200.0, max_steps=10**6)
    steps = laplace._affordable_steps(40, config, optimisations, (10, 20, 40), 0)
    assert steps == int(1200.0 / 3.0 / 4.0 * 4.0 / optimisation_cost(3, 0)[1])


@pytest.mark.slow
@pytest.mark.parametrize("budget", [2500, 4000])
def test_the_budget_covers_optimisations_sampler_and_scores(budget):
    """The whole is within the budget, whatever the parts take; scores are left out before it is exceeded."""
    problem = LinearGaussian(n_rows=40, d=6, noise=1e-2)
    result = methods.run(problem, "smc", {"rollouts": budget, "blocks": 2, "start": "optimum"}, KEY)
    assert result.rollouts <= budget
    assert sum(n * h for n, h in problem.calls) / problem.n_rows <= budget


class Deaf(LinearGaussian):
    """Loses every rollout of the first look at a quarter of the rows, which would give the starts."""

    heard = False

    def row_log_likelihood(self, values, horizon):
        rows, status = super().row_log_likelihood(values, horizon)
        if horizon == 10 and not self.heard:
            self.heard = True
            return np.full(np.shape(rows), -np.inf), np.ones(np.shape(status), dtype=int)
        return rows, status


def test_a_look_in_vain_is_part_of_the_budget():
    """The sampler goes on from the prior with what is left of it."""
    problem = Deaf(n_rows=40, d=2, noise=1e-2)
    result = methods.run(problem, "smc", {"rollouts": 2500.0, "blocks": 2}, KEY)
    assert problem.heard
    assert sum(n * h for n, h in problem.calls) / problem.n_rows <= result.rollouts * (1.0 + 1e-9)
    assert result.rollouts <= 2500.0


def test_a_start_at_the_optima_needs_residuals():
    with pytest.raises(InputError, match="no residuals"):
        methods.run(Spring(), "smc", {"start": "optimum"}, KEY)


def test_the_estimated_way_grows_with_the_logarithm_of_the_sharpness():
    ways = []
    for noise in (1e-1, 1e-3, 1e-5):
        problem = LinearGaussian(n_rows=40, noise=noise)
        mean, covariance = problem.posterior()
        ways.append(way_from_prior(problem, Laplace(mean, covariance, 0.0), (10, 20, 40), KEY))
        _, prior = np.linalg.slogdet(np.diag(problem.sd**2))
        lost = 0.5 * (prior - np.linalg.slogdet(covariance)[1])
        assert ways[-1].information == pytest.approx(lost, abs=0.2)
    steps = np.diff([way.stages for way in ways])
    assert steps[0] == pytest.approx(steps[1], rel=0.15)
    assert ways[0].rollouts < ways[1].rollouts < ways[2].rollouts


def test_the_mixture_is_a_density_that_its_draws_have():
    """Its integral over a grid is 1; 20000 draws have its mean within five standard errors."""
    problem = LinearGaussian(d=1)
    modes = [Laplace(np.array([c]), np.array([[v]]), e) for c, v, e in ((-2.0, 0.04, 0.0), (1.0, 0.25, 1.0))]
    mixture = ModeMixture(problem, modes, 1.5, 5.0, 0.2)
    grid = np.linspace(-80.0, 80.0, 400001)[:, None]
    density = np.exp(mixture.log_density(grid))
    assert np.trapezoid(density, grid[:, 0]) == pytest.approx(1.0, abs=1e-4)
    draws = mixture.sample(KEY, 20000)[:, 0]
    mean = np.trapezoid(density * grid[:, 0], grid[:, 0])
    assert draws.mean() == pytest.approx(mean, abs=5.0 * draws.std() / np.sqrt(20000))
    assert np.mean(draws < -1.0) == pytest.approx(
        np.trapezoid(density[grid[:, 0] < -1.0], grid[grid[:, 0] < -1.0, 0]), abs=0.02
    )


@pytest.mark.slow
def test_optimisations_keep_their_budget():
    problem = Decay(n_rows=40)
    result = methods.run(problem, "laplace", {"rollouts": 120, "prior_draws": 16}, KEY)
    assert result.trace[-1]["rollouts"] <= 120  # normal approximations of the optima come on top
    free = methods.run(Decay(n_rows=40), "laplace", {"prior_draws": 16}, KEY)
    assert free.rollouts > result.rollouts


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, (4, 111)),  # of 45 rollouts a particle, the margin included
        ({"particles": 200}, (2, 200)),
        ({"particles": 1000}, (1, 1000)),
        ({"replicates": 1}, (1, None)),
        ({"replicates": 3, "particles": 50}, (3, 50)),
    ],
)
def test_as_many_replicates_start_at_the_prior_as_can_go_all_the_way(options, expected):
    config = starts._several(Way(stages=10.0, rollouts=15.0, information=5.0), SmcConfig(**options), 20000.0)
    assert (config.replicates, config.particles) == expected
    assert config.rollouts == 20000.0


def test_a_budget_decides_on_replicates_and_without_one_there_is_one():
    """20 rollouts a particle and 100 particles each, or what a look at every row costs, if that is more."""
    assert sampler.decided(30, SmcConfig(rollouts=1000.0)).chains == 1
    assert sampler.decided(30, SmcConfig(rollouts=5000.0)).chains == 2
    assert sampler.decided(30, SmcConfig(rollouts=1e5)).chains == 4
    assert sampler.decided(30, SmcConfig()).chains == 1
