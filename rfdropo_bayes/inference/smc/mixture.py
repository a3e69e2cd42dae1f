"""A density that covers a posterior whose optima are known: Student-t distributions around them, and the prior.

At an optimum the curvature of the prior says little where the likelihood says nothing: along a ridge that ends at two
bounds, the density falls off within a hair of the end on which the optimum lies. Each optimum therefore has a second
distribution, with the likelihood as it is there and the prior by its mean and covariance, as long as the ridge.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.special import gammaln, logsumexp

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.inference.evaluations import evaluate_prior
from rfdropo_bayes.inference.modes.climb import SAME, Laplace, divergence
from rfdropo_bayes.inference.smc.moves import host_generator, squared_distance

LEAST_SHARE = 0.05  # of a mode, before normalising: Laplace evidences of ill-shaped modes are off by nats
MOMENTS = 1000  # prior draws behind its mean and covariance
NARROWEST = 1e-6  # least deviation of a normal approximation in any direction, as a share of its largest one


class ModeMixture:
    """Inflated Student-t distributions around modes, with a share of draws from the prior.

    The prior's share is a defence: what no climb has found still has particles, and every weight of the posterior
    against the mixture is bounded by the likelihood over that share.

    Args:
        problem: whose prior is mixed in.
        modes: normal approximations; their evidences set the shares.
        inflation: of the scale over the Laplace standard deviation.
        degrees: of freedom.
        prior_share: of the draws, 0 to below 1.
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
        spread = (np.arange(n) + generator.uniform()) / n
        component = np.searchsorted(np.cumsum(self.share), spread)
        of_mode = np.minimum(component, len(self.share) - 1)
        z = generator.standard_normal((n, self.means.shape[1]))
        scale = generator.chisquare(self.degrees, n) / self.degrees
        draws = self.means[of_mode] + np.einsum("nij,nj->ni", self.factors[of_mode], z / np.sqrt(scale)[:, None])
        from_prior = component == len(self.share) if self.prior_share > 0.0 else np.zeros(n, dtype=bool)
        if from_prior.any():
            values = self.problem.sample_prior(key, int(from_prior.sum()))
            draws[from_prior] = np.asarray(self.problem.to_unconstrained(values), dtype=float)
        # Halves of the particles move by what the other half looks like, which leaves the target alone only if a
        # particle's half says nothing of where it is: no order by component.
        return draws[generator.permutation(n)]

    def log_density(self, u: Float[Any, "n d"]) -> Float[np.ndarray, " n"]:
        """Log density, normalised; minus infinity where coordinates are not finite."""
        u = np.asarray(u)
        held = np.isfinite(u).all(axis=1)
        u = np.where(held[:, None], u, 0.0)
        parts = [
            np.log(share) + _student_t(u, mean, factor, self.degrees)
            for share, mean, factor in zip(self.share, self.means, self.factors, strict=True)
        ]
        if self.prior_share > 0.0:
            parts.append(np.log(self.prior_share) + evaluate_prior(self.problem, u))
        return np.where(held, logsumexp(np.stack(parts), axis=0), -np.inf)


def _student_t(
    u: Float[np.ndarray, "n d"], mean: Float[np.ndarray, " d"], factor: Float[np.ndarray, "d d"], degrees: float
) -> Float[np.ndarray, " n"]:
    """Log density of a multivariate Student-t by the Cholesky factor of its scale.

    scipy's takes eigenvalues below 4.5e-10 of the largest for zero and leaves their directions out of the density,
    which parameters of unlike units (1e-4 beside 10), or a slope and an intercept far off, fall below.
    """
    d = len(mean)
    distance = squared_distance(factor, u - mean)
    constant = gammaln(0.5 * (degrees + d)) - gammaln(0.5 * degrees) - 0.5 * d * np.log(degrees * np.pi)
    return constant - np.log(np.diag(factor)).sum() - 0.5 * (degrees + d) * np.log1p(distance / degrees)


def covering(problem: Problem, modes: list[Laplace], key: PRNGKeyArray) -> list[Laplace]:
    """The modes, and for each the normal distribution of its likelihood and the prior's moments, if that is another."""
    mean, prior = prior_moments(problem, key)
    found = []
    for mode in modes:
        wide = _with_prior_moments(mode, mean, prior)
        found += [mode] if wide is None or divergence(mode, wide) < SAME else [mode, wide]
    return found


def prior_moments(problem: Problem, key: PRNGKeyArray) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d d"]]:
    """Mean and covariance of the prior, by draws."""
    drawn = np.asarray(problem.to_unconstrained(problem.sample_prior(key, MOMENTS)), dtype=float)
    drawn = drawn[np.isfinite(drawn).all(axis=1)]
    drawn = np.clip(drawn, *np.quantile(drawn, [0.01, 0.99], axis=0))  # heavy tails have no moments
    return drawn.mean(axis=0), np.atleast_2d(np.cov(drawn.T))


def joint_covariance(information: Float[np.ndarray, "d d"], prior: Float[np.ndarray, "d d"]) -> np.ndarray:
    """Covariance of a normal posterior, by the likelihood's information and the prior's covariance.

    Differences across a cliff of the likelihood may promise 1e20 times the prior's precision. The sum of the two,
    rounded, would know nothing of the prior, and its inverse have directions without a variance. What rounding leaves
    of the largest information, and what is negative, is therefore none; and in deviations of the prior, no deviation
    is less than `NARROWEST` of the largest.
    """
    root = _root(prior)
    values, vectors = np.linalg.eigh(root.T @ information @ root)
    precision = 1.0 + np.where(values > len(values) * np.finfo(float).eps * values[-1], values, 0.0)
    half = root @ (vectors / np.sqrt(np.minimum(precision, precision.min() / NARROWEST**2)))
    return half @ half.T


def _root(covariance: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """A matrix R with R R' = covariance, regular where draws are linearly dependent, too."""
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
    # Of the two neither is known to be the better: they get equal shares.
    wide = Laplace(centre, covariance, 0.0)
    return wide._replace(log_density=mode.log_evidence - wide.log_evidence)
