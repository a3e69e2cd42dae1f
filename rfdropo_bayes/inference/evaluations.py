"""Calls of a problem's likelihood over prefixes of its rows: cleaned, counted, and charged to a budget of rollouts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.errors import InputError

NOT_A_NUMBER = "not_a_number"
REDRAWS = 256  # most prior draws, as a multiple of the requested number


@dataclass
class Ledger:
    """Cost of the work on a problem.

    A rollout of horizon h counts as h / n_rows rollouts, because its cost is proportional to its steps.
    """

    rollouts: float = 0.0  # full-length equivalents used
    evaluations: int = 0  # parameter sets evaluated, at any horizon
    excluded: Counter[str] = field(default_factory=Counter)  # parameter sets that got no weight, counted by status

    @property
    def reasons(self) -> str:
        """Counts of excluded parameter sets by reason, in words."""
        return ", ".join(f"{name} {count}" for name, count in sorted(self.excluded.items())) or "no reason given"

    def record(self) -> dict[str, Any]:
        """The ledger for a checkpoint and an `InferenceResult` (`dataclasses.asdict` fails for a Counter)."""
        return {"rollouts": self.rollouts, "evaluations": self.evaluations, "excluded": dict(self.excluded)}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Ledger:
        """Inverse of `record`."""
        return cls(record["rollouts"], record["evaluations"], Counter(record["excluded"]))

    def __add__(self, other: Ledger) -> Ledger:
        """Sum of both costs."""
        excluded = self.excluded + other.excluded
        return Ledger(self.rollouts + other.rollouts, self.evaluations + other.evaluations, excluded)

    def charge(self, problem: Problem, n: int, horizon: int) -> None:
        """Count ``n`` rollouts of ``horizon`` rows."""
        self.rollouts += n * horizon / problem.n_rows
        self.evaluations += n

    def exclude(self, problem: Problem, status: Int[np.ndarray, " n"], not_a_number: np.ndarray) -> None:
        """Count excluded parameter sets by status; a NaN likelihood is also a reason."""
        for code, count in zip(*np.unique(status[status != 0], return_counts=True), strict=True):
            self.excluded[problem.status_names.get(int(code), f"status_{int(code)}")] += int(count)
        unexplained = int(np.sum(not_a_number & (status == 0)))
        if unexplained:
            self.excluded[NOT_A_NUMBER] += unexplained


def evaluate_rows(
    problem: Problem, u: Float[np.ndarray, "n d"], horizon: int, ledger: Ledger
) -> Float[np.ndarray, "n horizon"]:
    """Row log likelihoods at unconstrained points; minus infinity throughout for every rollout that is left out."""
    values = problem.from_unconstrained(jnp.asarray(u))
    rows, status = (np.asarray(part) for part in problem.row_log_likelihood(values, horizon))
    rows = np.asarray(rows, dtype=float)
    ledger.charge(problem, len(u), horizon)
    not_a_number = np.any(np.isnan(rows) | (rows == np.inf), axis=1)
    ledger.exclude(problem, status, not_a_number)
    return np.where((not_a_number | (status != 0))[:, None], -np.inf, rows)


def evaluate_prior(problem: Problem, u: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Log prior at unconstrained points; minus infinity if it is NaN."""
    density = np.asarray(problem.log_prior(jnp.asarray(u)), dtype=np.float64)
    return np.where(np.isnan(density) | (density == np.inf), -np.inf, density)


def representable_draws(
    problem: Problem, key: PRNGKeyArray, n: int
) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, " m"], int]:
    """Unconstrained prior draws with finite coordinates, their log density, and the number of draws made. There are at
    least ``n`` if `REDRAWS` times ``n`` draws suffice. A scale of 1e-400 is excluded: its logarithm is infinite.
    """
    batches: list[tuple[np.ndarray, np.ndarray]] = []
    drawn = kept = 0
    while kept < n and drawn < REDRAWS * n:
        values = problem.sample_prior(jax.random.fold_in(key, drawn) if drawn else key, n)
        u = np.array(problem.to_unconstrained(values), dtype=float)
        base = evaluate_prior(problem, u)
        finite = np.isfinite(u).all(axis=1) & np.isfinite(base)
        batches.append((u[finite], base[finite]))
        drawn, kept = drawn + n, kept + int(finite.sum())
    positions, densities = zip(*batches, strict=True)
    return np.concatenate(positions), np.concatenate(densities), drawn


def block_boundaries(n_rows: int, blocks: int) -> tuple[int, ...]:
    """Prefix lengths of a sequential method: at most ``blocks``, which double and end at ``n_rows``. Their sum stays
    below ``2 n_rows``.

    Raises:
        InputError: no row, or no block.
    """
    if n_rows < 1 or blocks < 1:
        raise InputError("a schedule needs at least one row and one block", where="[inference] blocks")
    raw = [n_rows * 2.0 ** (k + 1 - blocks) for k in range(blocks)]
    return tuple(sorted({max(1, math.ceil(value - 1e-9)) for value in raw}))
