"""Levenberg-Marquardt, Laplace and the bridge against closed forms and against SMC."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from rfdropo_bayes.cautions import Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.modes import mode_search as laplace
from rfdropo_bayes.inference.modes.mixture import alternatives, draw_mixture
from rfdropo_bayes.inference.modes.mode_search import LaplaceConfig
from rfdropo_bayes.inference.modes.optimisation import FLAT_STEPS, Laplace, maximise
from rfdropo_bayes.inference.modes.reweighting import FIRST
from rfdropo_bayes.inference.modes.targets import Target, make_target, prior_derivatives
from rfdropo_bayes.inference.smc import bridge, sampler
from rfdropo_bayes.inference.smc.sampler import SmcConfig

from ..toys import Decay, LinearGaussian, Spring, Touched, TwoModes

KEY = jax.random.key(4)


def test_a_linear_model_has_its_closed_form_posterior_and_evidence():
    problem = LinearGaussian(n_rows=20, d=4)
    result = laplace.run(problem, LaplaceConfig(blocks=2), KEY)
    mean, covariance = problem.posterior()
    sd = np.sqrt(np.diag(covariance))
    assert result.log_evidence[0] == pytest.approx(problem.prefix_log_evidence()[-1], abs=1e-3)
    np.testing.assert_allclose(result.details["covariance_unconstrained"], covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_less(np.abs(np.array(list(result.optimum.values())) - mean), 0.02 * sd)
    draws = np.stack([result.draws[name].ravel() for name in problem.names], axis=1)
    # 2000 independent draws: 5 standard errors of a mean are 0.11 sd, of a deviation 8 %.
    np.testing.assert_array_less(np.abs(draws.mean(axis=0) - mean), 0.11 * sd)
    np.testing.assert_allclose(draws.std(axis=0), sd, rtol=0.08)
    # Two screenings, the optimisations, and the draws that show the normal to fit.
    assert result.rollouts < 64 * 1.5 + 200 + FIRST


@pytest.mark.parametrize("seed", range(5))
def test_what_a_prefix_does_not_tell_keeps_its_prior_spread(seed: int):
    """64 draws miss the basin of the truth, 11 % of them each, less than once in a thousand times."""
    found = laplace.run(Touched(), LaplaceConfig(blocks=2), jax.random.key(seed))
    assert found.optimum["x1"] == pytest.approx(2.2, abs=0.02)
    assert found.optimum["x0"] == pytest.approx(0.7, abs=0.1)


def test_a_noise_parameter_is_found_and_gets_its_full_information():
    """The information of n residuals about a log deviation is 2 n; J'J alone would say n."""
    problem = Decay(n_rows=200)
    result = laplace.run(problem, LaplaceConfig(starts=2, blocks=1), KEY)
    assert result.details["noise_coordinates"] == [2]
    assert result.details["covariance_unconstrained"][2][2] == pytest.approx(1.0 / (2.0 * 200 + 1.0), rel=0.03)
    for name, truth in problem.truth.items():
        draws = result.draws[name]
        assert abs(draws.mean() - truth) < 4.0 * draws.std()


def test_jacobians_are_the_derivatives():
    u, problem = np.array([0.3, -0.2, -2.5]), Decay()
    amplitude, rate, noise = np.exp(u)
    left, fitted = make_target(problem, 60, Ledger(), u, prior_derivatives(problem)).linearise(u)
    fit = amplitude * np.exp(-rate * problem.time)
    exact = np.stack([-fit / noise, rate * problem.time * fit / noise, -left], axis=1)
    np.testing.assert_allclose(left, (problem.data - fit) / noise)
    np.testing.assert_allclose(fitted, exact, atol=1e-6 * np.abs(exact).max())


class RoundedRidge(LinearGaussian):
    """Data that say 2800 times as much of a sum as of a difference, and residuals rounded to 1e-4."""

    def __init__(self):
        super().__init__(n_rows=400, d=2)
        along = np.sin(np.arange(400.0))
        self.design = np.stack([100.0 + 0.05 * along, 100.0 - 0.05 * along], axis=1)
        self.noise = np.ones(400)
        self.data = self.design @ (self.mean + np.array([0.4, -0.3])) + np.cos(3.0 * np.arange(400.0))

    def residuals(self, values, horizon):
        return np.round(super().residuals(values, horizon), 4)


