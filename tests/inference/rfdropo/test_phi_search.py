"""RF-DROPO: the match, the distribution, the optimisers, and what was mended."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.rfdropo import phi_search as rfdropo
from rfdropo_bayes.inference.rfdropo.candidate_scores import motion_scale, step_log_likelihood
from rfdropo_bayes.inference.rfdropo.phi_search import RfdropoConfig, default_population, make_optimiser
from rfdropo_bayes.inference.rfdropo.phi_space import search_space

from ..toys import Spring

KEY = jax.random.key(9)


def test_the_match_is_the_gaussian_of_the_rollouts_with_a_floor():
    rng = np.random.default_rng(0)
    features, observed = rng.normal(size=(50, 4, 3)), rng.normal(size=(4, 3))
    alive = np.arange(50) % 5 > 0
    mask = np.ones((4, 3), dtype=bool)
    mask[2, 1] = False
    found = step_log_likelihood(features, alive, observed, mask, 0.01)
    for t in range(4):
        keep = mask[t]
        good = features[alive, t][:, keep]
        exact = multivariate_normal.logpdf(
            observed[t, keep], good.mean(axis=0), np.cov(good.T) + 0.01 * np.eye(keep.sum())
        )
        assert found[t] == pytest.approx(exact)


def test_motion_is_measured_from_where_each_feature_was_first_seen():
    observed = np.array([[5.0, 1.0], [6.0, np.nan], [7.0, 1.0]])
    assert motion_scale(observed, np.isfinite(observed)) == pytest.approx(np.sqrt(5.0 / 5.0))
    assert motion_scale(np.ones((3, 2)), np.ones((3, 2), dtype=bool)) == 1.0


@pytest.mark.parametrize("name", ["cma", "cem"])
def test_optimisers_find_a_quadratic_inside_its_box_and_repeat_themselves(name):
    target = np.array([0.5, 3.7, 2.0, 1.2])

    def search(seed):
        optimiser = make_optimiser(name, 4, high=4.0, sigma=0.3, population=20, seed=seed)
        for _ in range(60):
            candidates = optimiser.ask()
            assert candidates.min() >= 0.0
            assert candidates.max() <= 4.0
            losses = np.sum((candidates - target) ** 2 * [1.0, 3.0, 10.0, 30.0], axis=1)
            losses[0] = np.inf  # a failed candidate must not stop it
            optimiser.tell(candidates, losses)
        return optimiser.centre

    np.random.seed(1)  # noqa: NPY002  pycma uses numpy's global numbers unless told otherwise
    first = search(3)
    np.random.seed(2)  # noqa: NPY002
    np.testing.assert_allclose(first, target, atol=0.05)
    np.testing.assert_array_equal(search(3), first)
    assert not np.array_equal(search(4), first)


def test_the_default_population_is_hansens():
    assert [default_population("cma", d) for d in (2, 6, 10)] == [6, 9, 10]


def test_draws_are_truncated_normals_inside_the_hard_bounds():
    problem = Spring()
    prior = problem.sample_prior(KEY, 100)
    space = search_space(problem, ("frequency", "damping"), {"frequency": (2.0, 3.0), "damping": (0.0, 2.0)}, prior)
    vector = np.array([2.0, 0.0, 4.0, 4.0])  # damping: mean on its lower bound, widest spread
    mean, std = space.unpack(vector)
    np.testing.assert_allclose(mean, [2.5, 0.0])
    np.testing.assert_allclose(std, [0.25, 0.5])
    draws = space.draw(vector, np.random.default_rng(0).uniform(size=(20000, 2)))
    assert draws[:, 0].min() >= 2.0 - 1e-12
    assert draws[:, 0].max() <= 3.0 + 1e-12
    assert draws[:, 1].min() >= 0.0
    # Normal truncated at 2 deviations: its own deviation is 0.880 of the full one; 5 standard errors are 2.5 %.
    assert draws[:, 0].std() == pytest.approx(0.8796 * 0.25, rel=0.025)
    table = space.describe(vector, problem.units)
    assert table["damping"] == {"mean": 0.0, "std": pytest.approx(0.5), "low": 0.0, "high": 1.0, "unit": "1/s"}
    found = space.edge_cautions(vector)
    assert found
    assert any("mean of damping" in caution.sentence for caution in found)
    assert not any("mean of frequency" in caution.sentence for caution in found)


@pytest.mark.parametrize("optimiser", ["cma", "cem"])
def test_a_known_distribution_is_recovered(optimiser):
    """Eight trajectories' worth of features drawn from a known phi cannot be had from one; one gives the mean."""
    problem = Spring()
    config = RfdropoConfig(rollouts=20000.0, rollouts_per_candidate=20, optimiser=optimiser)
    result = rfdropo.run(problem, config, KEY)
    assert result.phi["frequency"]["mean"] == pytest.approx(2.3, abs=0.03)
    assert result.phi["damping"]["mean"] == pytest.approx(0.4, abs=0.05)
    assert result.phi["frequency"]["std"] < 0.05
    assert result.phi["frequency"]["unit"] == "1/s"
    assert set(result.draws) == {"frequency", "damping"}
    assert result.draws["frequency"].shape == (1, 2000)
    assert result.rollouts <= 20000.0
    assert sum(n * h for n, h in problem.calls) / problem.n_rows == pytest.approx(result.rollouts)


