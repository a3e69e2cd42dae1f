"""Time and place of a model's misfit: the surprise of each block of rows, given the earlier rows.

With the model linear around its mode, the predictive density of every block of rows, given all rows before it, is a
normal one (Dawid 1984, "The prequential approach"); the sum of their logarithms is the log evidence. Parameters are
known only as well as from the prior and the earlier rows, so that a fit to later rows hides nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from rfdropo_bayes.discrepancy.fit import Fit, FitTarget
from rfdropo_bayes.discrepancy.omnibus import BLOCK

BEGINNING = (
    "Only the first block fails: was another command in force before the first row than these recordings "
    "have, or was the robot not at rest? rfdropo check names the assumed command; initial_command sets "
    "it."
)


@dataclass(frozen=True)
class Prequential:
    """Scores of successive blocks of rows, over all recordings.

    Attributes:
        edges: start times of blocks, and the end of the last block [s].
        score: log predictive density of each block, whitened data.
        p: probability of a surprise this large under a right model.
        surprise: mean square of a block's prediction errors in their own deviations, 1 if the model is right.
        misfit: mean square of each marker coordinate's residuals at the mode, 1 if the model is right.
    """

    edges: Float[np.ndarray, " edge"]
    score: Float[np.ndarray, " block"]
    p: Float[np.ndarray, " block"]
    surprise: Float[np.ndarray, " block"]
    misfit: Float[np.ndarray, " column"]


def prequential(target: FitTarget, fit: Fit) -> Prequential:
    """Score the blocks of a fitted model."""
    measured = target.measurements
    shape, valid = measured.count.shape, measured.valid
    residual, slopes = measured.series(fit.residual), np.moveaxis(measured.series(fit.jacobian.T), 0, -1)
    coordinates = target.forward.coordinates
    mean = coordinates.prior_mean[fit.free] - fit.x[fit.free]
    precision = np.diag(coordinates.prior_sd[fit.free] ** -2.0)
    known, design = fit.residual[measured.count.size :], fit.jacobian[measured.count.size :]  # weighed before all rows
    before, precision = precision @ mean, precision + design.T @ design
    mean = np.linalg.solve(precision, before + design.T @ known)
    starts = BLOCK * np.arange(max(shape[1] // BLOCK, 1))  # the last block also has the remaining rows
    scores, p, surprise = [], [], []
    for start, end in zip(starts, [*starts[1:], shape[1]], strict=True):
        rows = slice(start, end)
        used = valid[:, rows]
        r, j = residual[:, rows][used], slopes[:, rows][used]
        remaining = r - j @ mean
        after = precision + j.T @ j
        gain = np.linalg.solve(after, j.T @ remaining)
        square = float(
            remaining @ remaining - (j.T @ remaining) @ gain
        )  # left' (I + J P J')^-1 left, by Woodbury's identity
        growth = float(np.linalg.slogdet(after)[1] - np.linalg.slogdet(precision)[1])
        scores.append(-0.5 * (square + growth + len(r) * np.log(2.0 * np.pi)))
        p.append(max(float(chi2.sf(square, len(r))), float(np.finfo(float).tiny)) if len(r) else 1.0)
        surprise.append(square / max(len(r), 1))
        mean, precision = mean + gain, after
    clock = measured.time[int(np.argmax(valid.any(axis=2).sum(axis=1)))]
    edges = np.append(clock[starts], clock[-1])
    misfit = np.sum(residual**2, axis=(0, 1)) / np.maximum(valid.sum(axis=(0, 1)), 1)
    misfit = misfit[: measured.markers]
    return Prequential(edges, np.array(scores), np.array(p), np.array(surprise), misfit)


def span_in_words(first: float, last: float, timed: bool) -> str:
    """A span of times [s], or of rows if rows have no times."""
    return f"from {first:.4g} to {last:.4g} s" if timed else f"from row {first:.0f} to row {last:.0f}"


def in_words(scores: Prequential, markers: tuple[str, ...], level: float, timed: bool = True) -> str:
    """When the model first fails, when most, and at which marker.

    Args:
        scores: scores of the blocks.
        markers: names, three channels each.
        level: level of the p-values, shared by all blocks.
        timed: whether rows have times.
    """
    failing = np.flatnonzero(scores.p <= level / len(scores.p))
    if len(failing) == 0:
        return "No stretch of rows is surprising by itself, given the earlier rows."
    first, worst = failing[0], int(np.argmax(scores.surprise))
    at = int(np.argmax(scores.misfit.reshape(-1, 3).sum(axis=1)))
    share = "in every block" if len(failing) == len(scores.p) else f"in {len(failing)} of {len(scores.p)} blocks"
    early, late = (span_in_words(scores.edges[k], scores.edges[k + 1], timed) for k in (first, worst))
    return f"The model fails {share} of rows, first {early}, most {late}, and most at marker {markers[at]}." + (
        f" {BEGINNING}" if begins_wrong(scores, level) else ""
    )


def begins_wrong(scores: Prequential, level: float) -> bool:
    """Whether the first block of rows fails, and no other of several."""
    return len(scores.p) > 1 and np.flatnonzero(scores.p <= level / len(scores.p)).tolist() == [0]
