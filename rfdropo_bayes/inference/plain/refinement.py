"""Plain models in two passes: from the prior along prefixes of the data, then again from where that arrived.

Data of a plain model are no time series, and a prior a thousand times wider than the posterior makes the first pass
long: each of its dozens of stages adds to the scatter of the evidence. Where it ended is known well enough, however, to
fit distributions that cover the posterior. A second pass from there takes few stages, all with the whole data, and
what it says of posterior and evidence is as exact as if they had been a lucky guess: their mixture is normalised, and a
share of it is the prior, which bounds every weight.

A narrow posterior under priors that say next to nothing may be lost on the first way, by some replicates or by all
alike. Climbs look for optima beside it, and distributions around these join the mixture.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from numpyro.distributions import MultivariateStudentT
from scipy.linalg import solve_triangular
from scipy.special import expit, logit, logsumexp

from rfdropo_bayes.bayes.problem import ProblemDefaults, Values
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows
from rfdropo_bayes.inference.modes.climb import Laplace
from rfdropo_bayes.inference.modes.mode_search import LaplaceConfig, Modes, find_modes
from rfdropo_bayes.inference.plain.plain_problem import CentredProblem, NumpyroProblem, centred
from rfdropo_bayes.inference.progress import UNRECORDED, Logbook
from rfdropo_bayes.inference.result import (
    InferenceResult,
    exclusion_cautions,
    prior_cautions,
    replicate_cautions,
)
from rfdropo_bayes.inference.smc import sampler
from rfdropo_bayes.inference.smc.bridge import BridgeConfig, BridgedProblem, ModeMixture
from rfdropo_bayes.inference.smc.moves import SlopedProblem, chosen_kernel, fit_reference, host_generator
from rfdropo_bayes.inference.smc.sampler import SmcConfig

TWO_PASSES = "smc_in_two_passes"
MOST_ROWS = 5000  # that a first pass takes one after the other, at the cost of all of them each time
REPLICATES = 4  # instead of a single one, whose evidence would have no deviation
FORGOTTEN, MOST_MOVES = 0.1, 40  # correlation with its start that a stage of the second pass goes on to, if it can
INFLATION, DEGREES = 1.1, 5.0  # of the Student-t's that are fitted
CLUSTERS, FRUITLESS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32), 3  # how many are tried, and in vain before the search ends
CLUSTER_DRAWS = 10  # that each needs for every coordinate
NARROWEST = 1e-4  # least deviation of a cluster, as a share of that of all draws
LEAST_PRIOR = 0.05  # share of the prior beside it
LOST = 0.3  # nats that passes may differ by beyond what their replicates explain
ROUNDS = 30  # of expectation maximisation, for that share
DISAGREEMENT = 0.5  # deviation of evidences [nat] from which some replicates of the first pass have lost something
CLIMBED = 0.25  # share of the optima that climbs find, before normalising; the rest is that of the clusters


class SlopedBridge(BridgedProblem):
    """A `BridgedProblem` whose way to the posterior JAX can differentiate."""

    def path_density(self, u: Float[Array, " d"], shares: Float[Array, " 1"]) -> Float[Array, ""]:
        """Log density between the mixture and the posterior, at one point; traceable."""
        none = jnp.zeros(self.problem.n_rows)
        parts = [
            jnp.log(share) + MultivariateStudentT(self.mixture.degrees, mean, factor).log_prob(u)
            for share, mean, factor in zip(self.mixture.share, self.mixture.means, self.mixture.factors, strict=True)
        ]
        prior = self.problem.path_density(u, none)  # type: ignore[attr-defined]
        mixture = jax.scipy.special.logsumexp(jnp.stack([*parts, np.log(self.mixture.prior_share) + prior]))
        posterior = self.problem.path_density(u, none + 1.0)  # type: ignore[attr-defined]
        return mixture + shares[0] * (posterior - mixture)


class WholeProblem(ProblemDefaults):
    """A plain model whose data come in together: what its rows say is one row.

    Data that are many, or speak of one parameter after the other, as groups of a hierarchy do, make prefixes a longer
    way than a temperature of them all.
    """

    def __init__(self, problem: SlopedProblem) -> None:
        self.problem, self.n_rows = problem, 1
        self.names, self.units, self.bounds = problem.names, problem.units, problem.bounds
        self.fingerprint = f"{problem.fingerprint} whole"
        self.status_names = problem.status_names
        self.sample_prior, self.log_prior = problem.sample_prior, problem.log_prior
        self.to_unconstrained, self.from_unconstrained = problem.to_unconstrained, problem.from_unconstrained

    def row_log_likelihood(self, values: Values, horizon: int) -> tuple[Float[Any, "n 1"], Int[Any, " n"]]:
        """Log likelihood of all rows."""
        rows, status = self.problem.row_log_likelihood(values, self.problem.n_rows)
        return np.asarray(rows).sum(axis=1, keepdims=True), status

    def path_density(self, u: Float[Array, " d"], shares: Float[Array, " 1"]) -> Float[Array, ""]:
        """Log prior plus the log likelihood times a share, at one point; traceable."""
        return self.problem.path_density(u, jnp.full(self.problem.n_rows, shares[0]))


def run(
    problem: NumpyroProblem,
    config: SmcConfig,
    key: PRNGKeyArray,
    logbook: Logbook = UNRECORDED,
) -> InferenceResult:
    """Sample a plain model's posterior in two passes, see above; the evidence of prefixes is the first pass's,
    corrected by what the second says of the whole."""
    first_key, second_key = jax.random.split(key)
    config = replace(config, replicates=config.replicates or REPLICATES)
    large = chosen_kernel(config.kernel, problem, None) == "hamiltonian"
    whole = large or problem.n_rows > MOST_ROWS
    first = sampler.run(WholeProblem(problem) if whole else problem, config, first_key, logbook.part(0.0, 0.5))
    values = {name: jnp.asarray(first.draws[name].ravel()) for name in problem.names}
    view = centred(problem, _finite(problem.to_unconstrained(values)))
    seed = int(host_generator(jax.random.fold_in(second_key, 1)).integers(2**31))
    assert first.log_evidence is not None
    lost = first.log_evidence[1] >= DISAGREEMENT
    # Hessians of many parameters take long.
    climbed = _climbed(problem, jax.random.fold_in(second_key, 2)) if view is problem and (lost or not large) else None
    bridged = _cover(view, _finite(view.to_unconstrained(values)), climbed.modes if climbed else [], seed)
    correlation, moves = min(config.correlation, FORGOTTEN), max(config.max_moves, MOST_MOVES)
    settings = replace(config, blocks=1, correlation=correlation, max_moves=moves)
    second = sampler.run(bridged, settings, second_key, logbook.part(0.5, 1.0, "refined"))
    joined = _joined(problem, bridged, first, second)
    if climbed is not None:
        ledger = climbed.climbs.ledger
        joined = replace(joined, **(joined.spent + ledger).record(), seconds=joined.seconds + climbed.climbs.seconds)
    assert second.log_evidence is not None
    comparable = not whole and view is problem and not lost
    if comparable and first.log_evidence[1] < second.log_evidence[1] and not _differ(first, second):
        # A shape that the fit does not cover: the way from the prior is as good, and misses no mode.
        return replace(first, **joined.spent.record(), seconds=joined.seconds)
    return joined


def _climbed(problem: NumpyroProblem, key: PRNGKeyArray) -> Modes | None:
    """Optima of the whole posterior, their evidences scaled to their part of the mixture.

    None where no climb finds a start, or the model has no second derivatives.
    """
    try:
        found = find_modes(problem, LaplaceConfig(), key)
    except InputError:
        return None
    modes = [mode for mode in found.modes if _proper(mode)]
    if not modes:
        return None
    shift = float(np.log(CLIMBED) - logsumexp([mode.log_evidence for mode in modes]))
    return found._replace(modes=[mode._replace(log_density=mode.log_density + shift) for mode in modes])


def _proper(mode: Laplace) -> bool:
    try:
        np.linalg.cholesky(mode.covariance)
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(mode.log_evidence))


def _with_evidence(mode: Laplace, share: float) -> Laplace:
    return mode._replace(log_density=mode.log_density + float(np.log(share)) - mode.log_evidence)


def _finite(u: Float[Any, "n d"]) -> Float[np.ndarray, "m d"]:
    u = np.asarray(u, dtype=float)
    return u[np.isfinite(u).all(axis=1)]


def _cover(problem: SlopedProblem, u: Float[np.ndarray, "n d"], climbed: list[Laplace], seed: int) -> SlopedBridge:
    """Student-t's that cover draws, all chains together, and optima, and as much of the prior as fits the draws best.

    A posterior as sharp as a normal needs none of the prior, but for defence; one that is the prior in some of its
    parameters, or ends at bounds, may need more of it than of the Student-t's.
    """
    modes = [*_clusters(u, seed), *climbed]
    lone = ModeMixture(problem, modes, INFLATION, DEGREES, 0.0).log_density(u)
    advantage = evaluate_prior(problem, u) - lone
    share = 0.5
    for _ in range(ROUNDS):
        share = float(np.clip(expit(advantage + logit(share)).mean(), LEAST_PRIOR, 1.0 - LEAST_PRIOR))
    return SlopedBridge(problem, modes, BridgeConfig(inflation=INFLATION, degrees=DEGREES, prior_share=share))


def _clusters(u: Float[np.ndarray, "n d"], seed: int) -> list[Laplace]:
    """Normals that together describe draws: as many as have the lowest Bayesian information criterion, and draws
    enough to know their covariances."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    mean, factor = fit_reference(u, np.full(len(u), 1.0 / len(u)))
    white = np.unique(solve_triangular(factor, (u - mean).T, lower=True).T, axis=0)  # copies are a cluster of no width
    needed = CLUSTER_DRAWS * (u.shape[1] + 1)
    best, lowest, fruitless = None, np.inf, 0
    for count in CLUSTERS:
        if count * needed > len(white) or fruitless == FRUITLESS:
            break
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a rough fit covers as well
            found = GaussianMixture(count, reg_covar=NARROWEST**2, random_state=seed).fit(white)
        criterion = found.bic(white) if found.weights_.min() * len(white) > 0.5 * needed else np.inf
        best, lowest, fruitless = (found, criterion, 0) if criterion < lowest else (best, lowest, fruitless + 1)
    if best is None or len(best.weights_) == 1:
        return [_with_evidence(Laplace(mean, factor @ factor.T, 0.0), 1.0)]
    modes = []
    for share, centre, covariance in zip(best.weights_, best.means_, best.covariances_, strict=True):
        modes.append(_with_evidence(Laplace(mean + factor @ centre, factor @ covariance @ factor.T, 0.0), share))
    return modes