def test_spread_in_the_data_is_recovered_as_spread():
    """Features of many springs side by side, one parameter each: the spread of phi is theirs, not zero."""

    class Many(Spring):
        """Observed: each time step belongs to another spring, as if the robot changed from step to step."""

        def __init__(self):
            super().__init__(n_rows=200)
            frequency = np.random.default_rng(1).normal(2.5, 0.3, self.n_rows)
            every = self._features(frequency, np.full(self.n_rows, 0.4))
            self.observed = every[np.arange(self.n_rows), np.arange(self.n_rows)]

    config = RfdropoConfig(rollouts=30000.0, rollouts_per_candidate=40)
    phi = rfdropo.run(Many(), config, KEY).phi
    # 200 steps give a mean to 0.02 and a deviation to 5 %; truncation at 2 deviations widens the fitted one.
    assert phi["frequency"]["mean"] == pytest.approx(2.5, abs=0.12)
    assert 0.2 < phi["frequency"]["std"] < 0.5


class Noisy(Spring):
    """Measured with noise, that is known where a search is not as published."""

    sd = 0.01  # a fifth of the amplitude

    def __init__(self, seed):
        super().__init__()
        self.observed = self.observed + self.sd * np.random.default_rng(seed).normal(size=self.observed.shape)

    def noise_deviation(self, values):
        return np.full(2, self.sd)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_noise_of_the_measurement_is_not_taken_for_spread_of_the_parameters(seed, monkeypatch):
    """The spring itself is always the same one. Taken for exact, data with noise can only be had from many."""
    monkeypatch.setattr(rfdropo, "paper_horizon", lambda i, iterations, n_rows, mended: n_rows)
    settings = {"rollouts": 20000.0, "rollouts_per_candidate": 20}
    exact = rfdropo.run(Noisy(seed), RfdropoConfig(**settings, mended=False), KEY).phi["frequency"]
    mended = rfdropo.run(Noisy(seed), RfdropoConfig(**settings), KEY).phi["frequency"]
    assert mended["mean"] == pytest.approx(2.3, abs=0.1)
    assert mended["std"] < 0.5 * exact["std"]


class Deceptive(Spring):
    """Its first two rows are those of a wrong frequency, without noise; the rest is the truth, with much noise.

    So no longer horizon can reach the loss of the shortest ones, where the wrong frequency wins.
    """

    def __init__(self):
        super().__init__()
        self.time = self.time + 0.5
        true, wrong = (self._features(np.array([f]), np.array([0.4]))[0] for f in (2.3, 4.2))
        noise = 0.03 * np.random.default_rng(0).normal(size=true.shape)
        self.observed = np.where(np.arange(self.n_rows)[:, None] < 2, wrong, true + noise)


