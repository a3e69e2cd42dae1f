"""Ctrl-C: a run stops at a point from which it can continue, without a traceback.

An exception raised at any place is not enough: modules that are being imported swallow it or crash, and JAX replaces an
exception that is raised in a callback of compiled code.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Literal

EXIT_STATUS = 3
NOTHING_LOST = "interrupted; nothing is lost"
STOPPING = "stopping at the end of this step; Ctrl-C again stops at once"

_pressed = 0
_answer: Literal["exit", "raise", "note"] = "exit"


def watch_interrupts() -> None:
    """Answer Ctrl-C from now on: outside of `running`, the program ends at once."""
    global _pressed
    _pressed = 0
    signal.signal(signal.SIGINT, _note)


@contextmanager
def running(*, checks: bool) -> Iterator[None]:
    """A part in which Ctrl-C raises KeyboardInterrupt; with ``checks``, the first press raises in `check_interrupt`."""
    global _answer
    before, _answer = _answer, "note" if checks else "raise"
    try:
        yield
    finally:
        _answer = before


def interrupted() -> bool:
    """Whether Ctrl-C was pressed since `watch_interrupts`."""
    return _pressed > 0


def check_interrupt() -> None:
    """Raise KeyboardInterrupt if Ctrl-C was pressed."""
    if interrupted():
        raise KeyboardInterrupt


def answer_interrupt() -> None:
    """Take Ctrl-C for answered: the run ends with what it has, and the next press stops that, too."""
    global _pressed
    _pressed = 0


def stop_if_asked_twice() -> None:
    """Raise KeyboardInterrupt if Ctrl-C was pressed more than once. Long steps call this function, since compiled code
    with callbacks may lose the exception of the second press.
    """
    if _pressed > 1:
        raise KeyboardInterrupt


def _note(number: int, frame: FrameType | None) -> None:
    global _pressed
    _pressed += 1
    if _answer == "exit":
        os.write(2, f"rfdropo: {NOTHING_LOST}\n".encode())
        os._exit(EXIT_STATUS)
    if _answer == "raise" or _pressed > 1:
        raise KeyboardInterrupt
    os.write(2, f"\nrfdropo: {STOPPING}\n".encode())
