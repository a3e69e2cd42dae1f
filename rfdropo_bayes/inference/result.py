"""Result of every inference method."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.stats import skew

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.posteriors import contradiction, contradicts, cut_off_at

SCATTERED = 0.5  # nats
APART = 1.1  # R-hat: the means of replicates scatter by nearly half of the posterior's width
STUCK = 0.7  # correlation with their start that last moves may leave unsaid
PRIOR_DRAWS = 2000  # they show the range of a prior, and whether it is logarithmic

Draws = dict[str, Float[np.ndarray, "chain draw"]]


@dataclass(frozen=True)
class InferenceResult:
    """Draws of equal weight, and facts about the run."""

    method: str  # registry name of the method
    draws: Draws  # one array (chain, draw) per parameter, physical units; independent repetitions are chains
    # value and standard deviation in nats, or None; the deviation is NaN if it was not measured
    log_evidence: tuple[float, float] | None = None
    # log p(first h rows) for h = 1 ... n_rows, NaN if the method did not pass h; or None.
    prefix_log_evidence: Float[np.ndarray, " n_rows"] | None = None
    # prequential scores: per block ``first_row``, ``last_row`` (1-based, inclusive), ``log_score`` = log p(block | rows
    # before it) and its ``sd`` over repetitions
    block_scores: list[dict[str, Any]] = field(default_factory=list)
    # (chain, draw, row) log density of each row at each draw, or None
    log_likelihood: Float[np.ndarray, "chain draw row"] | None = None
    trace: list[dict[str, Any]] = field(default_factory=list)  # one dictionary per stage
    rollouts: float = 0.0  # full-length equivalents used
    evaluations: int = 0  # parameter sets tried
    excluded: dict[str, int] = field(default_factory=dict)  # parameter sets that got no weight, by reason
    cautions: list[Caution] = field(default_factory=list)  # reasons to doubt the draws
    seconds: float = 0.0  # time spent, earlier parts of a resumed run included
    # distribution to randomise over, {name: {mean, std, low, high, unit}}, of RF-DROPO; else None
    phi: dict[str, dict[str, Any]] | None = None
    fixed: dict[str, float] = field(default_factory=dict)  # {name: value} of fixed parameters
    optimum: dict[str, float] | None = None  # posterior mode {name: value} if the method finds it; else None
    details: dict[str, Any] = field(default_factory=dict)  # further numbers of the method, plain values

    @property
    def spent(self) -> Ledger:
        """Rollouts, evaluations and exclusions together."""
        return Ledger(self.rollouts, self.evaluations, Counter(self.excluded))


def chains(problem: Problem, positions: list[np.ndarray]) -> Draws:
    """Unconstrained draws, one array per chain, as named values in physical units."""
    values = [problem.from_unconstrained(jnp.asarray(u)) for u in positions]
    return {name: np.stack([np.asarray(v[name], dtype=float) for v in values]) for name in problem.names}


def prior_cautions(problem: Problem, draws: Draws) -> list[Caution]:
    """Cautions for parameters whose posterior mode lies at a bound or an end of the prior, and for parameters in a
    region of little prior mass.

    A prior that is more uniform in the logarithm is compared with its bounds in logarithms: a scale over decades has
    most of its linear mass near the lower end.
    """
    drawn, ends = problem.sample_prior(jax.random.key(0), PRIOR_DRAWS), problem.prior_ends
    cautions, apart = [], []
    for name, values in draws.items():
        values, (low, high), prior = np.ravel(values), ends[name], np.asarray(drawn[name], dtype=float)
        side = cut_off_at(values, low, high)
        if side and np.all(prior > 0.0) and abs(skew(np.log(prior))) < abs(skew(prior)):
            side = cut_off_at(values, low, high, logarithmic=True)
        if side:
            word, end = ("lower", low) if side == "low" else ("upper", high)
            hard = np.isclose(end, problem.bounds[name], rtol=1e-6, atol=0.0).any()
            what = f"its {word} bound {end:g}" if hard else f"the {word} end {end:g} of its prior"
            sentence = f"{name} sits on {what}, which decides it instead of the data"
            cautions.append(Caution(Code.AT_BOUND, sentence))
        elif contradicts(values, prior):
            apart.append(name)
    return cautions + [Caution(Code.AGAINST_PRIOR, contradiction(apart))] * bool(apart)


def stage_cautions(trace: list[dict[str, Any]], rollouts: float | None) -> list[Caution]:
    """Cautions from the stages of all replicates: an exhausted budget, or particles that did not move.

    Args:
        trace: a dictionary per stage, as in the result of `smc.sampler`.
        rollouts: their budget.
    """
    cautions = []
    leaps = [row for row in trace if row["budget_exhausted"] and not row.get("final")]
    if leaps:
        worst, whole = min(row["ess"] for row in leaps), max(row["progress"] for row in trace)
        place = f" at row {leaps[0]['progress']:g}" if whole > 1.0 else ""
        sentence = (
            f"the budget of {rollouts:.0f} rollouts ran out{place}: the rest of the data was brought in by "
            f"reweighting only (effective share {worst:.2%}); allow more rollouts or use fewer particles"
        )
        cautions.append(Caution(Code.BUDGET_SPENT, sentence, grave=True))
    if (stuck := max(row["correlation"] for row in trace if row.get("final"))) > STUCK:
        sentence = (
            f"the last moves left the particles {stuck:.2f} correlated with their old positions, so that "
            "the posterior may be too narrow: several modes, a rugged likelihood, or a shape that moves "
            "cannot follow; compare replicates"
        )
        cautions.append(Caution(Code.PARTICLES_STUCK, sentence, grave=True))
    return cautions


def replicate_cautions(draws: Draws, log_evidence: Float[np.ndarray, " chain"]) -> list[Caution]:
    """Cautions if independent repetitions disagree on the evidence or on parameters (R-hat)."""
    if len(log_evidence) < 2:
        return []
    cautions, sd = [], float(np.std(log_evidence, ddof=1))
    if sd > SCATTERED:
        sentence = (
            f"the log evidences of {len(log_evidence)} replicates scatter by {sd:.2g}: compare models "
            "only if they differ by several times that, or take more particles"
        )
        cautions.append(Caution(Code.EVIDENCE_SCATTERED, sentence))
    apart = {}
    for name, values in draws.items():
        within = float(np.mean(np.var(values, axis=1, ddof=1)))
        if within > 0.0:
            apart[name] = float(np.sqrt(1.0 + np.var(values.mean(axis=1), ddof=1) / within))
    worst = sorted((name for name in apart if apart[name] > APART), key=lambda name: -apart[name])
    if worst:
        others = f" and {len(worst) - 3} more" if len(worst) > 3 else ""
        sentence = (
            f"replicates disagree about {', '.join(worst[:3])}{others} (R-hat {apart[worst[0]]:.2f}): some have "
            "not seen all of the posterior"
        )
        cautions.append(Caution(Code.REPLICATES_DISAGREE, sentence))
    return cautions


def unseen_modes(replicates: int, optimisations: int | None = None) -> list[Caution]:
    """A caution if a lost mode would be unnoticed, since the particles of a replicate may end in a single mode.

    Args:
        replicates: independent repetitions of the sampler.
        optimisations: number of independent optimisations for the starts of all replicates; None for starts at the
        prior.
    """
    if replicates > 1 and optimisations != 1:
        return []
    alone = "one replicate" if replicates == 1 else "a single optimisation"
    sentence = (
        f"{alone} cannot show whether other modes of the posterior were lost: allow more rollouts, state "
        "replicates = 4, or compare seeds"
    )
    return [Caution(Code.MODES_UNSEEN, sentence)]


def exclusion_cautions(excluded: Mapping[str, int], evaluations: int) -> list[Caution]:
    """A caution if more than 5 % of the simulations were excluded."""
    total = sum(excluded.values())
    if evaluations == 0 or total / evaluations <= 0.05:
        return []
    reasons = ", ".join(f"{name} {count}" for name, count in sorted(excluded.items()))
    sentence = f"{total} of {evaluations} simulations got no weight ({reasons})"
    return [Caution(Code.ROLLOUTS_EXCLUDED, sentence)]
