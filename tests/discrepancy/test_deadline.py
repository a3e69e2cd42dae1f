"""What an audit says of its time on a machine that others use."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from rfdropo_bayes import interrupts
from rfdropo_bayes.discrepancy.deadline import Deadline, delay, thread_times

needs_counts = pytest.mark.skipif(not thread_times(), reason="this system does not count how long threads wait")


@pytest.mark.parametrize(
    ("ran", "waited", "expected"),
    [
        ([10.0], [0.0], 0.0),  # alone
        ([2.0], [8.0], 8.0),  # a fifth of a processor
        ([2.0, 2.0], [8.0, 8.0], 8.0),  # two threads with a fifth each
        ([5.0, 5.0, 5.0, 5.0], [5.0, 5.0, 5.0, 5.0], 0.0),  # four of its own share two processors
        ([0.5], [0.0], 0.0),  # another process computes
        ([1.0], [2.0], 2.0),  # in turns with another process
    ],
)
def test_a_run_is_delayed_by_others_and_not_by_itself(ran, waited, expected):
    times = {str(k): pair for k, pair in enumerate(zip(ran, waited, strict=True))}
    assert delay(10.0, {}, times, 2) == pytest.approx(expected)
    earlier = dict.fromkeys(times, (100.0, 50.0))
    later = {name: (100.0 + a, 50.0 + b) for name, (a, b) in times.items()}
    assert delay(10.0, earlier, later, 2) == pytest.approx(expected)


@needs_counts
def test_the_clock_counts_what_another_program_takes():
    """Both want the same processor for half a second of the clock: each gets half of it, or less on a busy machine."""
    mine = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(mine)})
    other = subprocess.Popen([sys.executable, "-c", "print(flush=True)\nwhile True: pass"], stdout=subprocess.PIPE)
    try:
        other.stdout.read(1)  # it has begun
        clock = Deadline(1.0)
        with clock.stage("base model"):
            while time.monotonic() < clock.began + 0.5:
                pass
        elapsed, waited = time.monotonic() - clock.began, clock.waited
    finally:
        other.kill()
        other.communicate()
        os.sched_setaffinity(0, mine)
    assert 0.12 < waited < elapsed
    assert clock.remaining == pytest.approx(clock.share - (time.monotonic() - clock.began) / 60.0, abs=1e-3)


def test_ctrl_c_ends_what_may_be_stopped_and_is_answered_then(monkeypatch):
    """The first press ends the audit at its next check; the answer after that is not stopped by the same press."""
    monkeypatch.setattr(interrupts, "_pressed", 1)
    clock, lines = Deadline(minutes=10.0), list[str]()
    with clock.stopping(lines.append):
        clock.check()
        raise AssertionError
    assert (clock.reached, clock.why) == (True, "interrupt")
    assert not interrupts.interrupted()
    assert [line.partition(":")[0] for line in lines] == ["stopping"]
    with clock.granted():
        clock.check()
        assert 0.0 < clock.remaining < 1.0


def test_the_time_that_is_kept_is_granted_once_the_time_is_up():
    clock = Deadline(minutes=0.0)
    with clock.stopping(lambda line: None):
        clock.check()
        raise AssertionError
    assert clock.why == "time"
    clock.minutes = 10.0
    with clock.granted():
        assert clock.remaining == pytest.approx(1.5, abs=0.05)