def _joined(
    problem: NumpyroProblem,
    bridged: BridgedProblem,
    first: InferenceResult,
    second: InferenceResult,
) -> InferenceResult:
    u, draws = bridged.carried_back(second.draws, problem.names)
    view, ledger = bridged.problem, Ledger()
    rows = evaluate_rows(view, u.reshape(-1, u.shape[-1]), problem.n_rows, ledger)
    spent = first.spent + second.spent + ledger
    assert first.prefix_log_evidence is not None
    assert second.log_evidence is not None
    prefixes = np.full(problem.n_rows, np.nan)
    prefixes[-len(first.prefix_log_evidence) :] = _corrected(first, second.log_evidence[0])
    if len(first.block_scores) == 1:
        value, sd = second.log_evidence
        blocks = [{"first_row": 1, "last_row": problem.n_rows, "log_score": value, "sd": sd}]
    else:
        before = np.concatenate([[0.0], prefixes])
        blocks = [
            b | {"log_score": float(prefixes[b["last_row"] - 1] - before[b["first_row"] - 1])}
            for b in first.block_scores
        ]
    replicates = np.asarray(second.details["log_evidence_replicates"])
    # Replicates that agree need no moves: what covers the posterior has been weighted well enough.
    apart = replicate_cautions(draws, replicates) + _unlike(first, second)
    return replace(
        first,
        draws=draws,
        log_evidence=second.log_evidence,
        prefix_log_evidence=prefixes,
        block_scores=blocks,
        log_likelihood=rows.reshape(*u.shape[:2], -1),
        trace=[*first.trace, *second.trace],
        **spent.record(),
        cautions=[
            *prior_cautions(problem, draws),
            *exclusion_cautions(spent.excluded, spent.evaluations),
            *([caution for caution in second.cautions if caution.code is Code.PARTICLES_STUCK] if apart else []),
            *apart,
        ],
        seconds=first.seconds + second.seconds,
        details=first.details
        | {
            "algorithm": TWO_PASSES,
            "horizons": tuple(block["last_row"] for block in blocks),
            "log_evidence_replicates": replicates.tolist(),
            "log_evidence_first_pass": first.log_evidence,
            "prior_share": bridged.mixture.prior_share,
            "centring": view.share.tolist() if isinstance(view, CentredProblem) else None,
        },
    )


