"""Faults are masked; fast motion and rest are not."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data import find_faults, read_asl_csv, read_sofa_csv

RATE = 100.0


def swinging(rows: int = 1500, seed: int = 0, noise: float = 2e-5) -> tuple[np.ndarray, np.ndarray]:
    """Three disks swinging at 1.3 Hz by up to 0.12 m (peak 1 m/s, 8 m/s2), with rest at both ends."""
    time = np.arange(rows) / RATE
    gate = np.clip(np.minimum(time - 2.0, time[-1] - 2.0 - time), 0.0, 0.5) / 0.5
    wave = gate * np.sin(2 * np.pi * 1.3 * time)
    position = np.zeros((rows, 3, 3))
    for disk in range(3):
        position[:, disk] = [0.1, 0.12, 0.1 * (disk + 1)]
        position[:, disk, 0] += 0.04 * (disk + 1) * wave
        position[:, disk, 2] -= 0.02 * (disk + 1) * wave**2
    rng = np.random.default_rng(seed)
    return time, position + rng.normal(0.0, noise, position.shape)


def test_nothing_is_masked_in_a_clean_recording():
    for seed in range(5):
        faults = find_faults(*swinging(seed=seed))
        assert faults.mask.all()
        assert faults.counts == {"missing": [0] * 3, "held": [0] * 3, "jump": [0] * 3, "breaks": [0] * 3}


@pytest.mark.parametrize("jump", [8e-3, 30e-3, 70e-3])
def test_every_single_row_jump_is_masked_and_nothing_else(jump):
    time, position = swinging()
    rows = np.arange(40, 1460, 37)
    direction = np.random.default_rng(1).normal(size=(len(rows), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    position[rows, 2] += jump * direction
    faults = find_faults(time, position)
    assert np.flatnonzero(~faults.mask[:, 2]).tolist() == rows.tolist()
    assert faults.mask[:, :2].all()
    assert faults.counts["jump"] == [0, 0, len(rows)]


@pytest.mark.parametrize("noise", [1e-3, 3e-3])
def test_noise_is_no_jump_and_jumps_beyond_it_are_masked(noise):
    """Trackers of other kinds than motion capture err by millimetres from row to row."""
    time, position = swinging(noise=noise)
    assert find_faults(time, position).mask.all()
    rows = np.arange(40, 1460, 37)
    position[rows, 2, 1] += 40.0 * noise
    assert np.flatnonzero(~find_faults(time, position).mask[:, 2]).tolist() == rows.tolist()


def test_short_runs_on_the_wrong_body_are_masked():
    time, position = swinging()
    wrong = np.r_[300:304, 500:510, 511:513, 900:908]
    position[wrong, 1] += [0.009, -0.006, 0.004]
    faults = find_faults(time, position)
    assert np.flatnonzero(~faults.mask[:, 1]).tolist() == wrong.tolist()


def test_two_markers_that_swap_for_a_row_are_both_masked():
    time, position = swinging()
    position[700, [0, 1]] = position[700, [1, 0]]
    faults = find_faults(time, position)
    assert np.argwhere(~faults.mask).tolist() == [[700, 0], [700, 1]]


def test_held_poses_are_masked_after_their_first_row():
    time, position = swinging()
    position[600:656, 2] = position[600, 2]  # then it catches up in one step, which is no fault
    position[50, 0] = position[49, 0]  # at rest, the other disks move by their noise alone
    faults = find_faults(time, position)
    assert np.flatnonzero(~faults.mask[:, 2]).tolist() == list(range(601, 656))
    assert np.flatnonzero(~faults.mask[:, 0]).tolist() == [50]
    assert faults.counts["held"] == [1, 0, 55]
    assert faults.counts["jump"] == [0, 0, 0]


def test_a_frame_repeated_for_the_whole_body_is_held():
    time, position = swinging()
    position[800] = position[799]
    assert np.argwhere(~find_faults(time, position).mask).tolist() == [[800, disk] for disk in range(3)]


def test_rest_of_a_noise_free_recording_is_not_held():
    time, position = swinging(noise=0.0)
    assert find_faults(time, position).mask.all()


def test_a_coarsely_rounded_recording_is_not_held():
    time, position = swinging()
    assert find_faults(time, np.round(position, 4)).counts["held"] == [0, 0, 0]


def test_a_lasting_change_of_level_is_kept_and_counted():
    time, position = swinging()
    position[1000:, 1] += 0.02
    faults = find_faults(time, position)
    assert faults.mask.all()
    assert faults.counts["breaks"] == [0, 1, 0]


def test_a_sudden_start_at_full_speed_is_kept():
    time = np.arange(400) / RATE
    travelled = np.clip(time - 2.0, 0.0, 0.2) * 1.1  # 11 mm a row from one row to the next, then a dead stop
    position = np.stack([travelled, 0.0 * time, 0.3 + 0.0 * time], axis=1)[:, None]
    position = position + np.random.default_rng(3).normal(0.0, 2e-5, position.shape)
    assert find_faults(time, position).mask.all()


def test_at_ten_hertz_fast_motion_is_not_a_jump():
    rng = np.random.default_rng(4)
    position = 0.1 + np.cumsum(rng.normal(0.0, 8e-3, (100, 4, 3)), axis=0)
    assert find_faults(0.1 * np.arange(100), position).mask.all()


def poses_at_ten_hertz():
    """30 poses of 20 rows with .3 mm of noise, and their commands, as a load cell reads them."""
    rng = np.random.default_rng(4)
    held = np.repeat(rng.uniform(0.0, 5.0, (30, 2)), 20, axis=0)
    position = np.pad(0.02 * held, ((0, 0), (0, 1)))[:, None] + 3e-4 * rng.standard_normal((600, 1, 3))
    return 0.1 * np.arange(600), position, held + 0.02 * rng.standard_normal(held.shape)


def test_at_ten_hertz_a_row_that_leaves_a_held_pose_and_comes_back_is_a_jump():
    time, position, command = poses_at_ten_hertz()
    assert not (~find_faults(time, position, command=command).mask).any()
    position[311, 0, 0] += 0.02
    wrong = ~find_faults(time, position, command=command).mask
    assert np.flatnonzero(wrong[:, 0]).tolist() == [311]
    assert not (~find_faults(time, position).mask).any(), "without its command it may have been sent there"
    command[311, 1] += 1.0
    assert not (~find_faults(time, position, command=command).mask).any()


def test_poses_that_commands_may_explain_are_no_jumps():
    """Commands that change in every row, one of which pulls only beyond its slack; and pulses whose answer is late."""
    rng = np.random.default_rng(5)
    command = rng.uniform(0.0, 1.0, (600, 2))
    position = 3e-4 * rng.standard_normal((600, 1, 3))
    position[:, 0, 0] += 0.1 * np.clip(command[:, 0] - 0.9, 0.0, None)
    assert not (~find_faults(0.1 * np.arange(600), position, command=command).mask).any()
    pulses, late = np.zeros((600, 1)), 3e-4 * rng.standard_normal((600, 1, 3))
    pulses[20::40], late[23::40, 0, 0] = 1.0, 0.03
    assert not (~find_faults(0.1 * np.arange(600), late, command=pulses).mask).any()


def test_rounding_makes_no_jumps():
    time, position, command = poses_at_ten_hertz()
    rounded = 2e-3 * np.rint(position / 2e-3)
    assert not (~find_faults(time, rounded, command=command).mask).any()


def test_an_arm_that_rings_faster_than_it_is_sampled_is_no_jump():
    """The sign changes in every row, and rows one apart agree."""
    time, position, command = poses_at_ten_hertz()
    ringing = 0.03 * (-0.97) ** (np.arange(600) % 20)
    position[:, 0, 0] += ringing
    assert not (~find_faults(time, position, command=command).mask).any()


def test_lost_markers_are_masked():
    time, position = swinging()
    position[10:13, 1, 2] = np.nan
    faults = find_faults(time, position)
    assert np.argwhere(~faults.mask).tolist() == [[10, 1], [11, 1], [12, 1]]
    assert faults.counts["missing"] == [0, 3, 0]


def test_counts_on_the_real_files(datasets):
    """Held poses by exact comparison of the file's digits; jumps as this method finds them."""
    folder = datasets / "asl_trunk"
    controlled_11 = read_asl_csv(
        folder / "observations_controlled_11.csv.gz", folder / "control_inputs_controlled_11.csv.gz"
    )
    assert controlled_11.settings["faults"]["held"] == [0, 121, 281]
    assert controlled_11.settings["faults"]["jump"] == [0, 29, 66]
    assert not controlled_11.position_mask[2339:2348, 2].any()  # held while the trunk moved on by 35 mm
    assert controlled_11.position_mask[[2338, 2348], 2].all()
    controlled_1 = read_asl_csv(
        folder / "observations_controlled_1.csv.gz", folder / "control_inputs_controlled_1.csv.gz"
    )
    assert not controlled_1.position_mask[1572, 0]  # 15.8 mm out and 15.8 mm back
    assert not controlled_1.position_mask[1559:1561, 1].any()  # two rows 18 mm off
    assert 0.98 < controlled_1.position_mask.mean() < 0.99
    assert read_asl_csv(folder / "observations_zeros_0g.csv.gz", None).settings["faults"]["jump"] == [0, 0, 0]
    assert read_sofa_csv(datasets / "sofa_trunk" / "push_1.csv").position_mask.all()


