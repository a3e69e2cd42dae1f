"""The bridge: tempered SMC from Student-t distributions around known optima to the posterior.

The start is close to the posterior, so few stages are needed, all at the full horizon. The evidence is precise, and
takes a small part of the rollouts of a start at the prior. Only the few particles that start at the prior can reach
modes that no optimisation found.

Particles move in logarithms of positive parameters. Data that determine a product or a ratio of parameters, such as
stiffness over mass, leave a thin ridge. In logarithms it is a straight line, which a covariance can describe; in
coordinates that bend towards the bounds of a prior it is a curve, on which a sampler hardly moves. The disadvantage is
a wall at each bound, beyond which the density is zero.

The curvature of the prior at an optimum is a poor guide in directions without information from the likelihood. Along a
ridge between two bounds the optimum lies at an end, and the density falls off within a short distance of it. Each
optimum therefore has a second distribution as long as the ridge, from the likelihood's curvature and the prior's mean
and covariance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.special import gammaln, logsumexp

from rfdropo_bayes.bayes.problem import Problem, ProblemDefaults, ResidualProblem, Values
from rfdropo_bayes.cautions import Code
from rfdropo_bayes.inference.evaluations import evaluate_prior
from rfdropo_bayes.inference.modes.mode_search import Modes, mode_values
from rfdropo_bayes.inference.modes.optimisation import SAME, Laplace, divergence
from rfdropo_bayes.inference.progress import UNRECORDED, Logbook
from rfdropo_bayes.inference.result import (
    Draws,
    InferenceResult,
    exclusion_cautions,
    prior_cautions,
    replicate_cautions,
    stage_cautions,
    unseen_modes,
)
from rfdropo_bayes.inference.smc import sampler
from rfdropo_bayes.inference.smc.moves import StraightProblem, host_generator, squared_distance

INFLATION = 1.5  # of the Student-t's scale over the Laplace standard deviation
DEGREES = 5.0  # of freedom of the Student-t's
PRIOR_SHARE = 0.05  # of the particles that start at prior draws, for modes that no optimisation found
LEAST_SHARE = 0.05  # of a mode, before normalising: Laplace evidences of ill-shaped modes are off by nats
MOMENTS = 1000  # prior draws behind its mean and covariance
NARROWEST = 1e-6  # least deviation of a normal approximation in any direction, as a share of its largest one


class BridgedProblem(ProblemDefaults):
    """A problem whose "prior" is a `ModeMixture` of another, in its coordinates.

    The problem has one row, ``log prior + log likelihood - log mixture``, and the same evidence as the original
    problem.
    """

    def __init__(self, problem: Problem, modes: list[Laplace]) -> None:
        self.problem = problem
        self.mixture = ModeMixture(problem, modes, INFLATION, DEGREES, PRIOR_SHARE)
        self.names = tuple(f"u{j}" for j in range(self.mixture.means.shape[1]))
        self.units = dict.fromkeys(self.names, "1")
        self.bounds = dict.fromkeys(self.names, (-np.inf, np.inf))
        self.n_rows = 1
        self.fingerprint, self.status_names = problem.fingerprint, problem.status_names

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
        """Log posterior less log density of the mixture, as a single row."""
        u = self.to_unconstrained(values)
        rows, status = self.problem.row_log_likelihood(
            self.problem.from_unconstrained(jnp.asarray(u)), self.problem.n_rows
        )
        density = evaluate_prior(self.problem, u) + np.asarray(rows).sum(axis=1)
        return (density - self.mixture.log_density(u))[:, None], np.asarray(status)

    def carried_back(self, draws: Draws) -> Draws:
        """Draws from the bridge as draws of the other problem's parameters."""
        u = np.stack([draws[name] for name in self.names], axis=-1)
        values = self.problem.from_unconstrained(jnp.asarray(u.reshape(-1, u.shape[-1])))
        return {name: np.asarray(values[name], dtype=float).reshape(u.shape[:2]) for name in self.problem.names}


