"""Counters that wrap or are started anew are told from commands that jump, by whether the markers follow."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.counters import Column, Motion, counter_notes, read_on, turns_of, unwrapped, wraps_of
from rfdropo_bayes.errors import InputError

TIME = 0.04 * np.arange(400)
SMOOTH = np.column_stack([6000.0 * (1.0 - np.cos(0.9 * TIME)), 5000.0 * np.sin(0.7 * TIME)])
LEVELS = np.repeat(np.random.default_rng(2).uniform(-500.0, 500.0, size=(80, 2)), 5, axis=0)
STEPS = LEVELS[::5].cumsum(axis=0).repeat(5, axis=0)  # a command every fifth row
WALK = 70.0 * np.random.default_rng(4).normal(size=(400, 2)).clip(-2.0, 2.0).cumsum(axis=0)  # steps up to 140 degrees
SAWTOOTH = np.column_stack([(700.0 * TIME) % 4096.0, (300.0 * TIME) % 2000.0])


def notes(raw: np.ndarray, true: np.ndarray, unit: str = "counts") -> list[str]:
    """What is said of columns ``raw`` while two markers follow ``true`` two rows late, with noise."""
    random = np.random.default_rng(1)
    late = np.concatenate([true[:1], true[:1], true[:-2]])
    follow = late @ random.normal(size=(2, 6))
    position = 0.03 * follow / np.ptp(follow) + 5e-4 * random.normal(size=follow.shape)
    columns = [Column(f"c{k}", own, turns_of(unit, 4096.0, own)) for k, own in enumerate(raw.T, start=1)]
    return counter_notes(columns, Motion(TIME, TIME, position), unit)


@pytest.mark.parametrize(
    ("raw", "true", "unit", "line"),
    [
        (np.round(SMOOTH) % 4096.0, SMOOTH, "counts", "unwrap = {c1 = 4096, c2 = 4096}"),
        (np.round(8.0 * SMOOTH) % 65536.0, SMOOTH, "counts", "unwrap = {c1 = 65536, c2 = 65536}"),
        (np.round(STEPS) % 4096.0, STEPS, "counts", "unwrap = {c1 = 4096, c2 = 4096}"),
        ((0.1 * SMOOTH + 180.0) % 360.0 - 180.0, SMOOTH, "deg", "unwrap = {c1 = 360, c2 = 360}"),
        (np.angle(np.exp(1e-3j * SMOOTH)), SMOOTH, "rad", "unwrap = {c1 = 6.283185307, c2 = 6.283185307}"),
        (np.round(SMOOTH * [1.0, 0.1]) % 4096.0, SMOOTH, "counts", "unwrap = {c1 = 4096, c2 = 4096}"),
        (np.column_stack([SMOOTH[:, 0] % 5000.0, SMOOTH[:, 1]]), SMOOTH, "counts", "unwrap = {c1 = 5000}"),
        (WALK % 360.0, WALK, "deg", "unwrap = {c1 = 360, c2 = 360}"),
    ],
)
def test_a_counter_that_wraps_is_doubtful_and_the_line_mends_it(raw, true, unit, line):
    (note,) = notes(raw, true, unit)
    assert line in note
    turns = {key.strip(): float(value) for key, value in (pair.split("=") for pair in line[10:-1].split(","))}
    assert notes(read_on(raw, ["c1", "c2"], turns), true, unit) == []


@pytest.mark.parametrize("true", [SMOOTH, STEPS, LEVELS, SAWTOOTH, 2048.0 * np.sign(SMOOTH - 3000.0)])
def test_commands_that_the_markers_follow_are_not_doubtful(true):
    """Among them a sawtooth of exactly one turn."""
    assert notes(true, true) == []


@pytest.mark.parametrize("true", [SMOOTH, STEPS])
def test_counters_that_start_elsewhere_after_a_restart_are_doubtful(true):
    raw = true.copy()
    raw[200:] -= 4000.0
    (note,) = notes(raw, true)
    assert "row 200" in note
    assert "restart" in note
    moved = true.copy()
    moved[200:] += 9000.0
    assert notes(moved, moved) == []


def test_counters_of_three_cables_of_which_two_determine_the_third_are_read_on():
    true = np.column_stack([WALK, -WALK.sum(axis=1)])
    motion = Motion(TIME, TIME, true @ np.random.default_rng(1).normal(size=(3, 3)))
    columns = [Column(f"c{k}", own, [360.0]) for k, own in enumerate((0.5 * true % 360.0).T)]
    assert {name: each.turn for name, each in wraps_of(columns, motion).items()} == dict.fromkeys(
        ("c0", "c1", "c2"), 360.0
    )


def test_values_are_read_on_and_missing_ones_stay_missing():
    true = np.linspace(0.0, 1000.0, 40)
    raw = (true + 180.0) % 360.0 - 180.0
    raw[[7, 20]] = np.nan
    found = unwrapped(raw, 360.0)
    assert np.flatnonzero(np.isnan(found)).tolist() == [7, 20]
    seen = np.isfinite(found)
    assert found[seen] == pytest.approx(true[seen])


def test_a_table_says_and_mends_what_wraps_in_commands_and_measured_angles():
    counts = np.round(SMOOTH)
    follow = 1e-3 * SMOOTH[:, [0, 1, 0]] + 0.1 * np.random.default_rng(3).normal(size=(400, 3))
    degrees = 360.0 / 4096.0 * counts
    table = pd.DataFrame({"t": TIME} | {f"{axis}": follow[:, k] for k, axis in enumerate("xyz")})
    table[["c1", "c2"]] = counts % 4096.0
    table[["q 1", "q2"]] = (degrees + 180.0) % 360.0 - 180.0
    columns = {
        "time": "t",
        "commands": ["c1", "c2"],
        "command_unit": "counts",
        "counts_per_turn": 4096.0,
        "largest_command": 1e5,
        "positions": [["x", "y", "z"]],
        "position_unit": "mm",
        "motor_angles": ["q 1", "q2"],
        "motor_angle_unit": "deg",
    }
    sent, read = Trajectory.from_pandas(table, columns).notes
    assert "unwrap = {c1 = 4096, c2 = 4096}" in sent
    assert 'unwrap = {"q 1" = 360, q2 = 360}' in read
    mended = Trajectory.from_pandas(table, columns | {"unwrap": {"c1": 4096, "c2": 4096, "q 1": 360, "q2": 360}})
    assert mended.notes == []
    assert mended.command == pytest.approx(counts * 2.0 * np.pi / 4096.0)
    assert mended.motor_angle == pytest.approx(mended.command)
    for unwrap in ({"x": 4096}, {"c1": 0}):
        with pytest.raises(InputError, match="unwrap"):
            Trajectory.from_pandas(table, columns | {"unwrap": unwrap})
