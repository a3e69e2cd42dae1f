"""The emergency stop in software: a thread that listens to a key, signals and hooks, and stops the drives itself.

It stands beside the hardware one, never in its place.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rfdropo_bayes.deployment.clock import real_time

SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
POLL = 0.005  # [s]
STOP_KEYS = b" \x1bqQ\n\r"

Hook = Callable[[], bool | str]  # returns True, or a word for the log, while a button is pressed


def file_hook(path: Path) -> Hook:
    """A hook that reads a file, as the kernel shows a GPIO pin (/sys/class/gpio/gpio17/value); 0 is pressed.

    A file that cannot be read counts as pressed: a wire that came off must stop the robot.
    """

    def look() -> bool:
        try:
            return path.read_text().strip() == "0"
        except OSError:
            return True

    return look


class StopSignals:
    """Keeps SIGINT, SIGTERM and SIGHUP from ending the program, and reports each signal to the emergency stop.

    The interpreter writes each signal to a socket from whichever thread the system gave it to, at once; the main
    thread, which may be busy, is not asked. Outside the main thread Python cannot take signals: the program's own
    handlers then stay.
    """

    def __enter__(self) -> StopSignals:
        self._theirs, self._ours = socket.socketpair()
        self._theirs.setblocking(False)
        self._ours.setblocking(False)
        self._before: dict[signal.Signals, Any] = {}
        if threading.current_thread() is threading.main_thread():
            self._wakeup = signal.set_wakeup_fd(self._theirs.fileno(), warn_on_full_buffer=False)
            for number in SIGNALS:
                self._before[number] = signal.signal(number, lambda *_: None)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._before:
            signal.set_wakeup_fd(self._wakeup)
        self._theirs.close()
        self._ours.close()

    def arrived(self) -> str:
        """Name of a signal that has come; empty if none."""
        try:
            numbers = set(self._ours.recv(64)) & {int(number) for number in SIGNALS}
        except BlockingIOError:
            return ""
        return f"signal {signal.Signals(min(numbers)).name}" if numbers else ""


class EmergencyStop:
    """Calls ``stop`` once, when a button is pressed or the control loop falls silent.

    Args:
        stop: called from this object's thread with the event and whether it was silence; it must not wait for the
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
        """Stop; presses after the first are ignored."""
        if not self.pressed:
            self.pressed = what
            self._stop(what, silence)

    def _run(self) -> None:
        with real_time(), self._raw_terminal():
            while not self._done.is_set():
                if what := self._look():
                    self.press(what)
                elif quiet := self._silence():
                    self.press(f"the control loop has been silent for {1e3 * quiet:.0f} ms", silence=True)
                time.sleep(POLL)

    def _look(self) -> str:
        for hook in self._hooks:
            if request := hook():
                return request if isinstance(request, str) else "button"
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