def _corrected(first: InferenceResult, value: float) -> Float[np.ndarray, " n_rows"]:
    """Evidence of prefixes by the first pass, given what the second says of the whole.

    Errors of stages add up like the steps of a random walk. Where it ended is known: on the way there it had, on
    average, as much of the whole error as of the steps.
    """
    assert first.prefix_log_evidence is not None
    assert first.log_evidence is not None
    ends = np.sort([row["progress"] for row in first.trace if not row.get("final")])
    rows = np.arange(1, len(first.prefix_log_evidence) + 1)
    share = np.searchsorted(ends, rows, side="right") / len(ends)
    return first.prefix_log_evidence + share * (value - first.log_evidence[0])


def _differ(first: InferenceResult, second: InferenceResult) -> float:
    """How much higher the first pass's evidence is; 0 where it is by no more than replicates explain."""
    assert first.log_evidence is not None
    assert second.log_evidence is not None
    replicates = len(second.details["log_evidence_replicates"])
    more = first.log_evidence[0] - second.log_evidence[0]
    explained = LOST + 4.0 * np.hypot(first.log_evidence[1], second.log_evidence[1]) / np.sqrt(replicates)
    return more if abs(more) >= explained else 0.0


def _unlike(first: InferenceResult, second: InferenceResult) -> list[Caution]:
    """A caution where the passes find different evidences: one can be too low by what was missed."""
    more = _differ(first, second)
    if not more:
        return []
    higher, lower = ("first", "second") if more > 0.0 else ("second", "first")
    sentence = (
        f"the log evidence of the {higher} pass is higher by {abs(more):.2g}: the {lower} may have lost a part of the "
        'posterior; compare with start = "prior"'
    )
    return [Caution(Code.PASSES_DISAGREE, sentence)]
