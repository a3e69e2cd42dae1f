"""Ctrl-C is answered at once outside of a run, at the next check within one, and at once when it is pressed again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from rfdropo_bayes import interrupts
from rfdropo_bayes.interrupts import (
    EXIT_STATUS,
    check_interrupt,
    interrupted,
    running,
    stop_if_asked_twice,
    watch_interrupts,
)


@pytest.fixture(autouse=True)
def own_handler():
    before = signal.getsignal(signal.SIGINT)
    watch_interrupts()
    yield
    signal.signal(signal.SIGINT, before)
    interrupts._pressed = 0


def press() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_a_run_with_checks_stops_at_the_next_one(capfd):
    with running(checks=True):
        check_interrupt()
        press()
        assert interrupted()
        assert "stopping at the end of this step" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            check_interrupt()


def test_a_second_press_stops_at_once():
    with running(checks=True):
        press()
        with pytest.raises(KeyboardInterrupt):
            press()


def test_a_second_press_that_was_swallowed_is_heard_at_the_next_step():
    with running(checks=True):
        press()
        stop_if_asked_twice()
        with suppress(KeyboardInterrupt):
            press()
        with pytest.raises(KeyboardInterrupt):
            stop_if_asked_twice()


def test_a_run_without_checks_stops_at_once():
    with running(checks=True):
        with running(checks=False), pytest.raises(KeyboardInterrupt):
            press()
        interrupts._pressed = 0
        press()  # the outer run has its checks again
        assert interrupted()


def test_outside_of_a_run_the_program_ends_at_once_whatever_catches():
    program = (
        "import os, signal\nfrom rfdropo_bayes.interrupts import watch_interrupts\nwatch_interrupts()\n"
        "try:\n    os.kill(os.getpid(), signal.SIGINT)\nexcept BaseException:\n    pass\nprint('swallowed')\n"
    )
    repository = Path(__file__).resolve().parents[1]
    environment = os.environ | {"PYTHONPATH": str(repository)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (EXIT_STATUS, "")
    assert done.stderr == "rfdropo: interrupted; nothing is lost\n"
