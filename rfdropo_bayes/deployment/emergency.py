"""The emergency stop in software: a thread of its own that listens to a key, signals and a hook, and stops the drives itself.

It stands beside the hardware one, never in its place.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

from rfdropo_bayes.deployment.clock import schedule_fifo

SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
POLL = 0.005  # [s]
STOP_KEYS = b" \x1bqQ\n\r"

Hook = Callable[[], bool]


def file_hook(path: Path, pressed: str) -> Hook:
    """A hook that reads a file, as the kernel shows a GPIO pin (/sys/class/gpio/gpio17/value).

    A file that cannot be read counts as pressed: a wire that came off must stop the robot.
    """

    def look() -> bool:
        try:
            return path.read_text().strip() == pressed
        except OSError:
            return True

    return look


@contextlib.contextmanager
def signals_held() -> Iterator[None]:
    """Keep the stop signals from this thread, and from those it starts, so that the emergency stop alone takes them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class EmergencyStop:
    """Listens, and calls ``stop`` once: with what was pressed, or that the control loop is silent.

    Args:
        stop: called from this object's thread with what happened and whether it was silence; it must not wait for the
            control loop.
        hooks: each returns True while its button is pressed.
        pulse: time of the control loop's last cycle [s, monotonic], or None while none is due.
        patience: a loop that has been silent for longer [s] is stopped too.
        keyboard: whether a key of the terminal stops.
    """

    def __init__(
        self,
        stop: Callable[[str, bool], None],
        hooks: tuple[Hook, ...] = (),
        pulse: Callable[[], float | None] = lambda: None,
        patience: float = 0.05,
        keyboard: bool = True,
    ) -> None:
        self._stop, self._hooks, self._pulse, self._patience = stop, hooks, pulse, patience
        self._keyboard = keyboard and sys.stdin is not None and sys.stdin.isatty()
        self._done = threading.Event()
        self.pressed = ""
        self._thread = threading.Thread(target=self._run, name="emergency stop", daemon=True)

    def __enter__(self) -> EmergencyStop:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def press(self, what: str, silence: bool = False) -> None:
        """Stop; what is pressed after the first counts no more."""
        if not self.pressed:
            self.pressed = what
            self._stop(what, silence)

    def _run(self) -> None:
        schedule_fifo()
        with self._raw_terminal():
            while not self._done.is_set():
                if what := self._look():
                    self.press(what)
                elif quiet := self._silence():
                    self.press(f"the control loop has been silent for {1e3 * quiet:.0f} ms", silence=True)
                time.sleep(POLL)

    def _look(self) -> str:
        with contextlib.suppress(InterruptedError):
            got = signal.sigtimedwait(SIGNALS, 0)
            if got is not None:
                return f"signal {signal.Signals(got.si_signo).name}"
        for hook in self._hooks:
            if hook():
                return "button"
        if self._keyboard and select.select([sys.stdin], [], [], 0)[0]:
            key = os.read(sys.stdin.fileno(), 1)
            if key in [bytes([code]) for code in STOP_KEYS]:
                return "key"
        return ""

    def _silence(self) -> float:
        """For how long [s] the control loop has been silent, if that is too long; else 0."""
        pulse = self._pulse()
        quiet = 0.0 if pulse is None else time.monotonic() - pulse
        return quiet if quiet > self._patience else 0.0

    @contextlib.contextmanager
    def _raw_terminal(self) -> Iterator[None]:
        """Keys at once instead of line by line."""
        if not self._keyboard:
            yield
            return
        number = sys.stdin.fileno()
        before = termios.tcgetattr(number)
        tty.setcbreak(number)
        try:
            yield
        finally:
            termios.tcsetattr(number, termios.TCSADRAIN, before)
