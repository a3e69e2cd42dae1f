"""An audit ends at its next check after Ctrl-C."""

from __future__ import annotations

import pytest

from rfdropo_bayes import interrupts
from rfdropo_bayes.discrepancy.deadline import Deadline


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