def test_rounding_does_not_shorten_a_ridge():
    """Differences over 1e-4 have rounding of 0.2 in each of 400 rows: with them the variance was a sixth of this."""
    problem = RoundedRidge()
    result = laplace.run(problem, LaplaceConfig(blocks=1, starts=2), KEY)
    mean, covariance = problem.posterior()
    np.testing.assert_allclose(result.details["covariance_unconstrained"], covariance, rtol=0.02)
    found = np.array(list(result.optimum.values()))
    assert (found - mean) @ np.linalg.solve(covariance, found - mean) < 0.05


@pytest.mark.slow
def test_a_nonlinear_model_agrees_with_smc():
    """Both estimate means to about 0.03 sd; Laplace's mode is off by O(1 / n), most for the noise (0.3 sd)."""
    problem = Decay()
    result = laplace.run(problem, LaplaceConfig(), KEY)
    sampled = sampler.run(problem, SmcConfig(particles=1000, replicates=2), KEY)
    for name in problem.names:
        reference = sampled.draws[name]
        assert abs(result.draws[name].mean() - reference.mean()) < 0.4 * reference.std()
        assert result.draws[name].std() == pytest.approx(reference.std(), rel=0.15)
    assert result.log_evidence[0] == pytest.approx(sampled.log_evidence[0], abs=0.35)


def test_the_bridge_has_the_evidence_at_a_fraction_of_the_rollouts():
    """4 replicates of 500 scatter by 0.06 nat: their mean is within 0.12 of the truth but for 1 in 15000 seeds."""
    problem = LinearGaussian(n_rows=20, d=4)
    found = laplace.find_modes(problem, LaplaceConfig(), KEY)
    result = bridge.sample_from_modes(problem, SmcConfig(particles=500, replicates=4, blocks=1), found, KEY)
    exact = problem.prefix_log_evidence()[-1]
    assert result.log_evidence[0] == pytest.approx(exact, abs=0.12)
    assert result.log_evidence[1] < 0.15
    assert result.rollouts < 4 * 500 * 8
    mean, covariance = problem.posterior()
    draws = np.stack([result.draws[name].ravel() for name in problem.names], axis=1)
    assert np.abs((draws.mean(axis=0) - mean) / np.sqrt(np.diag(covariance))).max() < 0.12


@pytest.mark.slow
def test_the_bridge_keeps_two_modes_that_the_optimisations_found():
    problem = TwoModes()
    evidence, share = problem.mode_evidence()
    found = laplace.find_modes(problem, LaplaceConfig(starts=8, blocks=1), KEY)
    result = bridge.sample_from_modes(problem, SmcConfig(particles=500, replicates=2, blocks=1), found, KEY)
    assert result.details["modes"] == 2
    assert result.log_evidence[0] == pytest.approx(evidence, abs=0.2)
    assert np.mean(result.draws["x0"] > 0) == pytest.approx(share, abs=0.1)


def test_an_optimisation_ends_where_nothing_comes_of_what_it_promises():
    """Single precision may round all gains away. What is recorded of it is Python's own, which JSON can hold."""
    problem = LinearGaussian(n_rows=20, d=2)
    target = make_target(problem, 20, Ledger(), np.zeros(2), prior_derivatives(problem))
    flat = target._replace(density=lambda u: np.zeros(len(u)))
    state, steps = maximise(flat, np.full(2, 3.0), max_steps=60, tolerance=1e-4)
    assert state.converged is True
    assert len(steps) < 5


def test_a_problem_without_residuals_is_refused():
    with pytest.raises(InputError, match=r'no residuals.*method = "smc"'):
        laplace.run(Spring(), LaplaceConfig(), KEY)


def test_starts_that_all_fail_are_refused():
    with pytest.raises(InputError, match=r"none of 64 draws.*diverged 64"):
        laplace.run(Decay(fails_above=-1.0), LaplaceConfig(), KEY)


