"""How long an audit may take: when its time is up it stops between two batches of rollouts, and says what it knows."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

KEPT = 0.15  # share of the time that is kept for measuring the gain and for the report


class OutOfTime(Exception):
    """The time is up."""


@dataclass
class Deadline:
    """A limit on the time of a whole run.

    Attributes:
        minutes: from its making on; infinite for no limit.
        where: the setting that holds them.
        share: part of the time after which rollouts stop.
        reached: whether anything was left undone.
    """

    minutes: float = float("inf")
    where: str = "[audit] minutes"
    share: float = 1.0 - KEPT
    began: float = field(default_factory=time.monotonic)
    reached: bool = False

    @property
    def left(self) -> float:
        """Minutes until rollouts stop."""
        return self.share * self.minutes - (time.monotonic() - self.began) / 60.0

    def check(self) -> None:
        """Raise OutOfTime once the time is up."""
        if self.left <= 0.0:
            self.reached = True
            raise OutOfTime

    def lift(self) -> None:
        """No limit from now on."""
        self.minutes = float("inf")
