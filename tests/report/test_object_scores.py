"""Scores of where a pushed object ends."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.report.object_scores import energy_score, final_position


@pytest.mark.parametrize("outcome", [-2.0, 0.0, 0.7])
def test_energy_score_of_a_normal_has_its_closed_form(outcome):
    """CRPS of a standard normal (Gneiting and Raftery 2007, eq. 5), within 4 standard errors (1 in 16,000)."""
    draws = np.random.default_rng(0).standard_normal((3000, 1))
    exact = outcome * (2 * norm.cdf(outcome) - 1) + 2 * norm.pdf(outcome) - 1 / np.sqrt(np.pi)
    spread = np.std(np.abs(draws - outcome)) / np.sqrt(len(draws)) + 1.0 / np.sqrt(len(draws))
    assert energy_score(draws, np.array([outcome])) == pytest.approx(exact, abs=4 * spread)


def test_energy_score_does_not_depend_on_the_size_of_the_ensemble_on_average():
    """Ensembles of two and of many, from one distribution in three dimensions: within 4 standard errors."""
    rng, outcome = np.random.default_rng(1), np.array([0.3, -0.2, 1.0])
    pairs = np.array([energy_score(rng.standard_normal((2, 3)), outcome) for _ in range(3000)])
    many = energy_score(rng.standard_normal((2000, 3)), outcome)
    assert pairs.mean() == pytest.approx(many, abs=4 * pairs.std() / np.sqrt(len(pairs)) + 0.05)


def test_energy_score_prefers_the_right_distribution_to_a_sharper_and_a_wider_one():
    rng = np.random.default_rng(2)
    outcomes = rng.standard_normal((400, 2))
    scores = {
        scale: np.mean([energy_score(scale * rng.standard_normal((200, 2)), y) for y in outcomes])
        for scale in (0.3, 1.0, 3.0)
    }
    assert scores[1.0] < min(scores[0.3], scores[3.0])
    with pytest.raises(InputError, match="single draw"):
        energy_score(np.zeros((1, 2)), np.zeros(2))


def test_rows_in_which_the_object_was_not_seen_do_not_count_for_where_it_ended():
    pose = np.zeros((20, 7))
    pose[:, 0] = np.linspace(0.0, 1.9, 20)
    pose[-1] = np.nan
    assert final_position(pose)[0] == pytest.approx(np.mean(pose[10:19, 0]))
