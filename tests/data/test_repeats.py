"""Repeats and the noise they measure."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data import (
    command_openings,
    group_repeats,
    noise_floor,
    read_asl_csv,
    read_optitrack_csv,
    same_opening,
)


def test_identical_commands_are_repeats(build):
    command = build().command
    recordings = [
        build(),
        build(command=command * 2),
        build(),
        build(robot="other"),
        build(time=np.linspace(0, 1.1, 11)),
    ]
    assert group_repeats(recordings) == [[0, 2, 4], [1], [3]]


def test_another_payload_is_not_a_repeat(datasets):
    folder = datasets / "asl_trunk"
    commands = folder / "control_inputs_controlled_1.csv.gz"
    bare, loaded = (read_asl_csv(folder / f"observations_controlled_1{end}.csv.gz", commands) for end in ("", "_100g"))
    assert group_repeats([bare, loaded]) == [[0], [1]]
    assert group_repeats([bare, bare]) == [[0, 1]]


def test_pure_error_recovers_the_noise(build):
    """Noise 1 mm per axis, 5 repeats of 400 rows: the floor is sqrt(3) mm within 2.5 % at 3 standard errors (0.3 %)."""
    rng = np.random.default_rng(5)
    clean = build(rows=400)
    noisy = [build(rows=400, position=clean.position + rng.normal(0.0, 1e-3, (400, 2, 3))) for _ in range(5)]
    floor = noise_floor(noisy)
    assert floor is not None
    standard_error = 1.0 / np.sqrt(2 * 3 * 4 * 400)  # relative, for 3 axes, 4 degrees of freedom, 400 rows
    for marker in ("m1", "m2"):
        assert floor[marker] == pytest.approx(np.sqrt(3.0) * 1e-3, rel=3 * standard_error)


@pytest.mark.parametrize("stretched", ["time", "command_time"])
def test_recordings_at_another_speed_or_rate_are_no_noise(build, stretched):
    """The same commands, twice as slow, or in rows twice as far apart: row k is no repeat of row k."""
    sent = {"command": build(rows=20).command, "command_time": 0.1 * np.arange(19), "time": 0.1 * np.arange(20)}
    first = build(rows=20, **sent)
    other = build(rows=20, position=first.position + 0.02, **sent | {stretched: 2.0 * sent[stretched]})
    assert group_repeats([first, other]) == ([[0, 1]] if stretched == "time" else [[0], [1]])
    assert noise_floor([first, other]) is None
    floor = noise_floor([first, other, build(rows=20, **sent)])
    assert floor is not None
    assert max(floor.values()) < 1e-12


def test_an_opening_at_another_speed_is_another_one(build):
    """Clocks jitter, and what earlier versions kept says nothing of the speed."""
    sent = {"command": build(rows=20).command, "time": 0.1 * np.arange(20)}
    first, slow, late = (
        command_openings(build(rows=20, **sent, command_time=step * np.arange(19))) for step in (0.1, 0.2, 0.101)
    )
    assert same_opening(first, late)
    assert not same_opening(first, slow)
    assert same_opening({count: opening.split()[0] for count, opening in slow.items()}, first)


def test_masked_rows_do_not_count(build):
    first = build()
    position, mask = first.position.copy(), np.ones((11, 2), dtype=bool)
    position[3, 0] += 1.0
    mask[3, 0] = False
    floor = noise_floor([first, build(), build(position=position, position_mask=mask)])
    assert floor is not None
    assert max(floor.values()) < 1e-15


def test_repeats_are_compared_in_the_rows_and_markers_that_all_have(build):
    """A calibration of them must not end when it counts its noise."""
    sent = {"command": build(rows=20).command, "command_time": 0.1 * np.arange(19)}
    whole, longer = (build(rows=n, time=0.1 * np.arange(n), **sent) for n in (20, 24))
    position = longer.position.copy()
    position[:20] = whole.position + np.array([0.002, 0.0, 0.0])
    longer = build(rows=24, time=0.1 * np.arange(24), position=position, **sent)
    floor = noise_floor([whole, longer])
    assert floor == pytest.approx({"m1": 0.002 / np.sqrt(2.0), "m2": 0.002 / np.sqrt(2.0)})
    assert set(noise_floor([build(), build(marker_names=["m1", "m3"])])) == {"m1"}
    assert noise_floor([build(), build(command=2 * build().command)]) is None


def test_a_marker_that_is_lost_in_a_repeat_is_known_from_fewer_degrees_of_freedom(build):
    """Two repeats that are 2 mm apart have a variance of 2 mm2, with a third or without."""
    clean, mask = build(), np.ones((11, 2), dtype=bool)
    mask[:, 1] = False
    shifts = (0.001, -0.001, 0.5)
    moved = [clean.position + np.array([shift, 0.0, 0.0]) for shift in shifts]
    floor = noise_floor(
        [build(position=moved[0]), build(position=moved[1]), build(position=moved[2], position_mask=mask)]
    )
    assert floor["m2"] == pytest.approx(0.001 * np.sqrt(2.0))
    lost = [build(position=moved[0]), build(position=moved[1], position_mask=mask)]
    assert set(noise_floor(lost)) == {"m1"}


def test_spread_of_the_physical_trunk(datasets):
    """The last marker about the mean of n repeats, times sqrt(n / (n - 1)): 4.0 mm about it in January (AKLWI), 2.8 mm
    (X0HBR), 1.1 mm in April."""
    paths = sorted((datasets / "sim2real_trunk").glob("*.csv"))
    recordings = [read_optitrack_csv(path) for path in paths]
    groups = {recordings[group[0]].name.split("_")[0]: group for group in group_repeats(recordings)}
    assert {name: len(group) for name, group in groups.items()} == {"AKLWI": 5, "AKLWI2": 3, "X0HBR": 3}
    for name, spread in (("AKLWI", 4.02e-3), ("X0HBR", 2.81e-3), ("AKLWI2", 1.08e-3)):
        floor, count = noise_floor([recordings[index] for index in groups[name]]), len(groups[name])
        assert floor is not None
        assert floor["m4"] * np.sqrt((count - 1) / count) == pytest.approx(spread, abs=0.05e-3)
