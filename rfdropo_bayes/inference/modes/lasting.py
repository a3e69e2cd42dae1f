"""Weight of rows with correlated residuals: the likelihood of white noise, adjusted after the fit.

Errors of a simulator are correlated between rows and between neighbouring markers, so that rows repeat evidence.
Correlated noise may be inferred instead, but noise with a correlation time of seconds also absorbs a constant pose
error, which parameters should explain. Here the residuals at the optimum under white noise give the weight of a row.
The log likelihood is then multiplied by a share below 1 and optimised again, so that parameters are as uncertain as the
correlation of the residuals makes them (magnitude adjustment of Pauli, Racugno & Ventura 2011, Ribatet, Cooley &
Davison 2012).

The residuals also are smaller than the errors of new recordings, because parameters follow them. These errors are
estimated by leaving out blocks of rows as long as the correlation time; a linear model needs no repeated fit
(jackknife, CR3 of Bell & McCaffrey 2002).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from rfdropo_bayes.bayes.noise.autoregression import RESIDUALS, Autoregression, estimate_noise
from rfdropo_bayes.bayes.problem import ResidualProblem
from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.inference.modes.optimisation import Laplace
from rfdropo_bayes.inference.modes.targets import Target

WIDER = 1.2  # by a fifth
SMALLEST = 1e-3  # share of a block's direction that parameters leave: less is rounding


@runtime_checkable
class CountedProblem(ResidualProblem, Protocol):
    """A problem with series of residuals that its likelihood takes for independent, and that can be taken for less."""

    def independent_series(
        self, residuals: Float[np.ndarray, "*batch m"]
    ) -> Mapping[
        str, tuple[Float[np.ndarray, "*batch recording time column"], Bool[np.ndarray, "recording time column"]]
    ]:
        """Whitened residuals of all rows by channel, and which of them are there."""
        ...

    @property
    def row_steps(self) -> Float[np.ndarray, " recording"]:
        """Time between rows of each recording [s]."""
        ...

    @property
    def shares(self) -> Mapping[str, float]:
        """Factor of the log likelihood of each channel."""
        ...

    def counting(self, shares: Mapping[str, float]) -> CountedProblem:
        """The same problem with the log likelihood of some channels times a share."""
        ...


class Lasting(NamedTuple):
    """Statistics of a channel's residuals at an optimum, which correct its likelihood."""

    share: float  # weight of a row; 1 for uncorrelated residuals
    rows: float  # correlation time of residuals, in rows; 1 if uncorrelated
    widened: Float[np.ndarray, " column"]  # errors in rows left out of the fit over residuals, per column


def lasting_residuals(problem: CountedProblem, target: Target, mode: Laplace) -> dict[str, Lasting]:
    """Statistics of the residuals at a mode, by channel.

    Args:
        problem: problem with these rows.
        target: its posterior at the full horizon.
        mode: optimum of the posterior.
    """
    residual, jacobian = target.linearise(mode.mean)
    physical = ~target.noise
    factor = np.linalg.cholesky(mode.covariance[np.ix_(physical, physical)])
    fitted = np.where(np.isfinite(jacobian).all(axis=0), jacobian, 0.0)[:, physical] @ factor
    reach = problem.independent_series(fitted.T)  # outer products of these add to the covariance of the fitted values
    return {
        name: lasting_series(series, valid, reach[name][0], problem.row_steps)
        for name, (series, valid) in problem.independent_series(residual).items()
    }


def lasting_series(
    series: Float[np.ndarray, "recording time column"],
    valid: Bool[np.ndarray, "recording time column"],
    reach: Float[np.ndarray, "d recording time column"],
    steps: Float[np.ndarray, " recording"],
) -> Lasting:
    """Statistics of the residuals of a channel, with one correlation time in seconds for all recordings.

    Args:
        series: residuals, whitened by the likelihood.
        valid: mask of measured values.
        reach: change of fitted values per posterior deviation along orthonormal directions; zero for invalid entries.
        steps: time between rows of each recording [s].
    """
    noise = estimate_noise(series, valid, 1.0, source=RESIDUALS, steps=steps, order=1, pooled=False, shared=None)
    memory = np.clip([noise.resampled(step).autocorrelation[1] for step in steps], 0.0, 0.999)
    rows = (1.0 + memory) / (1.0 - memory)
    main = float(np.clip(noise.autocorrelation[1], 0.0, 0.999))
    widened = _widened(series, valid, reach, np.ceil(rows).astype(int))
    return Lasting(_share(reach, noise, memory), (1.0 + main) / (1.0 - main), widened)


def _share(
    reach: Float[np.ndarray, "d recording time column"], noise: Autoregression, memory: Float[np.ndarray, " recording"]
) -> float:
    """Variance of the fitted values under independent residuals of unit size, over that under the residuals' own
    covariance; at most 1."""
    lags, real = np.arange(reach.shape[2]), 0.0
    across = np.eye(reach.shape[3]) if noise.correlation is None else noise.correlation
    for own, kept in zip(np.moveaxis(reach * noise.scale, 1, 0), memory, strict=True):
        seen = np.einsum("ts,dsc->dtc", kept ** np.abs(lags[:, None] - lags), own @ across)
        real += float(np.sum(seen * own))
    return min(1.0, float(np.sum(reach**2)) / real) if real > 0.0 else 1.0


def _widened(
    series: Float[np.ndarray, "recording time column"],
    valid: Bool[np.ndarray, "recording time column"],
    reach: Float[np.ndarray, "d recording time column"],
    lengths: Int[np.ndarray, " recording"],
) -> Float[np.ndarray, " column"]:
    """Root mean square error of blocks left out of a linear fit, over the root mean square residual."""
    left_out = np.zeros_like(series)
    for recording, length in enumerate(lengths):
        for first in range(0, series.shape[1], length):
            block = recording, slice(first, first + length)
            there = valid[block]
            fitted = reach[(slice(None), *block)][:, there]
            values, vectors = np.linalg.eigh(np.eye(there.sum()) - fitted.T @ fitted)
            left_out[block][there] = (vectors / np.maximum(values, SMALLEST)) @ (vectors.T @ series[block][there])
    square = [np.sum(np.where(valid, each, 0.0) ** 2, axis=(0, 1)) for each in (left_out, series)]
    return np.sqrt(np.where(square[1] > 0.0, square[0] / np.maximum(square[1], 1e-300), 1.0))


def lasting_cautions(lasting: Mapping[str, Lasting]) -> list[Caution]:
    """A caution for each channel whose down-weighted rows widen intervals by more than a fifth."""
    return [
        Caution(
            Code.RESIDUALS_LAST,
            f"residuals of the {name} are correlated over {each.rows:.2g} rows and between coordinates: a row is "
            f"worth {each.share:.2g} of an independent row; rfdropo audit can find the effect that the simulator lacks",
        )
        for name, each in lasting.items()
        if each.share < WIDER**-2
    ]