def test_failed_rollouts_never_become_the_optimum():
    problem = Decay(fails_above=0.75)
    result = laplace.run(problem, LaplaceConfig(blocks=1), KEY)
    assert result.optimum["rate"] <= 0.75
    assert result.excluded["diverged"] > 0


def test_an_optimisation_ends_where_nothing_is_delivered_of_what_is_promised():
    """A flat top whose gradient promises half a nat for ever, and whose rounding delivers a trace of it. Three
    steps try dampings of fifteen decades."""
    calls = []

    def density(points):
        calls.append(len(points))
        return 1e-8 * len(calls) - points[:, 0] ** 2

    def steep(u):
        return np.zeros(1), np.array([[1.0]])

    prior, noise = (lambda u: np.ones(1), lambda u: np.zeros((1, 1))), np.zeros(1, dtype=bool)
    target = Target(density, density, *prior, steep, np.zeros_like, noise)
    state, steps = maximise(target, np.zeros(1), max_steps=60, tolerance=1e-4)
    assert state.converged
    assert len(steps) == 3


@pytest.mark.parametrize(("size", "ends"), [(0.1, True), (3.0, False)])
def test_an_optimisation_ends_if_steps_keep_little_of_a_small_promise(size, ends):
    """The quadratic model promises ``size`` nats for ever and each step gains a thousandth: beside a promise of several
    nats a small gain proves nothing."""
    gained = []

    def density(points):
        gained.append(1e-3)
        return np.full(len(points), float(np.sum(gained)))

    def steep(u):
        return np.full(1, np.sqrt(2.0 * size)), np.array([[1.0]])

    prior, noise = (lambda u: np.ones(1), lambda u: np.zeros((1, 1))), np.zeros(1, dtype=bool)
    target = Target(density, density, *prior, steep, np.zeros_like, noise)
    state, steps = maximise(target, np.zeros(1), max_steps=20, tolerance=1e-4)
    assert (state.converged, len(steps)) == ((True, FLAT_STEPS) if ends else (False, 20))


def test_optima_are_rivals_as_far_as_correlated_rows_let_one_tell():
    """Worse by 100 nats in rows of their own noise, an optimum is none; in rows that repeat ten values it may be."""
    rng = np.random.default_rng(0)
    best = np.zeros(1000)
    alone = best - 0.1 + 0.5 * rng.standard_normal(1000)  # 100 +- 16
    lasting = best - 0.1 + 0.5 * np.repeat(rng.standard_normal(10), 100)  # 100 +- 160
    lasting += -100.0 / 1000 - lasting.mean()
    np.testing.assert_array_equal(alternatives(np.stack([best, alone, lasting])), [True, False, True])
    np.testing.assert_array_equal(
        alternatives(np.stack([best - 4e-3, best])), [False, True]
    )  # a constant loss is certain
    np.testing.assert_array_equal(alternatives(np.stack([np.full(1000, -np.inf), best])), [False, True])


def test_draws_come_from_optima_in_equal_parts():
    """4000 draws: the share of a half scatters by 0 as draws are allotted, the mean by 0.016 sd (5 of them: 0.08)."""
    modes = [Laplace(np.array([at, 0.0]), np.diag([0.01, 4.0]), at) for at in (-3.0, 3.0)]
    drawn = draw_mixture(modes, 4000, KEY)
    assert np.mean(drawn[:, 0] < 0) == 0.5
    np.testing.assert_allclose(np.abs(drawn[:, 0]).mean(), 3.0, atol=0.008)
    np.testing.assert_allclose(drawn.std(axis=0)[1], 2.0, rtol=0.06)


def test_laplace_mixes_optima_that_explain_the_data_as_well():
    """A parameter whose sign the data do not see: the optima are alike but for the prior, and each gets a half."""
    result = laplace.run(TwoModes(), LaplaceConfig(starts=8, blocks=1, prior_draws=32), KEY)
    assert [optimum["weight"] for optimum in result.details["optima"]] == [0.5, 0.5]
    assert np.mean(result.draws["x0"] > 0) == pytest.approx(0.5, abs=0.01)
    assert Code.SEVERAL_OPTIMA in [caution.code for caution in result.cautions]