@pytest.mark.parametrize("optimiser", ["cma", "cem"])
def test_finalists_are_scored_again_at_the_full_horizon(optimiser, monkeypatch):
    """The lowest loss ever belongs to a short horizon and to the wrong frequency; as published it is returned."""
    monkeypatch.setattr(rfdropo, "FLOOR", 1e-3)
    settings = {"rollouts": 20000.0, "rollouts_per_candidate": 20, "optimiser": optimiser}
    published = rfdropo.run(Deceptive(), RfdropoConfig(**settings, mended=False), KEY)
    mended = rfdropo.run(Deceptive(), RfdropoConfig(**settings), KEY)
    for result in (published, mended):
        assert result.details["lowest_loss_ever"]["horizon"] <= 2
    assert published.details["lowest_loss_ever"]["loss"] < min(mended.details["finalist_losses"]) - 50.0
    assert mended.trace[-1]["horizon"] == 40
    # Finalists: where the optimiser ended, then the best of nine stages, the first of which knew the first rows only.
    _, early, *later = mended.details["finalist_losses"]
    assert len(later) == 8
    assert early > min(later) + 100.0
    wrong, found = (abs(result.phi["frequency"]["mean"] - 2.3) for result in (published, mended))
    assert found < wrong - 0.3


def test_failed_rollouts_are_left_out_of_the_mean_and_counted():
    class Failing(Spring):
        def rollouts(self, values, horizon):
            features, _ = super().rollouts(values, horizon)
            failed = np.asarray(values["damping"]) > 1.0
            features[failed] = np.nan
            return features, failed.astype(int)

    result = rfdropo.run(Failing(), RfdropoConfig(rollouts=10000.0, rollouts_per_candidate=20), KEY)
    assert result.phi["frequency"]["mean"] == pytest.approx(2.3, abs=0.05)
    assert result.excluded["status_1"] > 100


def test_a_simulator_that_always_fails_is_named():
    class Dead(Spring):
        def rollouts(self, values, horizon):
            features, status = super().rollouts(values, horizon)
            return features, status + 2

    with pytest.raises(InputError, match=r"every candidate failed.*status_2"):
        rfdropo.run(Dead(), RfdropoConfig(evaluations=20, rollouts_per_candidate=10), KEY)


def test_a_budget_that_allows_no_generation_is_refused():
    with pytest.raises(InputError, match=r"do not allow one generation.*at least"):
        rfdropo.run(Spring(), RfdropoConfig(rollouts=500.0), KEY)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"parameters": ("stiffness",)}, "unknown parameter 'stiffness'"),
        ({"search": {"frequency": (3.0, 2.0)}}, "search range"),
        ({"search": {"frequency": (0.0, 2.0)}}, "search range"),
    ],
)
def test_the_search_space_is_checked(wrong, words):
    with pytest.raises(InputError, match=words):
        rfdropo.run(Spring(), RfdropoConfig(evaluations=10, rollouts_per_candidate=10, **wrong), KEY)


def test_the_search_range_is_that_of_the_prior_inside_the_bounds():
    problem = Spring()
    problem.bounds = {**problem.bounds, "frequency": (1e-3, 1e3)}
    prior = {"frequency": np.linspace(1.0, 5.0, 1001), "damping": np.linspace(-1.0, 2.0, 1001), "noise": np.ones(3)}
    space = search_space(problem, ("frequency", "damping"), {}, prior)
    np.testing.assert_allclose([space.low[0], space.high[0]], [1.02, 4.98])
    assert (space.hard_low[0], space.hard_high[0]) == (1e-3, 1e3)
    assert space.low[1] == 0.0
