"""Horizon SMC against closed forms.

Statistical thresholds: the evidence of one replicate of the linear model scatters by 0.094 nat (N = 1000, measured over
100 replicates, bias 0.004), so the mean of 10 leaves the 0.1 nat around the truth for 1 seed in 1000; seeds are fixed.
"""

from __future__ import annotations

import jax
import numpy as np
import pytest

from rfdropo_bayes.cautions import Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.smc import sampler
from rfdropo_bayes.inference.smc.sampler import SmcConfig

from ..toys import Decay, LinearGaussian, TwoModes

KEY = jax.random.key(20)


@pytest.fixture(scope="module")
def linear():
    problem = LinearGaussian()
    return problem, sampler.run(problem, SmcConfig(particles=1000, replicates=10), KEY)


def test_evidence_of_every_prefix(linear):
    problem, result = linear
    error = result.prefix_log_evidence - problem.prefix_log_evidence()
    assert np.abs(error).max() < 0.1
    assert result.log_evidence[0] == pytest.approx(result.prefix_log_evidence[-1])
    assert 0.03 < result.log_evidence[1] < 0.25


def test_block_scores_are_the_increments_of_the_evidence(linear):
    problem, result = linear
    exact = problem.prefix_log_evidence()
    first = 1
    for block in result.block_scores:
        assert block["first_row"] == first
        before = exact[first - 2] if first > 1 else 0.0
        assert block["log_score"] == pytest.approx(exact[block["last_row"] - 1] - before, abs=0.12)
        first = block["last_row"] + 1
    assert first == problem.n_rows + 1


def test_equal_weight_draws_have_the_posterior_mean_and_spread(linear):
    """10000 draws: a mean is off by 0.01 sd, a deviation by 0.7 %; thresholds are five times that."""
    problem, result = linear
    mean, covariance = problem.posterior()
    draws = np.stack([result.draws[name].ravel() for name in problem.names], axis=1)
    assert np.abs((draws.mean(axis=0) - mean) / np.sqrt(np.diag(covariance))).max() < 0.05
    np.testing.assert_allclose(np.cov(draws.T), covariance, atol=0.04 * np.diag(covariance).max())


def test_the_carried_likelihood_belongs_to_the_draws(linear):
    problem, result = linear
    values = {name: result.draws[name][3] for name in problem.names}
    np.testing.assert_allclose(result.log_likelihood[3], problem.row_log_likelihood(values, 12)[0], rtol=1e-9)


@pytest.mark.slow
def test_what_a_budget_has_left_becomes_further_draws():
    """Means of 5 x 400 draws, at worst of 5 x 100 independent ones, are off by 0.045 sd: four times that fails once
    in 5000, three parameters together."""
    problem, options = LinearGaussian(), {"rollouts": 4000.0, "particles": 100, "replicates": 1}
    few, many = (
        [sampler.run(problem, SmcConfig(draws=d, **options), jax.random.key(i)) for i in range(5)] for d in (100, 400)
    )
    for plain, result in zip(few, many, strict=True):
        assert result.draws["x0"].shape == (1, 400)
        assert result.rollouts <= 4000
        np.testing.assert_array_equal(result.draws["x0"][:, :100], plain.draws["x0"])
        assert result.log_evidence[0] == plain.log_evidence[0]
        values = {name: result.draws[name][0] for name in problem.names}
        np.testing.assert_allclose(result.log_likelihood[0], problem.row_log_likelihood(values, 12)[0], rtol=1e-9)
    mean, covariance = problem.posterior()
    drawn = np.mean([[result.draws[name].mean() for name in problem.names] for result in many], axis=0)
    assert np.abs((drawn - mean) / np.sqrt(np.diag(covariance))).max() < 0.18


def test_further_draws_are_moved_by_random_numbers_of_their_own():
    """Moves leave a correlation of 0.3 at most. That of 400 particles is known to 0.05, its mean over six directions to
    0.02: three times that. Moved by the numbers of the last moves, 0.5 is left."""
    problem = LinearGaussian()
    mean, covariance = problem.posterior()
    left = []
    for seed in (1, 2):
        config = SmcConfig(rollouts=16000.0, particles=400, replicates=1, draws=800)
        result = sampler.run(problem, config, jax.random.key(seed))
        u = np.stack([result.draws[name][0] for name in problem.names], axis=1)
        white = np.linalg.solve(np.linalg.cholesky(covariance), (u - mean).T)
        left += [np.corrcoef(row[:400], row[400:])[0, 1] for row in white]
    assert np.mean(left) < 0.36


def test_nothing_is_evaluated_twice():
    """Rollouts charged are those made, and only first looks at a block and proposals are made."""
    problem = LinearGaussian()
    result = sampler.run(problem, SmcConfig(particles=100), KEY)
    assert sum(n * h for n, h in problem.calls) / problem.n_rows == pytest.approx(result.rollouts)
    moves = sum(row["moves"] for row in result.trace if row["moves"] and not row.get("final"))
    moves += sum(row["moves"] for row in result.trace if row.get("final"))
    blocks = len(result.details["horizons"])
    assert len(problem.calls) == blocks + moves


