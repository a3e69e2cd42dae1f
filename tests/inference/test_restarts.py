"""Climbs that went astray as the recording grew."""

from __future__ import annotations

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from rfdropo_bayes.inference.checkpoints import Checkpoint
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.modes import restarts
from rfdropo_bayes.inference.modes.climb import Laplace, laplace, maximise
from rfdropo_bayes.inference.modes.climbs import begin
from rfdropo_bayes.inference.modes.restarts import (
    FEWEST_GENERATIONS,
    MOST_GENERATIONS,
    POPULATION,
    affordable_generations,
    astray,
    search,
)
from rfdropo_bayes.inference.modes.search import FEWEST_STEPS, LaplaceConfig, _affordable_steps, find_modes
from rfdropo_bayes.inference.modes.targets import make_target, prior_derivatives

from .toys import LateContact, LinearGaussian

KEY = jax.random.key(19)
CONFIG = LaplaceConfig(starts=4, survey=50, rollouts=3000.0)


def residuals(rows, size=1.0, seed=0):
    return size * np.random.default_rng(seed).normal(size=(40, 50))[:rows].ravel()


@pytest.mark.parametrize("usual", [0.3, 1.0, 4.0])
def test_rows_are_judged_by_the_misfit_of_those_before(usual):
    """Whatever is taken for the noise. 500 new data scatter by 16 nats; the threshold is 100, and five times that."""
    before, after = residuals(30, usual), residuals(40, usual)
    assert not astray(before, after)
    worse = after.copy()
    worse[-500:] += np.sqrt(2.0 * (150.0 + 8.0 * 16.0 * usual**2) / 500.0)
    assert astray(before, worse)


@pytest.mark.parametrize("seed", range(20))
def test_noise_alone_leads_nothing_astray(seed):
    """20 of 20, each with a chance below 1e-6."""
    assert not astray(residuals(35, seed=seed), residuals(40, seed=seed))


def test_data_that_are_masked_do_not_count():
    """Of the rows before, half of the data are masked: to count them would make the new rows look bad."""
    after = residuals(40, 3.0).reshape(40, 50)
    after[:30, :25] = 0.0
    assert not astray(after[:30].ravel(), after.ravel())
    assert not astray(after[:30].ravel(), np.concatenate([after[:30].ravel(), np.zeros(500)]))
    assert not astray(np.zeros(1500), after.ravel())


def test_a_start_that_is_lost_is_astray():
    assert astray(residuals(30), np.where(np.arange(2000) < 1990, residuals(40), np.nan))


def late_optimum(key=KEY, begins=36, config=CONFIG):
    problem = LateContact(begins)
    found = find_modes(problem, config, key)
    truth = np.array([LateContact.truth])
    there = float((np.asarray(problem.log_prior(truth)) + np.asarray(problem._row_density(truth, 40)).sum(axis=1))[0])
    return found, there


@pytest.mark.parametrize("begins", [32, 36])
@pytest.mark.parametrize("seed", range(3))
def test_a_climb_that_a_late_contact_leads_astray_is_begun_again(seed, begins):
    """With a contact after seven eighths of the recording, and before. All of 20 keys ended on the ripple of the truth,
    or (three) on another that explains the data as well, a nat lower by its prior."""
    found, there = late_optimum(jax.random.key(seed), begins)
    assert found.modes[0].log_density > there - 2.0


@pytest.mark.parametrize("begins", [32, 36])
@pytest.mark.parametrize("rollouts", [300.0, 450.0, 600.0, 900.0, 1500.0])
def test_the_budget_is_kept_and_climbs_are_begun_again_only_where_it_serves_them(rollouts, begins):
    found, there = late_optimum(begins=begins, config=replace(CONFIG, rollouts=rollouts))
    assert found.climbs.ledger.rollouts <= rollouts
    horizon = 35 if begins < 35 else 40
    visits = [row for row in found.climbs.trace if "start" in row]
    again = [row for row in visits if row["horizon"] == horizon and row["start"] > 0]
    assert len(again) == 1 if rollouts >= 900.0 else len(again) <= (rollouts > 300.0)
    assert all(row["converged"] or row["steps"] >= FEWEST_STEPS for row in again)
    last = [row for row in visits if row["horizon"] == 40]
    assert last[0]["converged"] or last[0]["steps"] >= FEWEST_STEPS
    assert not again or found.modes[0].log_density > there - 2.0


@pytest.mark.parametrize(("d", "noise"), [(2, 0), (7, 2), (8, 3)])
def test_generations_are_paid_for(d, noise):
    for rollouts in np.arange(-10.0, 900.0, 7.0):
        generations = affordable_generations(rollouts, d, noise)
        assert generations == 0 or FEWEST_GENERATIONS <= generations <= MOST_GENERATIONS
        assert generations * POPULATION <= max(rollouts, 0.0)
    assert affordable_generations(np.inf, d, noise) == affordable_generations(899.0, d, noise) == MOST_GENERATIONS


def test_what_is_held_back_for_a_search_goes_to_the_best_climb_if_to_any():
    """Two climbs wait at the last horizon, with less than a tenth of the budget left for both."""
    config, noise = LaplaceConfig(survey=50, rollouts=3000.0), np.array([True, False])
    ledger = Ledger()
    climbs = begin(np.zeros((2, 2)), np.zeros(2), ledger, 0.0)._replace(earlier=np.zeros((1, 2)), level=2, noise=noise)
    ledger.rollouts = 0.9 * config.rollouts - 250.0  # a tenth is for plateaus
    first = _affordable_steps(40, config, climbs, (30, 35, 40), 1)
    assert first >= FEWEST_STEPS
    ledger.rollouts += 60.0
    assert _affordable_steps(40, config, climbs._replace(done=1), (30, 35, 40), 1) == 0


