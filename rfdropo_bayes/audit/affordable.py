"""Candidates that need a slower simulator than the rest: those that would take too long are named, not waited for."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from rfdropo_bayes.audit.candidates import Candidate
from rfdropo_bayes.audit.fit import Fit, Target
from rfdropo_bayes.audit.forward import RoutedLanes

CLIMB = 12  # steps of a refit, each with a Jacobian
DERIVATIVE = 3  # rollouts that a derivative costs


def unaffordable(candidates: Sequence[Candidate], target: Target, base: Fit, minutes: float) -> dict[str, float]:
    """Expected processor minutes of the candidates that would need more than they may have.

    One batch on the slower simulator says what a rollout costs. A candidate costs its screening and one refit, for
    every group of recordings.
    """
    lanes = target.forward.lanes
    if not isinstance(lanes, RoutedLanes):
        return {}
    slow = [c for c in candidates if _needs_slow(lanes, c)]
    seconds = _pace(lanes, target, base) if slow else 0.0
    found = {}
    for candidate in slow:
        derivatives = len(candidate.indices) + CLIMB * (len(base.free) + len(candidate.indices))
        expected = target.forward.count * (CLIMB + DERIVATIVE * derivatives) * seconds / 60.0
        if expected > minutes:
            found[candidate.name] = expected
    return found


def climb_rollouts(target: Target, parameters: int) -> int:
    """Rollouts that a refit of so many parameters may take."""
    forward = target.forward
    return forward.count * CLIMB * (1 + forward.lanes.slope_rollouts * parameters)


def about(seconds: float) -> str:
    """A time in words, as rough as it is known."""
    if seconds < 90.0:
        return f"about {max(round(seconds), 1)} s"
    return f"about {seconds / 60.0:.0f} min"


def _needs_slow(lanes: RoutedLanes, candidate: Candidate) -> bool:
    """Whether only the slower simulator knows a candidate."""
    return any(spec.name not in lanes.fast.physical for spec in candidate.mechanism.parameters)


def _pace(lanes: RoutedLanes, target: Target, base: Fit) -> float:
    """Processor seconds of one rollout on the slower simulator, once it is compiled."""
    coordinates, forward = target.forward.coordinates, target.forward
    theta = coordinates.physical_values(np.repeat(base.x[None], lanes.slow.width, axis=0), forward.slots)[:, 0]
    lane = np.zeros(lanes.slow.width, dtype=int)
    seconds = 0.0
    for _ in range(2):
        began = time.process_time()
        lanes.slow.roll(theta, forward.start[lane], forward.commands.of(lane))
        seconds = time.process_time() - began
    return seconds / lanes.slow.width