def test_the_masked_rows_of_repeated_pulses_differ_from_the_other_pulses(datasets):
    """Ten identical pulses: what the mask keeps is more alike from pulse to pulse than what it drops."""
    folder = datasets / "asl_trunk"
    recording = read_asl_csv(
        folder / "observations_motor2_test_allmotors.csv.gz", folder / "control_inputs_controlled_20.csv.gz"
    )
    mask = recording.position_mask[:10000].reshape(10, 1000, 3)
    position = recording.position[:10000].reshape(10, 1000, 3, 3)
    deviation = np.linalg.norm(position - np.median(position, axis=0), axis=3)
    assert (~mask).sum(axis=0).max() <= 4  # no phase of the fast motion is dropped as a rule
    assert np.median(deviation[:, :, 1:][~mask[:, :, 1:]]) > 2.0 * np.median(deviation[:, :, 1:][mask[:, :, 1:]])


def test_markers_that_swap_for_good_are_masked_from_there_on_and_noted():
    time, position = swinging()
    position[700:, [0, 2]] = position[700:, [2, 0]]
    faults = find_faults(time, position, names=["base", "mid", "tip"])
    assert faults.mask[:, 1].all()
    for marker in (0, 2):
        assert np.flatnonzero(~faults.mask[:, marker]).tolist() == list(range(700, len(time)))
    assert sum(faults.counts["renamed"]) + sum(faults.counts["jump"]) == 2 * 800
    (note,) = faults.notes
    assert "markers change names in row 700: base and tip: " in note