class Cut(LinearGaussian):
    """A rollout that ends before its time, at a place that the rows before its end do not tell of, has residuals that
    say nothing of it."""

    def __init__(self):
        super().__init__(n_rows=40, d=2, noise=0.5)

    def row_log_likelihood(self, values, horizon):
        rows, _ = super().row_log_likelihood(values, horizon)
        mean, covariance = self.posterior()
        lost = (horizon > 35) & (np.asarray(values["x0"]) < mean[0] + np.sqrt(covariance[0, 0]))
        return rows, lost.astype(int)


def test_climbs_that_are_all_lost_are_begun_again():
    problem = Cut()
    found = find_modes(problem, CONFIG, KEY)
    mean, covariance = problem.posterior()
    assert np.isfinite(found.modes[0].log_density)
    assert found.modes[0].mean[0] > mean[0] + np.sqrt(covariance[0, 0])


def test_without_another_start_the_same_climbs_stay_astray(monkeypatch):
    monkeypatch.setattr(restarts, "ASTRAY", np.inf)
    found, there = late_optimum()
    assert found.modes[0].log_density < there - 100.0


def test_climbs_that_are_not_astray_are_left_alone():
    problem = LinearGaussian(n_rows=40, d=3)
    found = find_modes(problem, CONFIG, KEY)
    visits = [row["start"] for row in found.climbs.trace if row["horizon"] > 30 and "start" in row]
    assert visits == [0, 0]


def toy_target(noise=(False, False), horizon=40, ledger=None):
    problem = LateContact()
    ledger = Ledger() if ledger is None else ledger
    return make_target(
        problem, horizon, ledger, problem.mean, prior_derivatives(problem), "central", np.array(noise, dtype=bool)
    )


@pytest.mark.parametrize("seed", range(5))
def test_a_search_finds_the_ripple_of_the_truth_and_is_charged_its_candidates(seed):
    """Starts of 48 of 50 keys were within 3 nats of the truth, all within 30; others are thousands below."""
    problem, ledger = LateContact(), Ledger()
    shorter, longer = toy_target(horizon=36, ledger=ledger), toy_target(ledger=ledger)
    state, _ = maximise(shorter, problem.mean, max_steps=60, tolerance=1e-6)
    mode = laplace(shorter, state)
    before = ledger.rollouts
    start = search(problem, mode, longer, MOST_GENERATIONS, jax.random.key(seed))
    assert ledger.rollouts - before == pytest.approx(MOST_GENERATIONS * POPULATION)
    truth = np.array(LateContact.truth)
    heights = longer.density(np.stack([state.position, start[0], truth]))
    assert heights[1] > heights[0] + 1000.0
    assert heights[1] > heights[2] - 30.0


def test_an_approximation_that_is_no_use_and_candidates_without_a_likelihood_give_no_start():
    problem, longer = LateContact(), toy_target()
    useless = Laplace(problem.mean, np.eye(2), 0.0, np.full((2, 2), np.inf), np.zeros(2))
    assert search(problem, useless, longer, 6, KEY).shape == (0, 2)
    mode = Laplace(problem.mean, np.eye(2), 0.0, np.eye(2), np.zeros(2))
    for value in (-np.inf, np.nan):
        lost = longer._replace(density=lambda points, value=value: np.full(len(points), value))
        assert search(problem, mode, lost, 6, KEY).shape == (0, 2)
    assert search(problem, mode, toy_target((True, True)), 6, KEY).shape == (0, 2)


def test_noise_stays_where_it_was():
    """What is looked for is where the rows are explained, not a noise that excuses them."""
    mode = Laplace(np.array([1.2, 1.0]), np.eye(2), 0.0, np.diag([1e4, 1e-4]), np.zeros(2))
    target = toy_target((True, False))
    start = search(LateContact(), mode, target, 6, KEY)
    np.testing.assert_allclose(start[:, 0], 1.2, rtol=1e-12)
    assert target.density(start)[0] > target.density(mode.mean[None])[0] + 100.0


def test_a_start_without_a_likelihood_is_not_climbed_from():
    problem, longer = LateContact(), toy_target()
    lost = longer._replace(density=lambda points: np.full(len(points), -np.inf))
    state, steps = maximise(lost, problem.mean, max_steps=40, tolerance=1e-4)
    assert not steps
    assert not state.converged
    np.testing.assert_array_equal(state.position, problem.mean)


class Disk(Checkpoint):
    """A checkpoint that is written so often and no more."""

    def __init__(self, saves):
        self.saves, self.kept = saves, None

    def load(self):
        return self.kept

    def save(self, arrays, meta):
        if self.saves == 0:
            raise KeyboardInterrupt
        self.saves -= 1
        self.kept = ({name: array.copy() for name, array in arrays.items()}, json.loads(json.dumps(meta)))


def test_climbs_that_are_killed_before_and_after_they_begin_again_end_alike():
    problem, disk = LateContact(), Disk(10**6)
    whole = find_modes(problem, CONFIG, KEY, disk)
    visits = [row for row in whole.climbs.trace if "start" in row]
    assert sum(row["horizon"] == 40 for row in visits) >= 2
    for saves in range(1, len(visits)):
        disk = Disk(saves)
        with pytest.raises(KeyboardInterrupt):
            find_modes(problem, CONFIG, KEY, disk)
        disk.saves = 10**6
        resumed = find_modes(problem, CONFIG, KEY, disk)
        np.testing.assert_array_equal(resumed.modes[0].mean, whole.modes[0].mean)
        assert resumed.climbs.ledger.rollouts == whole.climbs.ledger.rollouts