def test_same_key_same_draws_other_key_other_draws():
    problem, config = LinearGaussian(), SmcConfig(particles=100, replicates=2)
    first, again, other = (sampler.run(problem, config, jax.random.key(k)) for k in (1, 1, 2))
    for name in problem.names:
        np.testing.assert_array_equal(first.draws[name], again.draws[name])
        assert not np.array_equal(first.draws[name], other.draws[name])
        assert not np.array_equal(first.draws[name][0], first.draws[name][1])
    assert first.log_evidence == again.log_evidence


def test_two_modes_keep_their_shares():
    """4000 draws of a share of 0.61 scatter by 0.008 if independent; resampling at few stages makes it about 0.02."""
    problem = TwoModes()
    result = sampler.run(problem, SmcConfig(particles=1000, replicates=4), KEY)
    evidence, share = problem.mode_evidence()
    assert result.log_evidence[0] == pytest.approx(evidence, abs=0.15)
    assert np.mean(result.draws["x0"] > 0) == pytest.approx(share, abs=0.08)
    assert np.all(np.mean(result.draws["x0"] > 0, axis=1) > 0.3)
    assert Code.MODES_UNSEEN not in [caution.code for caution in result.cautions]


def test_failed_rollouts_get_no_weight_and_are_counted():
    problem = Decay(fails_above=0.8)
    result = sampler.run(problem, SmcConfig(particles=400), KEY)
    assert result.draws["rate"].max() <= 0.8
    assert np.isfinite(result.log_likelihood).all()
    assert np.isfinite(result.log_evidence[0])
    assert result.excluded.keys() == {"diverged"}
    assert result.excluded["diverged"] > 100
    codes = [caution.code for caution in result.cautions]
    assert Code.ROLLOUTS_EXCLUDED in codes
    assert Code.MODES_UNSEEN in codes  # of one replicate


def test_a_failure_costs_evidence_by_its_prior_mass():
    """With no data to speak of, the evidence is the probability that a rollout ends well."""

    class Flat(Decay):
        def row_log_likelihood(self, values, horizon):
            rows, status = super().row_log_likelihood(values, horizon)
            return np.where(np.isnan(rows), np.nan, 0.0), status

    result = sampler.run(Flat(n_rows=3, fails_above=1.0), SmcConfig(particles=4000, blocks=1), KEY)
    assert result.log_evidence[0] == pytest.approx(np.log(0.5), abs=0.06)  # 4 binomial deviations


def test_a_prior_that_excludes_the_data_is_named():
    with pytest.raises(InputError, match=r"the prior excludes the data.*diverged 200"):
        sampler.run(Decay(fails_above=-1.0), SmcConfig(particles=200), KEY)


def test_a_prior_far_from_the_data_collapses_the_evidence():
    near, far = LinearGaussian(), LinearGaussian()
    far.mean = far.mean + 30.0
    exact = far.prefix_log_evidence()[-1]
    result = sampler.run(far, SmcConfig(particles=300), KEY)
    assert exact < near.prefix_log_evidence()[-1] - 100.0
    assert result.log_evidence[0] == pytest.approx(exact, rel=0.01)
    assert any(caution.sentence.startswith("the data put x0, x1, x2 into the outermost") for caution in result.cautions)


@pytest.mark.parametrize("budget", [pytest.param(1500.0, marks=pytest.mark.slow), 8000.0])
def test_the_budget_is_kept(budget):
    problem = LinearGaussian(n_rows=40, d=8)
    result = sampler.run(problem, SmcConfig(rollouts=budget, replicates=2), KEY)
    assert result.rollouts <= budget
    assert sum(n * h for n, h in problem.calls) / problem.n_rows <= budget
    assert np.isfinite(result.log_evidence[0])


def test_a_budget_that_runs_out_is_said():
    problem = LinearGaussian(n_rows=40, d=8)
    result = sampler.run(problem, SmcConfig(rollouts=1100.0, particles=300), KEY)
    assert result.rollouts <= 1100
    assert Code.BUDGET_SPENT in [caution.code for caution in result.cautions]


def test_a_budget_that_allows_nothing_is_refused():
    with pytest.raises(InputError, match=r"too few.*allow at least"):
        sampler.run(LinearGaussian(), SmcConfig(rollouts=20.0), KEY)


@pytest.mark.parametrize("wrong", [{"start": "middle"}, {"replicates": 0}, {"rollouts": -1.0}])
def test_settings_are_checked(wrong):
    with pytest.raises(InputError, match=str(next(iter(wrong)))):
        SmcConfig(**wrong)


@pytest.mark.slow
def test_a_ridge_is_followed_by_few_particles():
    """Two parameters seen through their sum only, to 1 in 1000 of their spread: 150 particles know its direction."""
    problem = LinearGaussian(n_rows=8, d=4)
    problem.design[:, 1] = problem.design[:, 0]
    problem.noise = problem.noise * 0.01
    problem.data = problem.design @ problem.mean
    result = sampler.run(problem, SmcConfig(particles=150, replicates=2), KEY)
    _, covariance = problem.posterior()
    assert covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]) < -0.999
    assert result.log_evidence[0] == pytest.approx(problem.prefix_log_evidence()[-1], abs=1.0)
    last = [row for row in result.trace if row.get("final")]
    assert min(row["acceptance"] for row in last) > 0.3
    assert result.draws["x0"].std() == pytest.approx(np.sqrt(covariance[0, 0]), rel=0.25)
