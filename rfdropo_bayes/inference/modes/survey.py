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
from rfdropo_bayes.inference.checkpoints import Checkpoint, run_digest
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior
from rfdropo_bayes.inference.logbook import Logbook
from rfdropo_bayes.inference.smc import sampler as horizon_smc
from rfdropo_bayes.inference.smc.straight import StraightProblem

MOST_MOVES = 8  # of a stage: climbs need a place in the right basins, not a fair sample of them


class Survey(NamedTuple):
    """Particles that have arrived at the posterior of a prefix, and not been moved there yet: places to climb from.

    Attributes:
        positions: unconstrained, in the problem's own coordinates.
        log_density: log posterior of the prefix there, unnormalised; minus infinity where the rollout is lost.
    """

    positions: Float[np.ndarray, "n d"]
    log_density: Float[np.ndarray, " n"]


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
) -> list[Survey]:
    """Temper particles to the posteriors of growing prefixes.

    Args:
        problem: to be climbed.
        horizons: the prefixes.
        particles: their number.
        rollouts: budget in full-length rollouts; None for no limit.
        key: random key.
        ledger: is charged.
        logbook: for the checkpoint, and where stages are reported.

    Returns:
        one survey for each prefix.

    Raises:
        NoLikelihoodError: no particle has a positive likelihood.
    """
    straight_key, run_key = jax.random.split(key)
    blocks = BlockProblem(StraightProblem(problem, straight_key), horizons)
    # The sampler takes blocks for rows of equal cost, which is more than short ones cost.
    whole = None if rollouts is None else rollouts * problem.n_rows / horizons[-1]
    config = horizon_smc.SmcConfig(
        rollouts=whole,
        particles=particles,
        kernel="crank_nicolson",
        blocks=len(horizons),
        spacing="linear",
        max_moves=MOST_MOVES,
        draws=1,
    )
    checkpoint = logbook.checkpoint("survey", run_digest(blocks, "survey", config, run_key))
    populations, state = _populations(blocks, config, run_key, checkpoint, logbook)
    _charge(problem, horizons, state.trace, ledger)
    ledger.excluded.update(state.ledger.excluded)
    found = []
    for block, (position, rows) in enumerate(populations, start=1):
        values = blocks.from_unconstrained(jnp.asarray(position))
        u = np.asarray(problem.to_unconstrained(values), dtype=float)
        found.append(Survey(u, evaluate_prior(problem, u) + rows[:, :block].sum(axis=1)))
    return found


def _populations(
    blocks: BlockProblem, config: horizon_smc.SmcConfig, key: PRNGKeyArray, checkpoint: Checkpoint, logbook: Logbook
) -> tuple[list[tuple[np.ndarray, np.ndarray]], horizon_smc.SmcState]:
    """Positions and rows of the particles at the end of each block, and the sampler's last state."""
    init_key, stage_key = jax.random.split(key)
    plan = horizon_smc.make_plan(blocks, config)
    ends: list[tuple[np.ndarray, np.ndarray]] = []
    saved = checkpoint.load()
    if saved is None:
        state = horizon_smc.init(init_key, blocks, plan, config)
    else:
        arrays, meta = saved
        state = horizon_smc.unpack(arrays, meta)
        ends = [(arrays[f"positions_{block}"], arrays[f"rows_{block}"]) for block in range(meta["ends"])]
    while not state.finished:
        state, _ = horizon_smc.step(stage_key, state, blocks, plan, config)
        population = state.population
        if population.progress == len(ends) + 1:
            ends.append((population.position, population.rows))
        arrays, meta = horizon_smc.pack(state)
        for block, (position, rows) in enumerate(ends):
            arrays |= {f"positions_{block}": position, f"rows_{block}": rows}
        checkpoint.save(arrays, meta | {"ends": len(ends)})
        facts = {name: state.trace[-1][name] for name in ("ess", "acceptance", "moves")}
        share, horizon = population.progress / blocks.n_rows, blocks.horizons[state.block]
        logbook.stage(share, method="survey", stage=state.stage, horizon=horizon, **facts)
    return ends, state


def _charge(problem: ResidualProblem, horizons: tuple[int, ...], trace: list[dict[str, Any]], ledger: Ledger) -> None:
    """What the sampler counted in blocks, in rows."""
    before = 0.0
    for stage in trace:
        block, spent = stage["horizon"], stage["rollouts"]
        ledger.charge(problem, round((spent - before) * len(horizons) / block), horizons[block - 1])
        before = spent
