"""The emergency stop: a signal, a button, a wire that came off, a control loop that hangs."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from rfdropo_bayes.deployment.clock import CycleClock, measure_jitter
from rfdropo_bayes.deployment.emergency import EmergencyStop, StopSignals, file_hook


class Listener:
    """Notes what was pressed, and when."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, bool]] = []
        self.at = 0.0
        self.event = threading.Event()

    def __call__(self, what: str, silence: bool) -> None:
        self.heard.append((what, silence))
        self.at = time.monotonic()
        self.event.set()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_and_does_not_end_the_program(number: signal.Signals) -> None:
    listener = Listener()
    with StopSignals() as signals, EmergencyStop(listener, (signals.arrived,), keyboard=False):
        os.kill(os.getpid(), number)
        assert listener.event.wait(2.0)
    assert listener.heard == [(f"signal {number.name}", False)]


def test_handlers_are_given_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopSignals():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


def test_a_button_and_a_wire_that_came_off(tmp_path: Path) -> None:
    pin = tmp_path / "value"
    pin.write_text("1\n")
    hook = file_hook(pin)
    assert not hook()
    pin.write_text("0\n")
    assert hook()
    pin.unlink()
    assert hook()


def test_it_presses_once() -> None:
    listener = Listener()
    with EmergencyStop(listener, (lambda: True,), keyboard=False):
        listener.event.wait(2.0)
        time.sleep(0.05)
    assert listener.heard == [("button", False)]


def test_a_loop_that_hangs_is_noticed() -> None:
    listener, start = Listener(), time.monotonic()
    with EmergencyStop(listener, pulse=lambda: start, patience=0.1, keyboard=False):
        assert listener.event.wait(2.0)
    ((what, silence),) = listener.heard
    assert silence
    assert "silent" in what
    assert listener.at - start > 0.1


def test_late_beats_shift_no_later_one_and_are_counted() -> None:
    clock = CycleClock(0.02)
    first = clock.wait()
    time.sleep(0.07)
    late = clock.wait()
    after = clock.wait()
    assert late.missed >= 2
    assert after.number == late.number + 1
    assert (after.time - first.time) / 0.02 == pytest.approx(after.number - first.number, abs=1e-6)


def test_jitter_is_measured() -> None:
    found = measure_jitter(0.01, 0.2)
    assert len(found.lateness) == 20
    assert found.lateness.min() >= 0.0
