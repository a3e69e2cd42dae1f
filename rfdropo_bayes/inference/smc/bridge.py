"""From Laplace to the posterior: tempered SMC that starts at inflated Student-t distributions around the optima.

The start is close to the posterior, so few stages are needed, all at the full horizon: an evidence with a small
deviation for a small part of the rollouts that a start at the prior takes. Modes that no climb found are seen by the
particles that start at the prior, which are few.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem, ResidualProblem, Values
from rfdropo_bayes.cautions import Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.checkpoints import run_digest
from rfdropo_bayes.inference.evaluations import evaluate_prior
from rfdropo_bayes.inference.logbook import UNRECORDED, Logbook
from rfdropo_bayes.inference.modes.climb import Laplace
from rfdropo_bayes.inference.modes.search import LaplaceConfig, Modes, find_modes, mode_values
from rfdropo_bayes.inference.result import (
    InferenceResult,
    exclusion_cautions,
    prior_cautions,
    replicate_cautions,
    stage_cautions,
)
from rfdropo_bayes.inference.smc import sampler as horizon_smc
from rfdropo_bayes.inference.smc.mixture import ModeMixture, covering
from rfdropo_bayes.inference.smc.soundings import Sounding, sounded
from rfdropo_bayes.inference.smc.straight import StraightProblem

SOUNDINGS = 0.1  # share of the budget that soundings may take, see `soundings`


@dataclass(frozen=True)
class BridgeConfig:
    """Bridge: posterior and an evidence that scatters little, by SMC from the optima to the posterior.

    Attributes:
        climb: settings of the search for optima.
        inflation: of the Student-t's scale over the Laplace standard deviation.
        degrees: of freedom of the Student-t.
        prior_share: of the particles that start at prior draws, for what no climb has found.
        rollouts: budget of soundings and sampler in full-length rollouts, of all replicates together; None for no
            limit.
        particles: per replicate; None takes as many as the budget serves.
        replicates: independent repetitions.
        target_ess: share of effective particles kept from one target to the next.
        draws: as of `SmcConfig`.
    """

    climb: LaplaceConfig = field(default_factory=LaplaceConfig)
    inflation: float = 1.5
    degrees: float = 5.0
    prior_share: float = 0.05
    rollouts: float | None = None
    particles: int | None = 500
    replicates: int = 4
    target_ess: float = 0.5
    draws: int = 400

    def __post_init__(self) -> None:
        if self.inflation < 1.0 or self.degrees <= 0.0:
            raise InputError("inflation must be at least 1 and degrees positive", where="[inference]")
        if not 0.0 <= self.prior_share < 1.0:
            raise InputError("prior_share must be at least 0 and below 1", where="[inference]")

    @property
    def for_soundings(self) -> float:
        """Rollouts that soundings may take: a share of the budget, and nothing of the least that the sampler needs."""
        if self.rollouts is None:
            return float("inf")
        # Every particle is looked at once and moved once.
        least = 2.0 * self.replicates * (self.particles or horizon_smc.FEWEST_PARTICLES)
        return max(0.0, min(SOUNDINGS * self.rollouts, self.rollouts - least))

    @property
    def sampler(self) -> horizon_smc.SmcConfig:
        """The same as settings of the sampler."""
        return horizon_smc.SmcConfig(
            rollouts=self.rollouts,
            particles=self.particles,
            replicates=self.replicates,
            blocks=1,
            target_ess=self.target_ess,
            draws=self.draws,
        )


class BridgedProblem:
    """A problem whose "prior" is a `ModeMixture` of another, in its coordinates.

    Its one row is ``log prior + log likelihood - log mixture``, so that its evidence is the other's.
    """

    def __init__(self, problem: Problem, modes: list[Laplace], config: BridgeConfig) -> None:
        self.problem = problem
        self.mixture = ModeMixture(problem, modes, config.inflation, config.degrees, config.prior_share)
        self.names = tuple(f"u{j}" for j in range(self.mixture.means.shape[1]))
        self.units = dict.fromkeys(self.names, "1")
        self.bounds = dict.fromkeys(self.names, (-np.inf, np.inf))
        self.n_rows = 1
        self.fingerprint = getattr(problem, "fingerprint", "")
        self.status_names = getattr(problem, "status_names", {})

    def sample_prior(self, key: PRNGKeyArray, n: int) -> dict[str, Float[Any, " n"]]:
        """Draws of the mixture."""
        return self.from_unconstrained(self.mixture.sample(key, n))

    def to_unconstrained(self, values: Values) -> Float[Any, "n d"]:
        """Columns in the order of ``names``."""
        return np.stack([np.asarray(values[name]) for name in self.names], axis=-1)

    def from_unconstrained(self, u: Float[Any, "n d"]) -> dict[str, Float[Any, " n"]]:
        """Columns by name."""
        return {name: u[:, j] for j, name in enumerate(self.names)}

    def log_prior(self, u: Float[Any, "n d"]) -> Float[Any, " n"]:
        """Log density of the mixture."""
        return self.mixture.log_density(u)

    def row_log_likelihood(self, values: Values, horizon: int) -> tuple[Float[Any, "n 1"], Int[Any, " n"]]:
        """What the mixture lacks to the posterior."""
        u = self.to_unconstrained(values)
        rows, status = self.problem.row_log_likelihood(
            self.problem.from_unconstrained(jnp.asarray(u)), self.problem.n_rows
        )
        density = evaluate_prior(self.problem, u) + np.asarray(rows).sum(axis=1)
        return (density - self.mixture.log_density(u))[:, None], np.asarray(status)


def run(
    problem: Problem,
    config: BridgeConfig,
    key: PRNGKeyArray,
    logbook: Logbook = UNRECORDED,
) -> InferenceResult:
    """Find the optima, then sample from around them to the posterior."""
    climb_key, sample_key = jax.random.split(key)
    digest = run_digest(problem, "bridge", config, key)
    checkpoint = logbook.checkpoint("bridge_climbs", digest)
    found = find_modes(problem, config.climb, climb_key, checkpoint, logbook.part(0.0, 0.5))
    return sample_from_modes(problem, config, found, sample_key, logbook.part(0.5, 1.0))


def sample_from_modes(
    problem: Problem,
    config: BridgeConfig,
    found: Modes,
    key: PRNGKeyArray,
    logbook: Logbook = UNRECORDED,
) -> InferenceResult:
    """Sample from around optima that are known to the posterior; the climbs' cost is part of the result's."""
    moment_key, run_key = jax.random.split(key)
    view: Problem = problem
    modes, ledger, sampler = found.modes, found.climbs.ledger, config.sampler
    began, before = time.monotonic(), ledger.rollouts
    if isinstance(problem, ResidualProblem) and found.climbs.noise is not None:
        view = straight = StraightProblem(problem, moment_key)
        sounding = Sounding(straight, straight.logarithmic, found.climbs.noise, ledger)
        modes = sounded(sounding, [straight.mode(mode) for mode in modes], moment_key, config.for_soundings)
        if sampler.rollouts is not None:
            sampler = replace(sampler, rollouts=sampler.rollouts - (ledger.rollouts - before))
    facts = {"sounded": len(modes) - len(found.modes), "sounding_rollouts": ledger.rollouts - before}
    seconds = time.monotonic() - began
    bridged = BridgedProblem(view, covering(view, modes, moment_key), config)
    sampled = horizon_smc.run(bridged, sampler, run_key, logbook)
    u = np.stack([sampled.draws[name] for name in bridged.names], axis=-1)
    values = view.from_unconstrained(jnp.asarray(u.reshape(-1, u.shape[-1])))
    draws = {name: np.asarray(values[name], dtype=float).reshape(u.shape[:2]) for name in problem.names}
    excluded = ledger.excluded + Counter(sampled.excluded)
    evaluations = ledger.evaluations + sampled.evaluations
    # Several optima are what the mixture is for: no caution here, unlike in Laplace alone.
    # What the sampler says of coordinates, and of its share of rollouts, is said below of parameters and of all.
    kept = stage_cautions(sampled.trace, sampler.rollouts, sampler.correlation)
    kept += replicate_cautions(draws, np.asarray(sampled.details["log_evidence_replicates"]))
    kept += [caution for caution in found.cautions if caution.code is Code.CLIMB_UNFINISHED]
    return replace(
        sampled,
        method="bridge",
        draws=draws,
        prefix_log_evidence=None,
        block_scores=[],
        log_likelihood=None,
        trace=[*found.climbs.trace, *sampled.trace],
        rollouts=ledger.rollouts + sampled.rollouts,
        evaluations=evaluations,
        excluded=dict(excluded),
        cautions=[*kept, *prior_cautions(problem, draws), *exclusion_cautions(excluded, evaluations)],
        seconds=found.climbs.seconds + seconds + sampled.seconds,
        optimum=mode_values(problem, found.modes[0]),
        details=sampled.details
        | facts
        | {"laplace_log_evidence": [mode.log_evidence for mode in found.modes], "modes": len(found.modes)},
    )