def test_names_that_go_round_or_come_back_are_followed():
    """Three markers go round at rest, while none is seen for ten rows; all are right again from row 1000 on."""
    time, position = swinging()
    position[150:1000] = position[150:1000][:, [2, 0, 1]]
    position[140:150] = np.nan
    mask = find_faults(time, position).mask
    assert not mask[140:1000].any()
    assert mask[:140].all()
    assert mask[1000:].all()


@pytest.mark.parametrize("every", [2, 10, 20])
def test_a_swap_is_seen_at_low_rates_too(every):
    """At rest, a second after the start; in fast motion rows are too far apart to be certain."""
    time, position = swinging()
    time, position = time[::every], position[::every]
    at = 100 // every
    position[at:, [0, 1]] = position[at:, [1, 0]]
    faults = find_faults(time, position)
    assert np.array_equal(faults.mask[:, 0], np.arange(len(time)) < at)
    assert find_faults(*(part[::every] for part in swinging())).mask.all()


def test_zeros_far_from_a_marker_are_lost_markers():
    time, position = swinging()
    position[10:13, 1] = 0.0
    position[:4, 2] = 0.0
    faults = find_faults(time, position, names=["base", "mid", "tip"])
    assert np.argwhere(~faults.mask).tolist() == [[0, 2], [1, 2], [2, 2], [3, 2], [10, 1], [11, 1], [12, 1]]
    assert faults.counts["zero"] == [0, 3, 4]
    assert any(
        note.startswith("mid is exactly at 0, 0, 0 in 3 rows, first in row 10: taken for lost") for note in faults.notes
    )


def test_a_marker_that_is_at_the_origin_stays():
    """One that sets out from there, as displacements do; and one that never leaves it, which is said."""
    time, position = swinging(noise=0.0)
    position[:, 0] -= position[0, 0]
    faults = find_faults(time, position)
    assert faults.mask.all()
    assert not faults.notes
    position[:, 0] = 0.0
    faults = find_faults(time, position)
    assert faults.mask.all()
    assert "marker 1 is exactly at 0, 0, 0 in 1500 rows, first in row 0: taken as it stands" in faults.notes[0]


def test_a_recording_whose_rows_are_a_thousand_times_too_near_is_doubtful():
    """Rows a second apart that are read as milliseconds: what moves within a second looks like jumps."""
    held = 0.02 * np.repeat(np.random.default_rng(0).normal(size=(60, 1, 3)), 3, axis=0)
    place = held + np.random.default_rng(1).normal(0.0, 2e-4, (180, 1, 3))
    assert not any("are masked" in note for note in find_faults(1.0 * np.arange(180), place).notes)
    faults = find_faults(1e-3 * np.arange(180), place, names=["tip"])
    assert any("positions of tip are masked" in note and "the unit of times" in note for note in faults.notes)
