"""Blocks of rows that a survey of modes brings in one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.bayes.problem import ProblemDefaults, Values
from rfdropo_bayes.inference.smc.moves import StraightProblem


class BlockProblem(ProblemDefaults):
    """Blocks of a problem's rows as its rows, which a sampler brings in by shares: it tempers a whole block at once."""

    def __init__(self, problem: StraightProblem, horizons: tuple[int, ...]) -> None:
        self.problem, self.horizons = problem, horizons
        self.names, self.units, self.bounds = problem.names, problem.units, problem.bounds
        self.status_names = problem.status_names
        self.fingerprint = f"{problem.fingerprint} {horizons}"
        self.n_rows = len(horizons)
        self.sample_prior, self.log_prior = problem.sample_prior, problem.log_prior
        self.to_unconstrained, self.from_unconstrained = problem.to_unconstrained, problem.from_unconstrained

    def row_log_likelihood(self, values: Values, horizon: int) -> tuple[Float[Any, "n horizon"], Int[Any, " n"]]:
        """Log density of the rows of each block together."""
        rows, status = self.problem.row_log_likelihood(values, self.horizons[horizon - 1])
        return np.add.reduceat(np.asarray(rows), [0, *self.horizons[: horizon - 1]], axis=1), status
