"""What drives make of commands beyond their travel, on sequences whose answer is counted by hand."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.cautions import Code
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import group_of, in_group
from rfdropo_bayes.model.assembly import with_groups
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.robots import DriveTravel, Robot, travel_in
from rfdropo_bayes.robots.drive_travel import unstated_travel

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
CONFIG = "reports/sim2real_trunk/config.toml"
CHANNELS = ("a", "b")
UP_AND_BACK = 0.005 * np.cumsum([1, 1, 1, 1, -1, -1, -1])[:, None] * np.ones(2)
EXPECTED = {  # with 12 mm of travel, in mm
    "lost": [5, 10, 10, 10, 5, 0, -5],
    "clipped": [5, 10, 12, 12, 7, 2, -3],
    "kept": [5, 10, 12, 12, 12, 10, 5],
}


def table(**entries):
    return DriveTravel(**{"beyond": "lost", "high": 0.012, **entries})


@pytest.mark.parametrize("beyond", EXPECTED)
def test_commands_beyond_the_travel_are_lost_clipped_or_kept(beyond):
    travel = travel_in([table(cables=("a",), beyond=beyond)], CHANNELS, "monday", np.zeros(2))
    taken = travel.follow(np.zeros(2), UP_AND_BACK)
    np.testing.assert_allclose(1e3 * taken[:, 0], EXPECTED[beyond], atol=1e-12)
    np.testing.assert_array_equal(taken[:, 1], UP_AND_BACK[:, 1])  # nothing is stated of the other


def test_counters_are_read_in_their_own_units():
    """A counter at 828 of 280 to 1000 that falls by 40 where a cable is pulled by 5 mm; and one that rises."""
    tables = [
        table(cables=("a",), low=280, high=1000, start=828, count_size=-0.005 / 40),
        table(cables=("b",), low=(280,), high=(640,), start=(400,), count_size=0.005 / 40),
    ]
    begun = np.array([0.001, -0.002])
    travel = travel_in(tables, CHANNELS, "monday", begun)
    np.testing.assert_allclose(travel.low - begun, [-0.0215, -0.015], atol=1e-15)
    np.testing.assert_allclose(travel.high - begun, [0.0685, 0.030], atol=1e-15)


def test_a_travel_that_is_reached_exactly_is_not_left():
    sent = np.cumsum(np.full((4, 2), -0.1 / 3), axis=0)
    travel = travel_in([table(low=-0.1, high=None)], CHANNELS, "monday", np.zeros(2))
    np.testing.assert_allclose(travel.follow(np.zeros(2), sent)[:, 0], [-0.1 / 3, -0.2 / 3, -0.1, -0.1])


def test_tables_hold_for_their_recordings():
    tables = [table(recordings=("*_2025[23]*",)), table(recordings="april", high=0.02)]
    assert travel_in(tables, CHANNELS, "run_20251", np.zeros(2)) is None
    assert travel_in(tables, CHANNELS, "run_20253[5, 10]", np.zeros(2)).high[0] == 0.012
    assert travel_in(tables, CHANNELS, "april", np.zeros(2)).high[0] == 0.02
    assert travel_in(tables, CHANNELS, "run_20251", np.zeros(2), "april").high[0] == 0.02  # by its group


def test_a_recording_without_the_limits_of_others_has_a_caution():
    tables = [table(recordings="march", cables=("a",)), table(recordings="spring", cables=("b",))]
    belonging = {"march": "spring", "april": "spring", "june": "june"}
    found = unstated_travel(tables, CHANNELS, belonging)
    assert [caution.code for caution in found] == [Code.DRIVES_UNSTATED] * 2
    assert "the travel of a is stated for other recordings and not for april:" in found[0].sentence
    assert "the travel of a, b is stated for other recordings and not for june:" in found[1].sentence
    assert not unstated_travel([], CHANNELS, belonging)


@pytest.mark.parametrize("path", [*sorted(EXPERIMENTS.glob("sim2real_trunk*.toml")), EXPERIMENTS.parent / CONFIG])
def test_the_trunk_s_drives_are_stated_for_every_day(path):
    """January 2025 by one pair of tables, all that came later by another; no recording by both."""
    stated = tomllib.loads(path.read_text(encoding="utf-8"))["model"]
    tables = [DriveTravel(**entry) for entry in stated.get("drives", [])]
    for day in ("20250130-145317", "20250201-1", "20250423-103701", "20251231-1", "20260101-1", "20310130-1"):
        name = f"AKLWI_collected_data_{day}"
        held = [t for t in tables if t.holds_for(name, group_of(name, stated.get("groups", {})))]
        assert len(held) == (0 if not tables else 2 if day.startswith("202501") else 1)


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ([{"cables": ("c",)}], "unknown cable 'c'"),
        ([{"cables": ("a",)}, {"high": 0.03}], "two tables state the travel of a in monday"),
        ([{"low": 0.001}], "monday begins outside the travel of a"),
    ],
)
def test_what_does_not_fit_a_recording_is_said(tables, words):
    with pytest.raises(InputError, match=words):
        travel_in([table(**entries) for entries in tables], CHANNELS, "monday", np.zeros(2))


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"low": 0.012}, "low of a drive table is not below high"),
        ({"start": 0.013}, "start of a drive table is not between low and high"),
        ({"high": None}, "neither low nor high"),
        ({"cables": (), "high": 0.1}, "a drive table needs at least one cable"),
        ({"cables": ("a", "b"), "low": (-0.1,)}, "one for each of its named cables"),
        ({"count_size": 0}, "count_size of a drive table is zero"),
        ({"beyond": "dropped"}, "beyond"),
    ],
)
def test_what_a_table_says_wrong_is_said(entries, words):
    with pytest.raises(InputError, match=words):
        Model("smooth_arm", drives=[{"beyond": "lost", "high": 0.012, **entries}])


def recording(name: str, robot: Robot) -> Trajectory:
    """Two seconds in which every cable is pulled by 5 mm four times, and released three times."""
    time = 0.25 * np.arange(9)
    return Trajectory.build(
        Origin(name=name, robot=robot.name, format="memory"),
        SentCommands(
            command_time=time[:7],
            command=UP_AND_BACK[:, :1] * np.ones(len(robot.channel_names)),
            command_unit="m",
            cable_names=robot.channel_names,
        ),
        Measured(
            time=time, position=np.tile(robot.marker_points(), (len(time), 1, 1)), marker_names=robot.marker_names
        ),
    )


def test_a_model_drives_a_recording_as_its_group_does():
    """Groups of the experiment, wildcards of the robot; a session's drives are those of the recording it names."""
    robot = Robot.load("smooth_arm")
    first = robot.channel_names[0]
    robot = robot.with_changes(drives=(table(recordings="tuesday_*", beyond="clipped"),))
    stated = [{"cables": [first], "recordings": "mondays", "high": 0.012, "beyond": "lost"}]
    model = Model(robot, drives=stated, groups={"mondays": ["monday_*"]})
    runs = [recording(name, robot) for name in ("monday_1", "tuesday_1", "friday")]
    step = gather_recordings(model.simulator, runs).commands.step
    sent = UP_AND_BACK[-1, 0]
    np.testing.assert_allclose(step[:, -1, 0], [-0.005, -0.003, sent], atol=1e-12)
    np.testing.assert_allclose(step[:, -1, 1], [sent, -0.003, sent], atol=1e-12)
    assert [caution.sentence.split(":")[0][-6:] for caution in model.simulator.robot.unstated(["friday"])] == ["friday"]
    # a recording belongs to the group that is chosen for it, and to no other
    for name, group, taken in (("friday", "mondays", -0.005), ("monday_1", "today", sent)):
        chosen = with_groups(model.simulator, in_group(name, group, model.spec.groups))
        found = gather_recordings(chosen, [recording(name, robot)]).commands.step
        np.testing.assert_allclose(found[0, -1, 0], taken, atol=1e-12)
