"""Time limit and time profile of an audit: after the limit it stops between two batches of rollouts, and reports its
present results.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NoReturn

from rfdropo_bayes.interrupts import answer_interrupt, interrupted

KEPT = 0.15  # share of the time that is kept for measuring the gain and for the report
PATIENCE = 20.0  # seconds that the same may take after Ctrl-C
TIME, INTERRUPT = "time", "interrupt"
BETWEEN_STAGES = "preparation and report"


class OutOfTime(Exception):
    """The time is up."""


@dataclass
class Deadline:
    """A limit on the time of a whole run, by the clock on the wall: on a busy machine, less is done within it.

    Attributes:
        minutes: limit from its creation; infinite for no limit.
        where: setting of the limit.
        share: share of the time after which rollouts stop.
        reached: whether anything was left undone.
        why: its reason, "time" or "interrupt".
    """

    minutes: float = float("inf")
    where: str = "[audit] minutes"
    share: float = 1.0 - KEPT
    began: float = field(default_factory=time.monotonic)
    reached: bool = False
    why: str = ""
    _spent: dict[str, float] = field(default_factory=dict)
    _stages: list[str] = field(default_factory=lambda: [BETWEEN_STAGES])
    _charged: float = field(default_factory=time.monotonic)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time within for a stage; nested stages count for the innermost."""
        self._charge()
        self._stages.append(name)
        try:
            yield
        finally:
            self._charge()
            self._stages.pop()

    def recall(self, seconds: float) -> None:
        """Count the time that an earlier part of the run spent on a result that is now looked up."""
        self._spent[self._stages[-1]] = self._spent.get(self._stages[-1], 0.0) + seconds

    @property
    def profile(self) -> dict[str, float]:
        """Seconds of each stage up to now, in all parts of the run."""
        self._charge()
        return dict(self._spent)

    def _charge(self) -> None:
        now = time.monotonic()
        self.recall(now - self._charged)
        self._charged = now

    @property
    def remaining(self) -> float:
        """Minutes until rollouts stop."""
        return self.share * self.minutes - (time.monotonic() - self.began) / 60.0

    def check(self) -> None:
        """Raise OutOfTime once the time is up, or after Ctrl-C."""
        self._charge()
        if self.why != INTERRUPT and interrupted():
            self._stop(INTERRUPT)
        if self.remaining <= 0.0:
            self._stop(TIME)

    def _stop(self, why: str) -> NoReturn:
        self.reached, self.why = True, self.why or why
        raise OutOfTime

    @contextmanager
    def stopping(self, report: Callable[[str], None]) -> Iterator[None]:
        """Block that the time limit or Ctrl-C may end; execution continues after it."""
        try:
            yield
        except (OutOfTime, KeyboardInterrupt):
            self.reached, self.why = True, self.why or INTERRUPT
            answer_interrupt()
            report("the time is up" if self.why == TIME else "stopping: the answer has the present results")

    @contextmanager
    def granted(self, seconds: float | None = None) -> Iterator[None]:
        """Grant ``seconds`` from now; by default the reserve for the end, once the time is up."""
        minutes, share = self.minutes, self.share
        if seconds is None:
            seconds = 60.0 * KEPT * minutes if self.why == TIME else PATIENCE
        self.minutes, self.share = (time.monotonic() - self.began + seconds) / 60.0, 1.0
        try:
            yield
        finally:
            self.minutes, self.share = minutes, share

    @contextmanager
    def reserve(self) -> Iterator[None]:
        """Release the time that is reserved for the gain."""
        share, self.share = self.share, 1.0
        try:
            yield
        finally:
            self.share = share

    def lift(self) -> None:
        """No limit from now on."""
        self.minutes = float("inf")


def about(seconds: float) -> str:
    """A time in words, rounded to its accuracy."""
    if seconds < 90.0:
        return f"about {max(round(seconds), 1)} s"
    return f"about {seconds / 60.0:.0f} min"
