"""report.html of a motor session: end, tracking by the drives, punctuality, next steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import GOAL_AXES, Trajectory
from rfdropo_bayes.report.page import render
from rfdropo_bayes.report.session_figures import commands_figure, drives_figure, goal_figure, punctuality_figure
from rfdropo_bayes.report.style import embed

SECTIONS = (
    ("result", "Result"),
    ("drives", "Set-points and reached lengths"),
    ("goal", "Distance to the goal"),
    ("commands", "Commands of the policy"),
    ("timing", "Punctuality"),
    ("events", "Events"),
    ("reproduce", "To reproduce"),
)
PLANNED = "finished"
ROUTINE = "checked"  # the kind of event that every drive has, whatever happens
CLIPPED = 1e-9  # rounding error of a command, in its own unit; larger differences mean that it was clipped
REMEDIES = {
    "deadlines_missed": "Keep other work off this machine, and give the loop real-time scheduling: rfdropo doctor "
    "measures both.",
    "markers_lost": "See whether the cameras see every marker in the final pose of the session.",
    "tension": "Compare the limit in [safety] with the tensions in the table below.",
    "following_error": "Lower rate_limit_m_s, or find the obstacle that holds the cable back.",
    "action_outside": "The policy met a scene that its training did not have: see the commands below.",
    "action_not_finite": "See the last rows of session.nc: a marker or the policy gave a number that is not finite.",
    "heartbeat_lost": "See the wiring, the supply and the terminating resistors of the bus.",
    "stale_status": "See the wiring, the supply and the terminating resistors of the bus.",
    "homing_failed": "Let the cables hang loose, turn each drum by hand, and home again.",
}
"""First remedy for each cause that ends a session, by its key in summary.json."""


class MotorSession(NamedTuple):
    """Files of a motor session."""

    name: str  # name of its folder
    summary: Mapping[str, Any]  # content of summary.json
    events: Sequence[Mapping[str, Any]]  # lines of log.jsonl
    config: str  # config.toml as text, and ``goal`` its goal [m] by axis
    goal: Mapping[str, float]
    recording: Trajectory | None  # session.nc; None if a session recorded nothing, as a check does


def render_session(session: MotorSession) -> str:
    """HTML of the page."""
    recording, figures = session.recording, session.summary["figures"]
    pictures = {}
    if recording is not None:
        pictures["drives"] = embed(drives_figure(recording), "Set-point and reached length of every cable")
        pictures["commands"] = embed(commands_figure(recording), "Commands asked for and in force, by channel")
        pictures["timing"] = embed(punctuality_figure(recording, figures["period_s"]), "How late the cycles began")
        time, distance = distance_to_goal(recording, session.goal)
        if len(distance):
            pictures["goal"] = embed(goal_figure(time, distance), f"Distance of {_goal_point(recording)} from the goal")
    shown = [(anchor, words) for anchor, words in SECTIONS if anchor in (*pictures, "result", "events", "reproduce")]
    began = session.events[0]["monotonic"] if session.events else 0.0
    return render(
        "session.html.j2",
        session=session,
        sections=shown,
        pictures=pictures,
        drives=[] if recording is None else drive_rows(recording),
        ended_at=None if recording is None else _final_distance(recording, session.goal),
        goal_point=None if recording is None else _goal_point(recording),
        seconds=0.0 if recording is None else float(recording.time[-1]),
        events=[(each["monotonic"] - began, each) for each in session.events if each["event"] != ROUTINE],
        checked=sum(each["event"] == ROUTINE for each in session.events),
        advice=session_steps(session),
    )


def drive_rows(recording: Trajectory) -> list[dict[str, Any]]:
    """Tracking of each drive: range and differences [mm], greatest tension [N], cycles without an answer [%]."""
    set_point, length = (1e3 * recording.dataset[name].to_numpy() for name in ("set_point", "length"))
    tension, answered = recording.dataset["tension"].to_numpy(), recording.tension_mask
    assert answered is not None
    apart = length - set_point
    return [
        {
            "name": name,
            "low": float(length[:, k].min()),
            "high": float(length[:, k].max()),
            "rms": float(np.sqrt(np.mean(apart[:, k] ** 2))),
            "most": float(np.abs(apart[:, k]).max()),
            "tension": float(tension[answered[:, k], k].max()) if answered[:, k].any() else None,
            "silent": 100.0 * float(1.0 - answered[:, k].mean()),
        }
        for k, name in enumerate(recording.cable_names)
    ]


def distance_to_goal(
    recording: Trajectory, goal: Mapping[str, float]
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"]]:
    """Times [s] at which the last marker, or the object that is pushed, was seen, and its distance from a goal [m];
    empty without a goal. An object's is that along its plate."""
    axes, track, seen = [0, 1, 2], recording.position[:, -1], recording.position_mask[:, -1]
    if _pushes(recording):
        if recording.object_pose is None:
            return np.empty(0), np.empty(0)
        axes, track = recording.settings[GOAL_AXES], recording.object_pose[:, :3]
        seen = np.isfinite(track).all(axis=1)
    if set(goal) != set("xyz") or not seen.any():
        return np.empty(0), np.empty(0)
    place = np.array([goal[axis] for axis in "xyz"])
    return recording.time[seen], np.linalg.norm((track[seen] - place)[:, axes], axis=1)


