"""Normal approximations where the likelihood has kinks: their widths are sounded along their axes.

Where contacts open and close or a cable goes slack the likelihood has kinks and steps. Derivatives at such a point,
differences over some step, are neither those of one side nor of the other, and do not even agree with each other: a
direction in which data say nothing looks determined, and the distribution around the optimum is a hundred times too
wide in one direction and too narrow in another. What can be relied on is the density itself: along each axis of the
normal approximation it is followed, on both sides, down to `DROP` below the top.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.bayes.units import common_scale
from rfdropo_bayes.inference.evaluations import Ledger, evaluate_prior, evaluate_rows
from rfdropo_bayes.inference.modes.climb import Laplace, positive_part
from rfdropo_bayes.inference.smc.mixture import NARROWEST, joint_covariance, prior_moments

TRIED = np.array([0.5, 2.0])  # deviations from the mode at which the quadratic model of the likelihood is looked at
KINK = 1.0  # nats by which it may be wrong there
STRETCH, FREE = 0.05, 0.1  # of a scale, in its logarithm, and nats by which one that is free may change the likelihood
LADDER = 2.0 ** np.arange(-4.0, 6.0)  # deviations at which the density is looked at
DROP = 2.0  # nats: of a normal density at two deviations
HIGHER = 0.5  # nats above the mode from which on the way up goes on
ROUNDS = 3
SHIFTS = np.array([0.25, 0.5, 0.75, 1.0])
FAVOUR = 3.0  # share of a sounded distribution over that of the one it goes with


class Sounding(NamedTuple):
    """A problem as soundings see it.

    Attributes:
        problem: in coordinates whose axes are worth following, logarithms where a scale is to be found.
        logarithmic: coordinates that are logarithms of their parameters.
        noise: coordinates that are noise parameters, whose likelihood is smooth.
        ledger: is charged.
    """

    problem: Problem
    logarithmic: Bool[np.ndarray, " d"]
    noise: Bool[np.ndarray, " d"]
    ledger: Ledger

    def look(self, points: Float[np.ndarray, "n d"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Log prior, and log likelihood of all rows: minus infinity where there is none, and beyond the prior, where
        nothing is simulated."""
        prior, likelihood = evaluate_prior(self.problem, points), np.full(len(points), -np.inf)
        inside = np.isfinite(prior)
        if inside.any():
            likelihood[inside] = evaluate_rows(self.problem, points[inside], self.problem.n_rows, self.ledger).sum(
                axis=1
            )
        return prior, likelihood

    def density(self, points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Log posterior, unnormalised."""
        prior, likelihood = self.look(points)
        return np.where(np.isfinite(prior), prior, 0.0) + likelihood


def sounded(sounding: Sounding, modes: list[Laplace], key: PRNGKeyArray, rollouts: float) -> list[Laplace]:
    """The modes, each at a kink followed by another with the widths that soundings found.

    The first stays, as what soundings miss, off the axes or beyond a dip, may be covered by it. Of the two together the
    sounded one has the larger share of a mixture.

    Args:
        sounding: what to sound.
        modes: normal approximations, best first.
        key: for the prior draws that bound what data do not.
        rollouts: that all soundings may take; modes for which they do not suffice are left alone.
    """
    found, last = [], sounding.ledger.rollouts + rollouts
    physical = int(np.sum(~sounding.noise))
    for mode in modes:
        found.append(mode)
        if sounding.ledger.rollouts + 1 + 4 * physical > last or not _kinked(sounding, mode):
            continue
        round_cost = 2 * len(LADDER) * physical
        rounds = int(min(ROUNDS, (last - sounding.ledger.rollouts - 4 - len(SHIFTS)) / round_cost))
        if rounds > 0:
            other = _with_widths(sounding, mode, key, rounds)
            favoured = max(mode.log_evidence, other.log_evidence) + np.log(FAVOUR)
            found.append(other._replace(log_density=other.log_density + favoured - other.log_evidence))
    return found


def _kinked(sounding: Sounding, mode: Laplace) -> bool:
    """Whether the quadratic model of the likelihood is wrong along an axis, as far as the prior reaches."""
    if mode.information is None or mode.slope is None or sounding.noise.all():
        return False
    axes = _axes(mode.covariance, sounding.noise)
    steps = np.concatenate([TRIED, -TRIED])
    offsets = np.concatenate([steps[:, None] * axis for axis in axes.T])
    prior, values = sounding.look(np.concatenate([mode.mean[None], mode.mean + offsets]))
    promised = offsets @ mode.slope - 0.5 * np.einsum("ni,ij,nj->n", offsets, mode.information, offsets)
    return bool(np.any((np.abs(values[1:] - values[0] - promised) > KINK)[np.isfinite(prior[1:])]))


def _with_widths(sounding: Sounding, mode: Laplace, key: PRNGKeyArray, rounds: int) -> Laplace:
    """A normal distribution around the highest point found in so many rounds, as wide as the density is there."""
    information = _without_free_scale(sounding, mode)
    covariance = joint_covariance(information, prior_moments(sounding.problem, key)[1])
    axes = _axes(covariance, sounding.noise)
    centre, top = mode.mean, float(sounding.density(mode.mean[None])[0])
    for rounds_left in reversed(range(rounds)):
        points = centre + np.concatenate([np.outer(side * LADDER, axis) for axis in axes.T for side in (1.0, -1.0)])
        values = sounding.density(points)
        best = int(np.argmax(values))
        if rounds_left == 0 or values[best] < top + HIGHER:
            break
        centre, top = points[best], float(values[best])
    widths = _widths(top - values.reshape(axes.shape[1], 2, len(LADDER)))
    shift = axes @ (0.5 * (widths[:, 0] - widths[:, 1]))
    near = np.flatnonzero(sounding.density(centre + np.outer(SHIFTS, shift)) > top - DROP)
    if len(near):
        centre = centre + SHIFTS[near[-1]] * shift
    scaled = axes * 0.25 * widths.sum(axis=1)  # DROP lies two deviations off on either side
    lengths = np.linalg.norm(scaled, axis=0)
    scaled *= np.maximum(1.0, NARROWEST * lengths.max() / lengths)
    rescaled = scaled @ scaled.T
    noise = np.ix_(sounding.noise, sounding.noise)
    rescaled[noise] = mode.covariance[noise]
    return Laplace(centre, rescaled, top)


def _without_free_scale(sounding: Sounding, mode: Laplace) -> Float[np.ndarray, "d d"]:
    """The likelihood's information, none of it along the common scale of forces if data say nothing of that.

    Differences across kinks would have it determined.
    """
    assert mode.information is not None
    information = positive_part(mode.information)
    physical = sounding.logarithmic & ~sounding.noise
    scale = np.where(physical, common_scale(sounding.problem.units, sounding.problem.names), 0.0)
    length = float(np.linalg.norm(scale))
    if np.count_nonzero(scale) < 2:
        return information
    prior, values = sounding.look(mode.mean + np.outer([0.0, STRETCH, -STRETCH], scale / np.abs(scale).max()))
    values = values[np.isfinite(prior)]
    if len(values) < 2 or not np.ptp(values) <= FREE:
        return information
    across = np.eye(len(scale)) - np.outer(scale, scale) / length**2
    return across @ information @ across


def _axes(covariance: Float[np.ndarray, "d d"], noise: Bool[np.ndarray, " d"]) -> Float[np.ndarray, "d k"]:
    """Principal axes of the physical coordinates, a deviation long, one per column."""
    physical = np.flatnonzero(~noise)
    values, vectors = np.linalg.eigh(covariance[np.ix_(physical, physical)])
    axes = np.zeros((len(covariance), len(physical)))
    axes[physical] = vectors * np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    return axes


def _widths(drops: Float[np.ndarray, "axis 2 step"]) -> Float[np.ndarray, "axis 2"]:
    """Deviations at which the density has first fallen by `DROP`, between the steps of the ladder by a power law."""
    found = np.full(drops.shape[:2], LADDER[-1])
    for axis, side in np.ndindex(*found.shape):
        fallen = np.flatnonzero(~(drops[axis, side] <= DROP))
        if len(fallen) == 0:
            continue
        first = int(fallen[0])
        inner, outer = (LADDER[first - 1], LADDER[first]) if first else (0.5 * LADDER[0], LADDER[0])
        less = max(float(drops[axis, side, first - 1]) if first else 0.25 * DROP, 1e-3)
        more = min(float(drops[axis, side, first]), 1e6) if np.isfinite(drops[axis, side, first]) else 1e6
        found[axis, side] = inner * (outer / inner) ** (np.log(DROP / less) / np.log(more / less))
    return found
