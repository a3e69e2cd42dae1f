"""Parameters of the base model that their prior decides: any added effect compensates for the wrong prior.

An arm whose sections do not swell was audited under a prior of Poisson's ratio from 0.4 to 0.499. The parameter went to
0.4, and a payload became 1.6 times as heavy, seven of its deviations away.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.cautions import Caution
from rfdropo_bayes.discrepancy.fit import FitTarget, Posterior
from rfdropo_bayes.inference.result import prior_cautions

OUTER = 0.1  # of a prior at each end: that arm's median lay in 0.05, and without data it lies near the middle


def decided_by_priors(target: FitTarget, draws: Float[np.ndarray, "draw d"]) -> list[Caution]:
    """Cautions about base parameters at an end of their prior, or in a region of little prior mass.

    Args:
        target: target of the fit.
        draws: draws of all coordinates from the last model.
    """
    own = target.forward.coordinates
    base = np.arange(own.base)
    values = own.values(draws)[:, base]
    low, high = (np.array([own.quantiles(int(i), [share])[0] for i in base]) for share in (OUTER, 1.0 - OUTER))
    middle = np.median(draws[:, base], axis=0)
    outer = (middle < low) | (middle > high)
    shown = {own.names[i]: values[None, :, i] for i in base[outer]}
    return prior_cautions(Posterior(target, own.null, base[outer]), shown) if shown else []


def in_words(cautions: Sequence[Caution]) -> str:
    """Clause about them in the sentence of an audit with findings."""
    if not cautions:
        return ""
    return f" But {'; '.join(caution.sentence for caution in cautions)}: sizes may make up for it; widen that prior."
