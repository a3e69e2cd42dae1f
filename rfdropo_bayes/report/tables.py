"""The posterior in numbers: moments, quantiles, sampling diagnostics, and whether a bound decided."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, central_interval, piled_at, summarise


@dataclass(frozen=True)
class ParameterRow:
    """One line of the posterior table; physical (SI) units.

    Attributes:
        name, unit, description: of the parameter.
        mean, sd, q05, median, q95: of the draws.
        at_bound: the posterior is piled up at a hard bound, or at an end of its prior.
        bound: which one, "low" or "high"; None if neither.
        prior_q05, prior_q95: of the prior draws, None without them.
        contraction: posterior over prior standard deviation, of the logarithm where the prior is logarithmic and for
            derived products.
        ess_bulk, ess_tail, mcse_mean, r_hat: ArviZ's diagnostics; ``r_hat`` is NaN for a single chain.
        derived: a function of other parameters.
    """

    name: str
    unit: str
    description: str
    mean: float
    sd: float
    q05: float
    median: float
    q95: float
    at_bound: bool
    bound: str | None
    prior_q05: float | None
    prior_q95: float | None
    contraction: float | None
    ess_bulk: float
    ess_tail: float
    mcse_mean: float
    r_hat: float
    derived: bool

    def as_dict(self) -> dict[str, Any]:
        """Everything but the name, for summary.json."""
        return {key: value for key, value in asdict(self).items() if key != "name"}


def posterior_table(record: PosteriorRecord) -> list[ParameterRow]:
    """One row per parameter and derived quantity."""
    diagnostics = summarise(record.posterior)
    free = {info.name for info in record.free}
    rows = []
    for info in record.parameters:
        draws, prior = record.flat(info.name), record.prior.get(info.name)
        q05, q95 = central_interval(draws)
        bound = bound_reached(draws, info) if info.name in free else None
        before = (None, None) if prior is None else np.quantile(prior, [0.05, 0.95]).tolist()
        rows.append(
            ParameterRow(
                info.name,
                info.unit,
                info.description,
                float(draws.mean()),
                float(draws.std(ddof=1)) if len(draws) > 1 else 0.0,
                float(q05),
                float(np.median(draws)),
                float(q95),
                bound is not None,
                bound,
                before[0],
                before[1],
                None if prior is None else _contraction(draws, prior, log=info.logarithmic or info.name not in free),
                diagnostics[info.name]["ess_bulk"],
                diagnostics[info.name]["ess_tail"],
                diagnostics[info.name]["mcse_mean"],
                diagnostics[info.name]["r_hat"],
                info.name not in free,
            )
        )
    return rows


def bound_reached(draws: Float[np.ndarray, " n"], info: ParameterInfo) -> str | None:
    """The end of its prior, "low" or "high", that a posterior is piled up at; None if it is not.

    Where the prior is logarithmic the comparison
    is in logarithms; see `piled_at`.
    """
    return piled_at(draws, *info.ends, logarithmic=info.logarithmic)


def _contraction(draws: Float[np.ndarray, " n"], prior: Float[np.ndarray, " m"], *, log: bool) -> float | None:
    """Ratio of standard deviations, of the values or of their logarithms."""
    if log and np.all(draws > 0) and np.all(prior > 0):
        draws, prior = np.log(draws), np.log(prior)
    spread = float(np.std(prior))
    return float(np.std(draws)) / spread if spread > 0 else None
