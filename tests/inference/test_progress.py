"""Progress: it moves between stages, says how long it will take, and speaks in lines where there is no terminal."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import progress as module
from rfdropo_bayes.inference.progress import Progress, clock, say_step

FULL = Path("/dev/full")  # a device that every write finds full


@pytest.fixture
def seconds(monkeypatch):
    """A clock that the test moves."""
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def test_it_moves_with_rollouts_and_tells_the_time_that_is_left(seconds):
    with Progress("smc", budget=200.0) as progress:
        seconds[0] = 30.0  # compiling
        progress.spend(20.0)
        assert progress.remaining_seconds is None
        seconds[0] = 40.0
        progress.spend(20.0)
        assert progress.share == pytest.approx(0.2)
        assert progress.remaining_seconds == pytest.approx(80.0)  # 10 % took 10 s, 80 % are left
        progress.spend(1000.0)
        assert progress.share == module.UNFINISHED
        progress.stage(1.0)
        assert progress.share == 1.0


def test_it_never_moves_back():
    with Progress("smc", budget=100.0) as progress:
        progress.stage(0.5)
        progress.spend(10.0)
        assert progress.share == 0.5


def test_lines_now_and_then_without_a_terminal(seconds, capsys):
    with Progress("smc", show=None, budget=100.0) as progress:
        for _ in range(100):
            seconds[0] += 1.0
            progress.spend(0.9)
        progress.stage(1.0, rollouts=90.0)
        progress.stage(1.0, rollouts=90.0)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "smc: 0 %, compiling"
    assert lines[1] == "smc: 27 %, 0:00:30, 0:01:21 left"
    assert lines[-1] == "smc: 100 %, 0:01:40, rollouts 90"
    assert len(lines) == 5


def test_nothing_is_said_when_nothing_is_to_be_shown(capsys):
    with Progress("smc", show=False) as progress:
        progress.stage(1.0)
    assert capsys.readouterr().err == ""


def test_what_runs_after_the_work_is_said_and_no_longer_counted(seconds, capsys):
    with Progress("smc", show=None, budget=100.0) as progress:
        progress.stage(1.0)
    capsys.readouterr()
    seconds[0] += 100.0
    progress.spend(50.0)
    say_step("predicting", show=None)
    say_step("nothing", show=False)
    assert capsys.readouterr().err == "predicting\n"


def test_a_log_that_cannot_be_written_is_one_line():
    with pytest.raises(InputError, match="make room on the disk") as raised, Progress("smc", log=FULL) as progress:
        progress.stage(0.5)
    assert "\n" not in str(raised.value)


def test_the_log_holds_plain_json(tmp_path):
    with Progress("smc", log=tmp_path / "sub" / "log.jsonl") as progress:
        progress.stage(0.5, ess=float("nan"))
    assert json.loads((tmp_path / "sub" / "log.jsonl").read_text())["ess"] is None


def test_clock():
    assert clock(3725.4) == "1:02:05"