def sample_from_modes(
    problem: ResidualProblem, config: sampler.SmcConfig, optima: Modes, key: PRNGKeyArray, logbook: Logbook = UNRECORDED
) -> InferenceResult:
    """Sample from around optima that are known to the posterior; the result includes the cost of the optimisations."""
    moment_key, run_key = jax.random.split(key)
    straight = StraightProblem(problem, moment_key)
    modes = [straight.mode(mode) for mode in optima.modes]
    bridged = BridgedProblem(straight, covering(straight, modes, moment_key))
    sampled = sampler.run(bridged, config, run_key, logbook)
    draws = bridged.carried_back(sampled.draws)
    spent = optima.search.ledger + sampled.spent
    # Several optima are normal for the mixture: no caution here, unlike in Laplace alone. The sampler's cautions about
    # coordinates and its share of rollouts are restated below for parameters and the total.
    kept = stage_cautions(sampled.trace, config.rollouts)
    kept += replicate_cautions(draws, np.asarray(sampled.details["log_evidence_replicates"]))
    first = optima.search.trace[0]["horizon"]
    kept += unseen_modes(config.chains, sum(row["horizon"] == first for row in optima.search.trace))
    kept += [caution for caution in optima.cautions if caution.code is Code.OPTIMISATION_UNFINISHED]
    return replace(
        sampled,
        draws=draws,
        prefix_log_evidence=None,
        block_scores=[],
        log_likelihood=None,
        trace=[*optima.search.trace, *sampled.trace],
        **spent.record(),
        cautions=[*kept, *prior_cautions(problem, draws), *exclusion_cautions(spent.excluded, spent.evaluations)],
        seconds=optima.search.seconds + sampled.seconds,
        optimum=mode_values(problem, optima.modes[0]),
        details=sampled.details
        | {"laplace_log_evidence": [mode.log_evidence for mode in optima.modes], "modes": len(optima.modes)},
    )


class ModeMixture:
    """Inflated Student-t distributions around modes, with a share of draws from the prior.

    The prior has a share as a safeguard: unfound modes still have particles, and importance weights are bounded by the
    likelihood over that share.

    Args:
        problem: problem whose prior is mixed in.
        modes: normal approximations; their evidences set the shares.
        inflation: factor of the scale over the Laplace standard deviation.
        degrees: degrees of freedom.
        prior_share: share of draws from the prior, from 0 to below 1.
    """

    def __init__(
        self, problem: Problem, modes: list[Laplace], inflation: float, degrees: float, prior_share: float
    ) -> None:
        self.problem, self.degrees, self.prior_share = problem, degrees, prior_share
        self.means = np.stack([mode.mean for mode in modes])
        self.factors = np.stack([inflation * np.linalg.cholesky(mode.covariance) for mode in modes])
        evidence = np.array([mode.log_evidence for mode in modes])
        share = np.maximum(np.exp(evidence - evidence.max()), LEAST_SHARE)
        self.share = (1.0 - prior_share) * share / share.sum()

    def sample(self, key: PRNGKeyArray, n: int) -> Float[np.ndarray, "n d"]:
        """Draws in random order; components get their exact shares, up to one draw."""
        generator = host_generator(key)
        quantile = (np.arange(n) + generator.uniform()) / n
        component = np.searchsorted(np.cumsum(self.share), quantile)
        of_mode = np.minimum(component, len(self.share) - 1)
        z = generator.standard_normal((n, self.means.shape[1]))
        scale = generator.chisquare(self.degrees, n) / self.degrees
        draws = self.means[of_mode] + np.einsum("nij,nj->ni", self.factors[of_mode], z / np.sqrt(scale)[:, None])
        from_prior = component == len(self.share) if self.prior_share > 0.0 else np.zeros(n, dtype=bool)
        if from_prior.any():
            values = self.problem.sample_prior(key, int(from_prior.sum()))
            draws[from_prior] = np.asarray(self.problem.to_unconstrained(values), dtype=float)
        # Halves of the particles move by the statistics of the other half, which preserves the target only if a
        # particle's half is independent of its position: no order by component.
        return draws[generator.permutation(n)]

    def log_density(self, u: Float[Any, "n d"]) -> Float[np.ndarray, " n"]:
        """Log density, normalised; minus infinity if coordinates are not finite."""
        u = np.asarray(u)
        finite = np.isfinite(u).all(axis=1)
        u = np.where(finite[:, None], u, 0.0)
        parts = [
            np.log(share) + _student_t(u, mean, factor, self.degrees)
            for share, mean, factor in zip(self.share, self.means, self.factors, strict=True)
        ]
        if self.prior_share > 0.0:
            parts.append(np.log(self.prior_share) + evaluate_prior(self.problem, u))
        return np.where(finite, logsumexp(np.stack(parts), axis=0), -np.inf)


