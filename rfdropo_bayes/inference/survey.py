"""Where climbs start on a rugged posterior: particles tempered from the prior to the posterior of a short prefix.

A climb ends on the first of many small summits, and the best of some prior draws need not lie near the highest. At a
low temperature small summits are none: a population that is cooled slowly ends in the basins that hold the mass of the
posterior, at a horizon at which rollouts are cheap.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from rfdropo_bayes.bayes.problem import ResidualProblem, Values
from rfdropo_bayes.inference import horizon_smc
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior
from rfdropo_bayes.inference.logbook import Logbook
from rfdropo_bayes.inference.straight import StraightProblem

MOST_MOVES = 8  # of a stage: climbs need a place in the right basins, not a fair sample of them


class Survey(NamedTuple):
    """Particles at the posterior of a prefix.

    Attributes:
        positions: unconstrained, in the problem's own coordinates.
        log_density: log posterior of the prefix there, unnormalised.
        trace: of the sampler.
    """

    positions: Float[np.ndarray, "n d"]
    log_density: Float[np.ndarray, " n"]
    trace: list[dict[str, Any]]


class BlockProblem:
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


def survey(
    problem: ResidualProblem,
    horizons: tuple[int, ...],
    particles: int,
    rollouts: float | None,
    key: PRNGKeyArray,
    ledger: Ledger,
    logbook: Logbook,
) -> Survey:
    """Sample the posterior of a prefix, on the way through shorter ones.

    Args:
        problem: to be climbed.
        horizons: prefixes on the way, and the last one.
        particles: their number.
        rollouts: budget in full-length rollouts; None for no limit.
        key: random key.
        ledger: is charged.
        logbook: for checkpoints, in a folder of their own.

    Raises:
        InputError: no particle has a positive likelihood.
    """
    straight_key, run_key = jax.random.split(key)
    blocks = BlockProblem(StraightProblem(problem, straight_key), horizons)
    # The sampler takes blocks for rows of equal cost, which is more than short ones cost.
    whole = None if rollouts is None else rollouts * problem.n_rows / horizons[-1]
    config = horizon_smc.SmcConfig(
        rollouts=whole, particles=particles, blocks=len(horizons), spacing="linear", max_moves=MOST_MOVES, draws=1
    )
    folder = None if logbook.folder is None else logbook.folder / "survey"
    found = horizon_smc.run(blocks, config, run_key, Logbook(folder, logbook.resume))
    _charge(problem, horizons, found.trace, ledger)
    ledger.excluded.update(found.excluded)
    values = {name: jnp.asarray(found.draws[name][0]) for name in problem.names}
    u = np.asarray(problem.to_unconstrained(values), dtype=float)
    assert found.log_likelihood is not None
    return Survey(u, evaluate_prior(problem, u) + found.log_likelihood[0].sum(axis=1), found.trace)


def _charge(problem: ResidualProblem, horizons: tuple[int, ...], trace: list[dict[str, Any]], ledger: Ledger) -> None:
    """What the sampler counted in blocks, in rows."""
    before = 0.0
    for stage in trace:
        block, spent = stage["horizon"], stage["rollouts"]
        ledger.charge(problem, round((spent - before) * len(horizons) / block), horizons[block - 1])
        before = spent
