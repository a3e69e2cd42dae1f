"""The base model's optimum, looked for as `calibrate` looks for it: climbs from screened draws over growing horizons.

Under a long recording the likelihood has many small summits, on which climbs of the whole end. The climbs of
`inference.find_modes` begin at short prefixes; `better_nearby` then asks rollouts, not derivatives, whether the summit
that was found is one.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.audit.fit import CLOSE, Fit, Posterior, Target, heights
from rfdropo_bayes.inference import LaplaceConfig, find_modes
from rfdropo_bayes.simulators.differences import usable_difference

CLIMBED = 0.1  # nats that a step of these climbs promises at their end; the audit's own climb goes on from there
POLLED = (0.3, 0.03, 0.003)  # prior deviations to each side of a summit that are tried
ALONG = (4.0, 2.0, 1.0, 0.3)  # deviations of the posterior along its principal axes, likewise
WITHIN = 0.5 * max(ALONG) ** 2  # nats that a step of slopes promises which is no longer than those tried


def search(target: Target, key: PRNGKeyArray) -> Float[np.ndarray, " d"]:
    """Where the best of `calibrate`'s climbs ends.

    Raises:
        NoLikelihoodError: all prior draws are lost.
    """

    def compute() -> dict[str, np.ndarray]:
        own = target.forward.coordinates
        posterior = Posterior(target, own.null, np.arange(own.base))
        # Its normal approximation is not used: the coarse differences of short climbs suffice.
        mode = find_modes(posterior, LaplaceConfig(tolerance=CLIMBED), key).modes[0]
        return {"x": posterior.place(mode.mean[None])[0]}

    return target.recall("search", [np.asarray(jax.random.key_data(key))], compute)["x"]


def with_usable_differences(target: Target, x: Float[np.ndarray, " d"]) -> Target:
    """The target with derivatives over steps on whose scale its motion is smooth around a point.

    Slopes over the steps of a ladder, in prior deviations, are compared, of all base parameters at once; rollouts say
    which steps agree.
    """
    usual, coordinates = target.forward.lanes.difference, target.forward.coordinates
    if usual is None:
        return target
    directions = np.diag(coordinates.prior_sd)[: coordinates.base]

    def slope(step: float) -> np.ndarray:
        points = np.clip(np.concatenate([x + step * directions, x - step * directions]), *coordinates.bounds)
        found = target.recall("ladder", [points], lambda: {"residual": target.residual(points)})["residual"]
        ahead, behind = np.split(found, 2)
        return (ahead - behind) / (2.0 * step)

    step = usable_difference(slope)
    return target if step <= usual else replace(target, forward=target.forward.with_difference(step))


def better_nearby(target: Target, fit: Fit) -> Float[np.ndarray, " d"] | None:
    """A point beside a fit that is clearly better; None where rollouts confirm that it is a summit.

    Derivatives cannot tell: of a motion that is rough on the scale of their steps they are noise, and promise nothing.
    """
    coordinates = target.forward.coordinates
    own = coordinates.prior_sd[fit.free]
    values, vectors = np.linalg.eigh(fit.covariance / np.outer(own, own))
    axes = (vectors * np.sqrt(np.maximum(values, 0.0))).T * own
    moves = [step * np.diag(own) for step in POLLED] + [step * axes for step in ALONG]
    moved = np.concatenate([sign * move for move in moves for sign in (-1.0, 1.0)])
    points = np.repeat(fit.x[None], 1 + len(moved), axis=0)
    points[1:, fit.free] += moved
    tried = np.clip(points, *coordinates.bounds)
    height = heights(target, tried, "poll")
    best = int(np.argmax(height))
    return tried[best] if height[best] > height[0] + 1.0 + CLOSE * float(fit.residual @ fit.residual) else None
