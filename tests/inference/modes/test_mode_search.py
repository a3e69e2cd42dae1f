"""Starts of optimisations."""

from __future__ import annotations

import jax
import numpy as np

from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.modes.mode_search import starts_of_draws
from tests.inference.toys import LinearGaussian


def test_the_middle_of_a_prior_of_many_parameters_is_a_start():
    """The nearest of 64 draws of 30 coordinates is 4 deviations from the middle, and a truth near it has no other start
    so good."""
    problem = LinearGaussian(n_rows=60, d=30)
    problem.data = problem.design @ problem.mean
    starts, density = starts_of_draws(problem, 64, problem.n_rows, 4, jax.random.key(0), Ledger())
    distance = np.linalg.norm((starts - problem.mean) / problem.sd, axis=1)
    assert distance[0] < 0.5 < 4.0 < distance[1:].min()
    assert density[0] == density.max()
