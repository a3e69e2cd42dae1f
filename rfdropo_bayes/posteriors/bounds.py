"""Whether draws are piled up at a bound, for bounds of any width, or lie in a region of little prior mass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

OUTERMOST = 0.005  # of the prior, on either side
SPARSE = 0.1  # of the mean density between the quartiles


NEIGHBOURS = 5  # prior draws on the denser side, which estimate the density at a place
PILED = 0.13  # of a standard deviation, between a half-normal (0.10) and a uniform distribution (0.17)


def cut_off_at(draws: Float[np.ndarray, " n"], low: float, high: float, *, logarithmic: bool = False) -> str | None:
    """The end, "low" or "high", at which a distribution is cut off at its mode; None if neither is.

    Its outer 5 % quantile then lies within a tenth of a standard deviation of that end.

    Args:
        draws: draws of one parameter.
        low, high: ends of its range; infinite without an end.
        logarithmic: compare positive draws in logarithms.
    """
    if logarithmic and np.all(draws > 0):
        draws = np.log(draws)
        low = np.log(low) if low > 0 else -np.inf
        high = np.log(high) if high > 0 else -np.inf
    q05, q95 = np.quantile(draws, [0.05, 0.95])
    reach = PILED * draws.std()
    if q05 - low <= reach:
        return "low"
    return "high" if high - q95 <= reach else None


def contradicts(draws: Float[np.ndarray, " n"], prior: Float[np.ndarray, " m"]) -> bool:
    """Whether the median of a posterior lies in the outermost 1 % of its prior, in a region of low prior density; False
    if there are too few draws.

    The ends of a wide uniform prior, zero of a half-normal prior, and zero of a log-normal prior over decades are
    outermost but dense.

    Args:
        draws: draws of one parameter's posterior.
        prior: draws of the parameter's prior, at least 400.
    """
    prior, centre = np.sort(prior[np.isfinite(prior)]), float(np.median(draws))
    n, below = len(prior), int(np.searchsorted(prior, centre))
    if n < 2.0 / OUTERMOST or OUTERMOST * n <= below <= (1.0 - OUTERMOST) * n:
        return False
    distances = (
        np.sort(np.abs(prior[below:] - centre))[:NEIGHBOURS],
        np.sort(np.abs(prior[:below] - centre))[:NEIGHBOURS],
    )
    nearest = min(side[-1] for side in distances if len(side) == NEIGHBOURS)
    low, high = np.quantile(prior, [0.25, 0.75])
    return bool(NEIGHBOURS / n * (high - low) < SPARSE * 0.5 * nearest)


def contradiction(names: Sequence[str]) -> str:
    """The clause about parameters whose posterior `contradicts` the prior."""
    return (
        f"the data put {', '.join(names)} into the outermost {200 * OUTERMOST:.0f} % of the prior, which excludes them"
    )