def _pushes(recording: Trajectory) -> bool:
    """Whether an object is to reach the goal."""
    return GOAL_AXES in recording.settings


def _goal_point(recording: Trajectory) -> str:
    """Name of the marker or object that must reach the goal."""
    return "the object" if _pushes(recording) else f"the last marker, {recording.marker_names[-1]},"


def _final_distance(recording: Trajectory, goal: Mapping[str, float]) -> float | None:
    """Distance [mm] from the goal at the end of the policy's time; the phases in which drives come to rest follow
    it.
    """
    phase = recording.dataset["phase"].to_numpy()
    last = recording.time[phase == phase[0]][-1]
    time, distance = distance_to_goal(recording, goal)
    return 1e3 * float(distance[time <= last][-1]) if (time <= last).any() else None


def _clipped_share(recording: Trajectory) -> float:
    """Share of the actions whose executed command differs from the requested command. Commands during stopping and
    homing are not counted.
    """
    phase, asked = recording.dataset["phase"].to_numpy(), recording.dataset["asked_command"].to_numpy()
    row = np.minimum(np.searchsorted(recording.time, recording.command_time), len(phase) - 1)
    acting = phase[row] == phase[0]
    apart = np.any(np.abs(asked - recording.command) > CLIPPED, axis=1)
    return float(np.mean(apart[acting])) if acting.any() else 0.0


def session_steps(session: MotorSession) -> list[str]:
    """Recommended next steps, each a sentence with its reason."""
    summary, recording, steps = session.summary, session.recording, []
    cause, figures = summary["cause"], summary["figures"]
    if cause != PLANNED:
        steps.append(REMEDIES.get(cause, "Correct the cause that is named above, and run --mode check again."))
    if figures and figures["missed"]:
        steps.append(f"{figures['missed']} cycles missed their time: run rfdropo doctor to find the reason.")
    lacking = [channel for channel, guards in summary["without"].items() if guards]
    if lacking:
        steps.append(f"{', '.join(lacking)} lack guards: --mode check lists them with their consequences.")
    if recording is None:
        return steps or ["Nothing was recorded: go on with --mode home, shadow or run."]
    clipped = _clipped_share(recording)
    if clipped:
        words = f"A limit on length or rate held back {100 * clipped:.0f} % of the actions"
        steps.append(f"{words}: see the commands below.")
    if cause == PLANNED and summary["facts"].get("simulated"):
        steps.append("The drives were simulated. On a robot, begin with --mode check, home and shadow.")
    if recording.unsent:
        return [*steps, "No drive has carried these commands out: this recording is no data. Go on with --mode run."]
    steps.append(
        'The recording is data: put session.nc under fit in [data] with format = "netcdf", then rfdropo calibrate and '
        "rfdropo audit find how this robot differs from its model."
    )
    return steps
