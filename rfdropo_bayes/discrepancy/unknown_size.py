"""Evidence of an effect whose size is unknown by orders of magnitude.

The prior of a candidate's parameters says how large its effect usually is. Under this prior alone, a small effect of
several parameters has little evidence although the data show it clearly (Lindley's paradox), and an effect of one
parameter that imitates a half of it wins. The prior therefore has a common scale s for all sizes of a candidate, with
equal probability at each of `SCALES`: a mixture of g-priors (Liang et al. 2008, J. Am. Stat. Assoc. 103, 410).

With prior N(0, I), mode m and covariance C of the sizes, which include this prior, the evidence under N(0, s^2 I) is
larger by the factor

    s^-d |I + l C|^-1/2 exp(-l m' (I + l C)^-1 m / 2),    l = s^-2 - 1
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp
from scipy.stats import norm

SCALES = 2.0 ** np.arange(-6.0, 3.0)
"""Factors of a prior's deviation. Effects of rho .15 in recordings of 100 rows have .01 to 2.6 prior deviations (median
.07), effects of rho .5 have .05 to 2 (median .2; one has 27): `python -m studies audit`."""


def scale_gain(mode: Float[np.ndarray, " d"], covariance: Float[np.ndarray, "d d"]) -> float:
    """Log evidence [nat] under the mixture of scales less log evidence under the prior N(0, I).

    Args:
        mode: posterior mode of the sizes under N(0, I), in its deviations.
        covariance: their posterior covariance.
    """
    if len(mode) == 0:
        return 0.0
    values, vectors = np.linalg.eigh(covariance)
    along, excess = vectors.T @ mode, SCALES[:, None] ** -2 - 1.0
    spread = 1.0 + excess * np.clip(values, 0.0, 1.0)  # data do not widen a prior
    factors = -len(mode) * np.log(SCALES) - 0.5 * np.sum(np.log(spread) + excess / spread * along**2, axis=1)
    return float(logsumexp(factors) - np.log(len(SCALES)))


def linear_evidence(effect: Float[np.ndarray, "n d"], residual: Float[np.ndarray, " n"], sign: int = 0) -> float:
    """Log Bayes factor [nat] of a linear effect of unknown size against none.

    Args:
        effect: whitened effect of sizes of one prior deviation, without the part that base parameters imitate.
        residual: whitened residual of the base model.
        sign: +1 or -1 if a single size has only this sign; else 0.
    """
    return gram_evidence(effect.T @ effect, effect.T @ residual, sign)


def gram_evidence(gram: Float[np.ndarray, "d d"], moment: Float[np.ndarray, " d"], sign: int = 0) -> float:
    """`linear_evidence` by the products of the effects of sizes with one another, and with the residual."""
    values, vectors = np.linalg.eigh(gram)
    square, along = SCALES[:, None] ** 2, vectors.T @ moment
    seen = square * np.clip(values, 0.0, None)
    each = 0.5 * np.sum(square / (1.0 + seen) * along**2 - np.log1p(seen), axis=1)
    if sign:
        each += np.log(2.0) + norm.logcdf(sign * moment[0] * SCALES / np.sqrt(1.0 + seen[:, 0]))
    return float(logsumexp(each) - np.log(len(SCALES)))
