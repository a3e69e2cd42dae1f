"""Set-points: lengths within every motor's limits on length, rate and acceleration, for any commands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.robots import Motor


class SetPoints:
    """Set-points of all motors, one step per cycle.

    A step never exceeds the limits on rate and acceleration, and always leaves the distance needed to stop at the goal.
    A goal within the limits on length is therefore never overshot.

    Args:
        motors: give the limits.
        period: length of the cycle [s].
        length: initial length, at rest [m].
    """

    def __init__(self, motors: Sequence[Motor], period: float, length: Float[np.ndarray, " motor"]) -> None:
        self.period = period
        self.low = np.array([motor.length_limit_m[0] for motor in motors])
        self.high = np.array([motor.length_limit_m[1] for motor in motors])
        self.rate_limit = np.array([motor.rate_limit_m_s for motor in motors])
        self.acceleration_limit = np.array([motor.acceleration_limit_m_s2 for motor in motors])
        self.length = np.array(length, dtype=float)
        self.rate = np.zeros(len(motors))

    def clamp(self, length: Float[np.ndarray, " motor"]) -> Float[np.ndarray, " motor"]:
        """The nearest lengths within the limits; a motor that stands outside them may stay or come back."""
        return np.clip(length, np.minimum(self.low, self.length), np.maximum(self.high, self.length))

    def towards(
        self,
        goal: Float[np.ndarray, " motor"],
        ramp: Float[np.ndarray, " motor"] | None = None,
        rate_limit: Float[np.ndarray, " motor"] | float = np.inf,
    ) -> Float[np.ndarray, " motor"]:
        """The next set-points [m].

        Args:
            goal: end of the motion [m].
            ramp: planned set-point at the next cycle [m]; the goal itself by default.
            rate_limit: rate limit below the motors' own [m/s].
        """
        ramp = goal if ramp is None else ramp  # ramps that overlap may pass the goal, and come back
        fastest = np.minimum(self.rate_limit, rate_limit)
        above = np.maximum(0.0, np.maximum(goal, ramp) - self.length)
        below = np.maximum(0.0, self.length - np.minimum(goal, ramp))
        upper = np.minimum(fastest, self._stopping_rate(above))
        lower = -np.minimum(fastest, self._stopping_rate(below))
        return self._step(np.clip((ramp - self.length) / self.period, lower, upper))

    def _stopping_rate(self, distance: Float[np.ndarray, " motor"]) -> Float[np.ndarray, " motor"]:
        """Largest rate from which steps of the acceleration limit still end within a distance, this step included.

        In units of a dt the rate is k + f, with 0 <= f < 1, and the way of all its steps a dt^2 (k + 1) (k / 2 + f).
        """
        steps = 2.0 * distance / (self.acceleration_limit * self.period**2)
        whole = np.floor(0.5 * (np.sqrt(1.0 + 4.0 * steps) - 1.0))
        return 0.5 * self.acceleration_limit * self.period * (whole + steps / (whole + 1.0))

    def halt(self) -> Float[np.ndarray, " motor"]:
        """The next set-points on the shortest way to rest."""
        return self._step(np.zeros_like(self.rate))

    @property
    def at_rest(self) -> bool:
        """Whether nothing moves."""
        return bool(np.all(self.rate == 0.0))

    def _step(self, wanted: Float[np.ndarray, " motor"]) -> Float[np.ndarray, " motor"]:
        change = self.acceleration_limit * self.period
        self.rate = np.clip(wanted, self.rate - change, self.rate + change)
        self.length = self.length + self.period * self.rate
        return self.length
