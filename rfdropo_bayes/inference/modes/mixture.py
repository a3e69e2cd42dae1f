"""Several optima: selection of the optima that explain the data about equally well, and their weights in a posterior.

Densities alone do not decide this. Errors of a simulator are correlated between rows. Under white noise, optima that
explain the data equally well then differ by hundreds of nats. Optima are therefore compared by sums over rows of
differences of log densities, with standard errors that include the autocorrelation (Vehtari, Gelman & Gabry 2017, for
series).
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray
from numpyro.diagnostics import effective_sample_size

from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.inference.modes.optimisation import Laplace

CERTAIN = 2.0  # standard errors by which an optimum must be worse to be left out
STRONG = 3.0  # nats by which it must also be worse: less is no strong evidence under any noise (Kass & Raftery 1995)


def alternatives(rows: Float[np.ndarray, "mode row"]) -> Bool[np.ndarray, " mode"]:
    """Mask of the optima that explain the data about as well as the best, from the log density of rows.

    An optimum is excluded if its sum over rows is lower by more than 3 nats and by more than two standard errors of
    that sum. The standard error takes the autocorrelation of the differences into account. The best is always kept.
    """
    best = int(np.argmax(rows.sum(axis=1)))
    difference = rows[best] - rows
    return np.array([i == best or _uncertain(each) for i, each in enumerate(difference)])


def _uncertain(difference: Float[np.ndarray, " row"]) -> bool:
    count = len(difference)
    if not np.isfinite(difference).all():
        return False
    if count < 4 or difference.sum() <= STRONG:
        return bool(difference.sum() <= STRONG)
    size = float(effective_sample_size(difference[None]))
    # Differences that alternate must not count as more rows than there are; a constant one is certain.
    size = np.clip(size, 1.0, count) if np.isfinite(size) else count
    return bool(difference.sum() <= CERTAIN * count * difference.std(ddof=1) / np.sqrt(size))


def shares(modes: int, count: int) -> Int[np.ndarray, " mode"]:
    """Numbers of draws of each mode, equal up to one."""
    return np.diff(np.round(np.arange(1, modes + 1) / modes * count).astype(int), prepend=0)


def draw_mixture(modes: Sequence[Laplace], count: int, key: PRNGKeyArray) -> Float[np.ndarray, "draw d"]:
    """Draws from normals in equal parts, in random order."""
    order_key, draw_key = jax.random.split(key)
    member = np.repeat(np.arange(len(modes)), shares(len(modes), count))
    normal = np.asarray(jax.random.normal(draw_key, (count, len(modes[0].mean))))
    factors = np.stack([np.linalg.cholesky(mode.covariance) for mode in modes])
    means = np.stack([mode.mean for mode in modes])
    drawn = means[member] + np.einsum("nij,nj->ni", factors[member], normal)
    return drawn[np.asarray(jax.random.permutation(order_key, count))]


def mixture_cautions(optima: int) -> list[Caution]:
    """A caution if several optima explain the data about equally well."""
    if optima == 1:
        return []
    sentence = (
        f"{optima} optima explain the data about as well, and they are mixed in equal parts: one normal distribution "
        "does not describe this posterior; use SMC if the noise model is right"
    )
    return [Caution(Code.SEVERAL_OPTIMA, sentence)]