def _student_t(
    u: Float[np.ndarray, "n d"], mean: Float[np.ndarray, " d"], factor: Float[np.ndarray, "d d"], degrees: float
) -> Float[np.ndarray, " n"]:
    """Log density of a multivariate Student-t by the Cholesky factor of its scale.

    scipy treats eigenvalues below 4.5e-10 of the largest as zero and drops their directions. Parameters of different
    units (1e-4 and 10), or a slope with a distant intercept, fall below this limit.
    """
    d = len(mean)
    distance = squared_distance(factor, u - mean)
    constant = gammaln(0.5 * (degrees + d)) - gammaln(0.5 * degrees) - 0.5 * d * np.log(degrees * np.pi)
    return constant - np.log(np.diag(factor)).sum() - 0.5 * (degrees + d) * np.log1p(distance / degrees)


def covering(problem: Problem, modes: list[Laplace], key: PRNGKeyArray) -> list[Laplace]:
    """The modes, and for each the normal distribution of its likelihood and the prior's moments, if that is another."""
    mean, prior = prior_moments(problem, key)
    components = []
    for mode in modes:
        wide = _with_prior_moments(mode, mean, prior)
        components += [mode] if wide is None or divergence(mode, wide) < SAME else [mode, wide]
    return components


def prior_moments(problem: Problem, key: PRNGKeyArray) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d d"]]:
    """Mean and covariance of the prior, by draws."""
    drawn = np.asarray(problem.to_unconstrained(problem.sample_prior(key, MOMENTS)), dtype=float)
    drawn = drawn[np.isfinite(drawn).all(axis=1)]
    drawn = np.clip(drawn, *np.quantile(drawn, [0.01, 0.99], axis=0))  # heavy tails have no moments
    return drawn.mean(axis=0), np.atleast_2d(np.cov(drawn.T))


def joint_covariance(information: Float[np.ndarray, "d d"], prior: Float[np.ndarray, "d d"]) -> np.ndarray:
    """Covariance of a normal posterior, by the likelihood's information and the prior's covariance.

    Differences across a discontinuity of the likelihood may reach 1e20 times the prior's precision. Their rounded sum
    would lose the prior, and its inverse would have directions without variance. Information within the rounding error
    of the largest, or negative, is therefore set to zero. In units of the prior's deviations, no deviation is less than
    `NARROWEST` of the largest.
    """
    root = _root(prior)
    values, vectors = np.linalg.eigh(root.T @ information @ root)
    precision = 1.0 + np.where(values > len(values) * np.finfo(float).eps * values[-1], values, 0.0)
    half = root @ (vectors / np.sqrt(np.minimum(precision, precision.min() / NARROWEST**2)))
    return half @ half.T


def _root(covariance: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """A matrix R with R R' = covariance, also regular for linearly dependent draws."""
    sd = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(sd, sd))
    return sd[:, None] * vectors * np.sqrt(np.maximum(values, NARROWEST**2))


def _with_prior_moments(
    mode: Laplace, mean: Float[np.ndarray, " d"], prior: Float[np.ndarray, "d d"]
) -> Laplace | None:
    if mode.information is None or mode.slope is None:
        return None
    covariance = joint_covariance(mode.information, prior)
    root = _root(prior)
    of_prior = np.linalg.solve(root.T, np.linalg.solve(root, mean - mode.mean))
    centre = mode.mean + covariance @ (mode.slope + of_prior)
    # Neither of the two is known to be better: they get equal shares.
    wide = Laplace(centre, covariance, 0.0)
    return wide._replace(log_density=mode.log_evidence - wide.log_evidence)
