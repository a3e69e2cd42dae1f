"""A budget in minutes, converted to rollouts on the present machine."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import PRNGKeyArray

from rfdropo_bayes.bayes.batches import chunk_sizes
from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem

FIT, PREDICTIONS = 0.5, 0.2
"""Shares of the minutes: rollouts of the fit, and of predictions with its draws. The report and compiling take the
rest."""


FEWEST_ROLLOUTS = 50


MOST_DRAWS, FEWEST_DRAWS = 200, 16  # draws whose predictions are kept


class Budget(NamedTuple):
    """Numbers of rollouts and draws for a time."""

    rollouts: int  # rollouts of the fit, in full-length rollouts of the fitted recordings
    draws: int  # number of draws with stored predictions


def budget_within(minutes: float, rollout_seconds: float, predicted: float) -> Budget:
    """The budget of some minutes.

    Args:
        minutes: time limit of the whole run.
        rollout_seconds: time of one parameter set, all fitted recordings.
        predicted: rows that are predicted, over fitted rows.
    """
    within = 60.0 * minutes / rollout_seconds
    draws = int(np.clip(PREDICTIONS * within / predicted, FEWEST_DRAWS, MOST_DRAWS))
    return Budget(max(FEWEST_ROLLOUTS, int(FIT * within)), draws)


def rollout_seconds(problem: CalibrationProblem, key: PRNGKeyArray) -> float:
    """Seconds per parameter set in a batch of the prior, for all recordings, without compilation."""
    count = chunk_sizes(problem.chunk)[0]
    drawn = {name: np.asarray(values) for name, values in problem.sample_prior(key, count).items()}
    problem.row_log_likelihood(drawn, problem.n_rows)
    begun = time.perf_counter()
    problem.row_log_likelihood(drawn, problem.n_rows)
    return (time.perf_counter() - begun) / count
