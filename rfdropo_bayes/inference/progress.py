"""Reports and checkpoints of a long inference.

- `Progress`: a bar with the time left for people, one JSON line per stage for programs.
- `say_step`: a report on the work after a bar.
- `Checkpoint`: a killed run continues from its last whole stage and ends with the same draws.
- `Logbook`: both of them, for a run or a part of one.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import append_line, whole
from rfdropo_bayes.inference.method_options import settings_text
from rfdropo_bayes.interrupts import check_interrupt

SCHEMA_VERSION = 6
_META = "meta_json"
SHOWN = ("horizon", "ess", "acceptance", "loss", "rollouts")
SECONDS_BETWEEN_LINES = 30.0  # without a terminal
UNFINISHED = 0.99  # share of the bar that rollouts can fill: stages report the end
SMALLEST_SHARE = 0.01  # of the work, from which the remaining time is estimated


class Progress:
    """Reports stages, and rollouts between them. Progress does not influence results.

    Args:
        title: name of the work.
        show: draw a bar on stderr; None draws it on a terminal, and prints a line now and then elsewhere.
        log: file that gets one JSON object per line and stage, appended.
        budget: largest number of rollouts, which moves the bar between stages.
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
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.percentage:3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}  {task.fields[words]}", markup=False),
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
        self._prints = False  # rollouts after the work, such as for predictions, are not part of it

    def spend(self, rollouts: float) -> None:
        """Report rollouts as they are done, in full-length equivalents."""
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
    def remaining_seconds(self) -> float | None:
        """Time left at the pace since the first report [s]; None until enough work is done."""
        if self._first is None or self.share - self._first[1] < SMALLEST_SHARE:
            return None
        return (time.monotonic() - self._first[0]) * (1.0 - self.share) / (self.share - self._first[1])

    def _move(self, share: float) -> None:
        ends = self.share < 1.0 <= share
        self.share = max(self.share, share)
        now = time.monotonic()
        if self._first is None:
            self._first = (now, self.share)
        remaining = self.remaining_seconds
        words = "" if remaining is None or self.share >= 1.0 else f"{clock(remaining)} left"
        self._bar.update(self._task, completed=self.share, left=words, words=self._words)
        if self._prints and (ends or now - self._printed >= SECONDS_BETWEEN_LINES):
            self._printed = now
            parts = [f"{100 * self.share:.0f} %", clock(now - self._began), words, self._words]
            self._print(", ".join(part for part in parts if part))

    def _print(self, words: str) -> None:
        print(f"{self.title}: {words}", file=sys.stderr, flush=True)


def say_step(words: str, *, show: bool | None = None) -> None:
    """Report the next step of a run on stderr if no bar shows it, and respond to Ctrl-C.

    Args:
        words: description of the step, such as "drawing report.html".
        show: False prints nothing, see `Progress`.
    """
    check_interrupt()
    if show is not False:
        print(words, file=sys.stderr, flush=True)


def say_lines(show: bool | None = None) -> Callable[[str], None]:
    """A function that reports interim results on stderr with the elapsed seconds, and responds to Ctrl-C.

    Args:
        show: False prints nothing, see `Progress`.
    """
    began = time.monotonic()

    def say(line: str) -> None:
        check_interrupt()
        if show is not False:
            print(f"  {time.monotonic() - began:5.0f} s  {line}", file=sys.stderr, flush=True)

    return say


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


def run_digest(problem: Problem, method: str, config: Any, key: PRNGKeyArray) -> str:
    """Digest of everything that a run's draws depend on: problem, method, its configuration and the random key.

    The problem is known by its names, units, bounds, rows, its prior's density at a few of its own draws, and its
    ``fingerprint``.
    """
    probe = problem.to_unconstrained(problem.sample_prior(jax.random.key(0), 3))
    parts = {
        "schema": SCHEMA_VERSION,
        "method": method,
        "config": settings_text(config),
        "key": np.asarray(jax.random.key_data(key)).tolist(),
        "names": list(problem.names),
        "units": dict(problem.units),
        "bounds": {name: [float(x) for x in problem.bounds[name]] for name in problem.names},
        "n_rows": int(problem.n_rows),
        "prior": [float(x).hex() for x in np.asarray(problem.log_prior(probe)).ravel()],
        "fingerprint": problem.fingerprint,
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


class Checkpoint:
    """One file, replaced after every stage, with arrays and a JSON text.

    Args:
        path: the file; ``None`` keeps nothing.
        digest: `run_digest` of the run; a file of another run is refused.
    """

    def __init__(self, path: Path | None, digest: str) -> None:
        self.path, self.digest = path, digest

    def save(self, arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
        """Write atomically: a kill leaves the previous or the new file, never a partial file."""
        if self.path is None:
            return
        text = json.dumps({"digest": self.digest, "schema_version": SCHEMA_VERSION, **meta})
        entries: dict[str, Any] = {_META: np.frombuffer(text.encode(), dtype=np.uint8), **arrays}
        with whole(self.path) as partial:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as file:
                np.savez(file, allow_pickle=False, **entries)
                file.flush()
                os.fsync(file.fileno())

    def load(self) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """Arrays and the rest of the last whole stage, or None without a checkpoint.

        Raises:
            InputError: the file is damaged, or belongs to another run.
        """
        if self.path is None or not self.path.exists():
            return None
        try:
            with self.path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files if name != _META}
                meta = json.loads(file[_META].tobytes())
            digest = meta["digest"]
        except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
            raise InputError(
                "the checkpoint is damaged", where=str(self.path), remedy="delete it and start without --resume"
            ) from error
        if digest != self.digest:
            raise InputError(
                "the checkpoint belongs to a run with other data, priors, settings or seed",
                where=str(self.path),
                remedy="resume with the experiment it was made by, or start without --resume",
            )
        return arrays, meta


def open_checkpoint(folder: Path | None, name: str, digest: str, *, resume: bool) -> Checkpoint:
    """Checkpoint ``folder/name.npz`` of a run; unless resumed, one left by an earlier run is removed."""
    if folder is None:
        return Checkpoint(None, digest)
    path = Path(folder) / f"{name}.npz"
    if not resume:
        path.unlink(missing_ok=True)
    return Checkpoint(path, digest)


UNSAVED = Checkpoint(None, "")


@dataclass(frozen=True)
class Logbook:
    """Checkpoints and progress of a run; the empty logbook stores and shows nothing."""

    folder: Path | None = None  # folder for checkpoints; None keeps none
    resume: bool = False  # continue from its checkpoints
    progress: Progress | None = None  # receives reports of stages
    # begin, end: shares of the whole work before and after this part
    begin: float = 0.0
    end: float = 1.0

    def checkpoint(self, name: str, digest: str) -> Checkpoint:
        """Checkpoint of a part of the run, see `open_checkpoint`."""
        return open_checkpoint(self.folder, name, digest, resume=self.resume)

    def part(self, begin: float, end: float, folder: str | None = None) -> Logbook:
        """Logbook of a part of the work, from share ``begin`` to ``end``, in a folder of its own if named."""
        own = self.folder if self.folder is None or folder is None else self.folder / folder
        width = self.end - self.begin
        return Logbook(own, self.resume, self.progress, self.begin + begin * width, self.begin + end * width)

    def stage(self, share: float, **facts: Any) -> None:
        """Report the end of a stage, see `Progress.stage`."""
        if self.progress is not None:
            self.progress.stage(self.begin + share * (self.end - self.begin), **facts)


UNRECORDED = Logbook()
