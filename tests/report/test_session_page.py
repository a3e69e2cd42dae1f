"""The page of a motor session: its numbers are those of the recording, and its advice has a ground."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import xarray as xr

from rfdropo_bayes.data import GOAL_AXES, Trajectory
from rfdropo_bayes.report import session_page
from rfdropo_bayes.report.session_page import MotorSession, distance_to_goal, drive_rows, render_session, session_steps
from tests.undrawn import without_panels

GOAL = {"x": 0.0, "y": 0.0, "z": 0.2}


def recording(channels: int = 1, rows: int = 20, lag: float = 0.001, clipped: bool = False) -> Trajectory:
    """A session whose drives are short of their set-points by ``lag`` [m], and whose tip ends 3 mm from the goal."""
    time = 0.01 * np.arange(rows)
    set_point = np.tile(np.linspace(0.0, 0.02, rows)[:, None], channels)
    position = np.tile([0.0, 0.0, 0.2], (rows, 1, 1))
    position[:, 0, 0] = np.linspace(0.05, 0.003, rows)
    found = Trajectory.from_arrays(
        time=time,
        position=position,
        command=set_point[::5],
        command_time=time[::5],
        markers=["tip"],
        channels=[f"a very long name of motor number {k}" for k in range(channels)],
        initial_command="zero",
        tension=np.where(np.arange(rows)[:, None] % 2 == 0, 4.0, np.nan) * np.ones(channels),
    )
    cycle, command = ("time", "cable"), ("command_time", "cable")
    asked = found.command + (0.01 if clipped else 0.0)
    beside: dict[str, Any] = {
        "set_point": xr.Variable(cycle, set_point),
        "length": xr.Variable(cycle, set_point - lag),
        "phase": xr.Variable("time", np.where(np.arange(rows) < rows - 1, 5, 7)),
        "lateness": xr.Variable("time", np.full(rows, 2e-5)),
        "asked_command": xr.Variable(command, asked),
    }
    return Trajectory(found.dataset.assign(beside))


def session(cause: str = "finished", missed: int = 0, simulated: bool = False, **more: Any) -> MotorSession:
    late = {"p50": 1e-5, "p99": 2e-5, "max": 3e-5}
    figures = {
        "cycles": 20, "period_s": 0.01, "missed": missed, "lateness_s": late, "act_s": late, "stop_s": None,
    }  # fmt: skip
    summary = {
        "mode": "run", "robot": "arm", "cause": cause, "detail": "cable <3>", "facts": {"simulated": simulated},
        "figures": figures, "without": {}, "versions": {"numpy": "2"},
    }  # fmt: skip
    events = [
        {"monotonic": 5.0, "event": "checked", "text": "drive 'a'"},
        {"monotonic": 7.5, "event": "stop", "text": cause},
    ]
    made = recording(**more) if more.pop("recorded", True) else None
    return MotorSession("session_1", summary, events, "robot = 'arm'", GOAL, made)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's words alone: its pictures take seconds."""
    monkeypatch.setattr(session_page, "embed", without_panels)


def test_rows_of_drives_are_those_of_the_recording():
    (row,) = drive_rows(recording(lag=0.002))
    assert row["rms"] == pytest.approx(2.0)
    assert row["most"] == pytest.approx(2.0)
    assert (row["low"], row["high"]) == pytest.approx((-2.0, 18.0))
    assert row["tension"] == 4.0
    assert row["silent"] == 50.0


@pytest.mark.usefixtures("undrawn")
def test_the_distance_is_that_where_the_policys_time_ended():
    found = recording()
    time, distance = distance_to_goal(found, GOAL)
    assert len(time) == len(found.time)
    assert distance[-1] == pytest.approx(0.003)
    before_rest = 1e3 * distance[-2]
    assert f"<strong>{before_rest:.3g} mm</strong>" in render_session(session())
    assert len(distance_to_goal(found, {})[0]) == 0


@pytest.mark.usefixtures("undrawn")
def test_an_object_that_is_pushed_is_judged_along_its_plate():
    """It ends 4 mm from the goal along the plate, of which x and z are the axes, and 30 mm below it."""
    found = recording()
    pose = np.tile([0.0, -0.03, 0.2, 0.0, 0.0, 0.0, 1.0], (len(found.time), 1))
    pose[:, 0] = np.linspace(0.05, 0.004, len(found.time))
    pose[3] = np.nan
    dataset = found.dataset.assign(object_pose=(("time", "pose"), pose))
    pushed = Trajectory(dataset).with_attributes(settings={GOAL_AXES: [0, 2]})
    time, distance = distance_to_goal(pushed, GOAL)
    assert len(time) == len(found.time) - 1
    assert distance[-1] == pytest.approx(0.004)
    assert "The object was <strong>" in render_session(session()._replace(recording=pushed))
    assert "The last marker, tip, was <strong>" in render_session(session())


def test_commands_that_no_drive_carried_out_are_no_data():
    shadow = recording().with_attributes(settings={"mode": "shadow"})
    steps = session_steps(session()._replace(recording=shadow))
    assert "No drive has carried these commands out" in steps[-1]
    assert not any("under fit" in step for step in steps)


@pytest.mark.parametrize(("channels", "rows"), [(1, 20), pytest.param(9, 20, marks=pytest.mark.slow), (2, 6)])
def test_a_page_is_drawn_for_any_number_of_drives(channels, rows):
    page = render_session(session(channels=channels, rows=rows))
    assert page.count("<td>a very long") == channels
    assert "2.50</td><td>stop" in page


@pytest.mark.usefixtures("undrawn")
def test_a_session_that_was_stopped_says_why_and_what_to_do():
    stopped = session("markers_lost", missed=3)
    page = render_session(stopped)
    assert "<strong>markers lost</strong> (cable &lt;3&gt;)" in page
    first, second, *_ = session_steps(stopped)
    assert "cameras" in first
    assert "3 cycles missed" in second
    assert "cameras" not in " ".join(session_steps(session()))


def test_clipped_commands_and_simulated_drives_are_named():
    assert any("held back 100 %" in step for step in session_steps(session(clipped=True)))
    assert not any("held back" in step for step in session_steps(session()))
    assert any("were simulated" in step for step in session_steps(session(simulated=True)))


def test_commands_that_bring_drives_to_rest_or_home_them_are_no_actions_held_back():
    """Nobody has asked for them."""
    made = session(clipped=True)
    assert made.recording is not None
    phase = made.recording.dataset["phase"]
    row = np.searchsorted(made.recording.time, made.recording.command_time[-1])
    asked = made.recording.dataset["asked_command"].copy()
    asked[:-1] = made.recording.command[:-1]
    stopping = {"phase": phase.copy(data=np.where(np.arange(len(phase)) < row, 5, 6)), "asked_command": asked}
    homing = {"phase": phase.copy(data=np.where(np.arange(len(phase)) < 2, 1, 2))}
    homing["asked_command"] = asked.copy(data=np.zeros(asked.shape))
    for changed in (stopping, homing):
        kept = made._replace(recording=Trajectory(made.recording.dataset.assign(changed)))
        assert not any("held back" in step for step in session_steps(kept))


def test_a_session_without_a_recording_has_a_page():
    bare = session()._replace(recording=None)
    bare.summary["figures"].clear()
    page = render_session(bare)
    assert "Nothing was recorded" in page
    assert 'href="#drives"' not in page
