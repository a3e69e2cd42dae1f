"""Progress of a long inference: a bar with the time left for people, one JSON line per stage for programs."""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from rfdropo_bayes.files import append_line
from rfdropo_bayes.interrupts import check_interrupt

SHOWN = ("horizon", "ess", "acceptance", "loss", "rollouts")
SECONDS_BETWEEN_LINES = 30.0  # where there is no terminal
UNFINISHED = 0.99  # what rollouts alone can fill of the bar: stages say when the work is done
SMALLEST_SHARE = 0.01  # of the work, from whose time that of the rest is guessed


class Progress:
    """Reports stages, and rollouts between them. Nothing of it influences a result.

    Args:
        title: what is running.
        show: draw a bar on stderr; None draws it on a terminal, and prints a line now and then elsewhere.
        log: file that gets one JSON object per line and stage, appended.
        budget: rollouts that the work takes at most, which move the bar between stages.
    """

    def __init__(
        self, title: str = "", *, show: bool | None = False, log: Path | None = None, budget: float | None = None
    ) -> None:
        self.log, self.title, self.budget = log, title, budget
        self.share = 0.0
        self._spent = 0.0
        self._words = ""
        self._began = self._printed = time.monotonic()
        self._first: tuple[float, float] | None = None  # time and share of the first report: compiling came before it
        self._prints = show is None and not sys.stderr.isatty()
        self._bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}  {task.fields[words]}"),
            console=Console(stderr=True),
            disable=show is False or self._prints,
            transient=False,
        )
        self._task = self._bar.add_task(title, total=1.0, left="", words="")

    def __enter__(self) -> Progress:
        self._bar.start()
        if self._prints:
            self._print("0 %, compiling")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def spend(self, rollouts: float) -> None:
        """Report rollouts as they are done, in full-length ones."""
        check_interrupt()
        self._spent += rollouts
        if self.budget:
            self._move(min(self._spent / self.budget, UNFINISHED))

    def stage(self, share: float, **facts: Any) -> None:
        """Report the end of a stage.

        Args:
            share: part of the work that is done, 0 to 1.
            facts: numbers of the stage.

        Raises:
            InputError: the log cannot be written.
        """
        check_interrupt()
        shown = {k: v for k, v in facts.items() if k in SHOWN and v is not None}
        self._words = ", ".join(f"{k} {v:.3g}" for k, v in shown.items())
        self._move(min(share, 1.0))
        if self.log is not None:
            line = {"time": time.time(), "elapsed": time.monotonic() - self._began, "run": self.title, **facts}
            append_line(self.log, json.dumps({k: _plain(v) for k, v in line.items()}))

    @property
    def seconds_left(self) -> float | None:
        """At the pace since the first report; None where too little is done since to say."""
        if self._first is None or self.share - self._first[1] < SMALLEST_SHARE:
            return None
        return (time.monotonic() - self._first[0]) * (1.0 - self.share) / (self.share - self._first[1])

    def _move(self, share: float) -> None:
        ends = self.share < 1.0 <= share
        self.share = max(self.share, share)
        now = time.monotonic()
        if self._first is None:
            self._first = (now, self.share)
        left = self.seconds_left
        words = "" if left is None or self.share >= 1.0 else f"{clock(left)} left"
        self._bar.update(self._task, completed=self.share, left=words, words=self._words)
        if self._prints and (ends or now - self._printed >= SECONDS_BETWEEN_LINES):
            self._printed = now
            parts = [f"{100 * self.share:.0f} %", clock(now - self._began), words, self._words]
            self._print(", ".join(part for part in parts if part))

    def _print(self, words: str) -> None:
        print(f"{self.title}: {words}", file=sys.stderr, flush=True)


def clock(seconds: float) -> str:
    """Hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


def _plain(value: Any) -> Any:
    """Numbers that JSON has not become null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
