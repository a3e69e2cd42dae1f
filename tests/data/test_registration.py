"""Registration recovers known motions and offsets."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rfdropo_bayes.data import clock_offset, register, shift_commands, to_base_frame
from rfdropo_bayes.errors import InputError

POINTS = np.array([[0.0, 0.0, 0.1], [0.01, 0.0, 0.2], [0.0, -0.02, 0.3], [0.03, 0.01, 0.05]])
LINE = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2], [0.0, 0.0, 0.32]])


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_rigid_motion_is_recovered(seed):
    rng = np.random.default_rng(seed)
    rotation, translation = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
    measured = (POINTS - translation) @ rotation  # so that rotation @ measured + translation = POINTS
    found = register(measured, POINTS)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, translation, atol=1e-9)
    assert found.residual < 1e-9
    assert found.roll_determined


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_markers_on_a_line_are_aligned_without_roll(seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.append(rng.uniform(-1.5, 1.5, 2), 0.0))
    measured = turn.apply(LINE) + rng.normal(size=3)
    found = register(measured, LINE)
    assert not found.roll_determined
    np.testing.assert_allclose(measured @ found.rotation.T + found.translation, LINE, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1.0)
    np.testing.assert_allclose(found.rotation, turn.inv().as_matrix(), atol=1e-9)  # the smallest rotation


def test_weights_decide_whom_to_trust():
    measured = POINTS.copy()
    measured[3] += 0.05
    assert register(measured, POINTS, np.array([1.0, 1.0, 1.0, 1e-9])).residual < 1e-5
    assert register(measured, POINTS).residual > 5e-3


@pytest.mark.parametrize(
    ("measured", "reference", "message"),
    [
        (POINTS, POINTS[:3], "cannot register"),
        (POINTS[:1], POINTS[:1], "cannot register"),
        (0 * POINTS, 0 * POINTS, "coincide"),
    ],
)
def test_points_that_cannot_be_registered(measured, reference, message):
    with pytest.raises(InputError, match=message):
        register(measured, reference)


def test_a_recording_moves_with_its_object(build):
    pose = np.tile([0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (11, 1))
    recording = build(object_pose=pose)
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    shift = np.array([0.0, 0.0, 0.05])
    moved = to_base_frame(recording, register((POINTS - shift) @ turn, POINTS))
    np.testing.assert_allclose(moved.position[4, 0], turn @ recording.position[4, 0] + shift, atol=1e-9)
    np.testing.assert_allclose(moved.object_pose[0], [0, 0.3, 0.05, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)
    assert moved.sha256 != recording.sha256


@settings(deadline=None, max_examples=40)
@given(offset=st.floats(-0.4, 0.4), rate=st.floats(30.0, 120.0), seed=st.integers(0, 1000))
def test_the_offset_of_a_clock_is_found_within_a_fifth_of_a_sample(offset, rate, seed):
    rng = np.random.default_rng(seed)
    phases, frequencies = rng.uniform(0, 6, 5), rng.uniform(0.3, 2.5, 5)

    def signal(time):
        return np.sin(2 * np.pi * np.outer(time, frequencies) + phases).sum(axis=1)

    time, other_time = np.arange(0.0, 12.0, 0.01), np.arange(0.0, 12.0, 1.0 / rate)
    found = clock_offset(time, signal(time), other_time, 3.0 * signal(other_time - offset) + 1.0, largest=0.6)
    assert found == pytest.approx(offset, abs=0.2 / min(rate, 100.0))


def test_offsets_that_cannot_be_found():
    time = np.arange(0.0, 2.0, 0.01)
    with pytest.raises(InputError, match="share too little time"):
        clock_offset(time, time, time, time, largest=0.9)
    with pytest.raises(InputError, match="nothing in common"):
        clock_offset(time, np.sin(time), time, 0 * time, largest=0.2)


def test_commands_are_shifted_against_the_observations(recording):
    later = shift_commands(recording, 0.03)
    np.testing.assert_allclose(later.command_time, recording.command_time + 0.03)
    np.testing.assert_array_equal(later.time, recording.time)
