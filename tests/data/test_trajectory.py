"""The Trajectory type: what it rejects, and what slicing, resampling and storing keep."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError


def test_properties_carry_what_was_given(recording):
    assert recording.position.shape == (11, 2, 3)
    assert recording.position_mask.all()
    assert recording.command_unit == "m"
    assert recording.marker_names == ("m1", "m2")
    assert recording.cable_names == ("a", "b")
    assert recording.tension is None
    assert recording.object_pose is None
    assert not recording.synthetic
    assert len(recording.sha256) == 64
    with pytest.raises(ValueError, match="read-only"):
        recording.position[0] = 0.0


def test_hash_follows_the_content_and_nothing_else(build):
    position = build().position.copy()
    assert build().sha256 == build(name="other", provenance="elsewhere").sha256
    position[3, 1, 2] += 1e-12
    assert build(position=position).sha256 != build().sha256
    assert build(marker_names=["m2", "m1"]).sha256 != build().sha256


@pytest.mark.parametrize(
    ("scale", "message"), [(1e3, "millimetres given as metres"), (1e-3, "metres given as millimetres")]
)
def test_a_wrong_unit_of_length_is_named(build, scale, message):
    with pytest.raises(InputError, match=message):
        build(position=build().position * scale)


@pytest.mark.parametrize(
    ("unit", "value", "message"),
    [("m", 40.0, "millimetres given as metres"), ("rad", 80.0, "degrees given as radians"), ("mm", 0.01, "unknown")],
)
def test_a_wrong_unit_of_command_is_named(build, unit, value, message):
    with pytest.raises(InputError, match=message):
        build(command=np.full((10, 2), value), command_unit=unit)


def test_drives_of_many_turns_say_how_far_they_go(build, tmp_path):
    """A lead screw of ten turns: refused as degrees, and believed as far as it is said to go, in every later form."""
    screw = np.linspace(0.0, 62.0, 10)[:, None] * np.ones(2)
    with pytest.raises(InputError, match="state largest_command"):
        build(command=screw, command_unit="rad")
    built = build(command=screw, command_unit="rad", largest=65.0)
    built.save(tmp_path / "screw.nc")
    for run in (built, Trajectory.load(tmp_path / "screw.nc"), built.slice_rows(0, 5), built.resample(0.2)):
        assert np.abs(run.command).max() > 20.0
    with pytest.raises(InputError, match="degrees given as radians"):
        build(command=10.0 * screw, command_unit="rad", largest=65.0)
    arrays = {"time": built.time, "position": built.position, "markers": ["a", "b"], "channels": ["u", "v"]}
    found = Trajectory.from_arrays(command=360.0 * screw, command_unit="deg", largest_command=360.0 * 65.0, **arrays)
    assert found.command.max() == pytest.approx(2.0 * np.pi * 62.0)
    place = dict(zip("xyz", built.position[:-1, 0].T, strict=True))
    table = pd.DataFrame({"t": built.time[:-1], "u": screw[:, 0], **place})
    columns = {"time": "t", "commands": ["u"], "command_unit": "rad", "positions": [["x", "y", "z"]]}
    columns |= {"position_unit": "m", "largest_command": 65.0}
    assert Trajectory.from_pandas(table, columns).command.max() == 62.0
    with pytest.raises(InputError, match="state largest_command"):
        Trajectory.from_pandas(table, columns | {"largest_command": 50.0})


def test_nan_is_placed(build):
    position = build().position.copy()
    position[4, 1, 2] = np.nan
    with pytest.raises(InputError, match=r"made, time 0\.4, marker m2, axis z: position is NaN"):
        build(position=position)
    with pytest.raises(InputError, match="command is NaN"):
        build(command=np.full((10, 2), np.nan))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time": np.r_[0.0, 0.0, np.linspace(0.1, 1.0, 9)]}, "row 1: time does not increase"),
        ({"command_time": np.linspace(1.0, 0.0, 10)}, "command_time does not increase"),
        ({"time": np.linspace(0.0, 1.0, 9)}, "do not fit together"),
        ({"command": np.zeros((7, 2))}, "do not fit together"),
        ({"marker_names": ["m1", "m1"]}, "marker names are not unique"),
        ({"position_mask": np.zeros((11, 2), dtype=bool)}, "every position is masked"),
        ({"object_pose": np.tile([0, 0, 0, 0, 0, 0, 2.0], (11, 1))}, "quaternion of the object has norm 2"),
    ],
)
def test_content_that_does_not_fit_is_rejected(build, changes, message):
    with pytest.raises(InputError, match=message) as caught:
        build(**changes)
    assert "\n" not in str(caught.value)


def test_command_in_force_is_a_zero_order_hold(recording):
    at = recording.command_at(np.array([-0.01, 0.0, 0.05, 0.1, 5.0]))
    expected = np.array([[0, 0], [0, 1], [0, 1], [2, 3], [18, 19]]) * 1e-3
    np.testing.assert_allclose(at, expected)


def test_a_slice_keeps_the_commands_in_force_within_it(recording):
    part = recording.slice_rows(4, 7)
    np.testing.assert_allclose(part.time, [0.0, 0.1, 0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(part.command_time, [0.0, 0.1, 0.2], atol=1e-12)
    np.testing.assert_array_equal(part.command, recording.command[4:7])
    np.testing.assert_array_equal(part.initial_command, recording.command[3])
    np.testing.assert_array_equal(part.position, recording.position[4:8])


def test_a_slice_with_a_lead_in_keeps_earlier_commands(recording):
    part = recording.slice_rows(4, 7, lead_in=0.2)
    np.testing.assert_allclose(part.command_time, [-0.2, -0.1, 0.0, 0.1, 0.2], atol=1e-12)
    np.testing.assert_array_equal(part.command, recording.command[2:7])
    np.testing.assert_array_equal(part.initial_command, recording.command[1])
    np.testing.assert_array_equal(recording.slice_rows(4, 7, lead_in=9.0).initial_command, recording.initial_command)


def test_a_slice_without_commands_holds_the_last_one(build):
    sparse = build(command_time=np.array([0.05]), command=np.array([[0.01, -0.01]]))
    part = sparse.slice_rows(5, 9)
    np.testing.assert_array_equal(part.command, [[0.01, -0.01]])
    np.testing.assert_array_equal(part.initial_command, [0.01, -0.01])
    assert part.command_time.tolist() == [0.0]


@settings(deadline=None, max_examples=40)
@given(first=st.integers(0, 9), length=st.integers(1, 10))
def test_a_slice_applies_the_same_commands_at_the_same_instants(build, first, length):
    recording = build()
    last = min(first + length, 10)
    part = recording.slice_rows(first, last)
    instants = np.linspace(0.0, part.time[-1] - 1e-6, 37)
    np.testing.assert_array_equal(part.command_at(instants), recording.command_at(instants + recording.time[first]))


@pytest.mark.parametrize("rows", [(-1, 3), (3, 3), (5, 2), (0, 11)])
def test_rows_out_of_range_are_rejected(recording, rows):
    with pytest.raises(InputError, match="out of range; choose 0 <= first < last <= 10"):
        recording.slice_rows(*rows)


@settings(deadline=None, max_examples=40)
@given(sample_time=st.floats(0.013, 0.9), slope=st.floats(-0.5, 0.5))
def test_resampling_a_linear_motion_is_exact(build, sample_time, slope):
    time = np.cumsum(np.r_[0.0, np.linspace(0.05, 0.15, 10)])
    start = np.array([[0.0, 0.1, 0.2], [0.3, 0.2, 0.1]])
    recording = build(time=time, position=start + slope * time[:, None, None], command_time=time[:-1])
    resampled = recording.resample(sample_time)
    np.testing.assert_allclose(np.diff(resampled.time), sample_time)
    assert time[-1] - sample_time < resampled.time[-1] + 1e-9 <= time[-1] + 2e-9
    np.testing.assert_allclose(resampled.position, start + slope * resampled.time[:, None, None], atol=1e-12)
    np.testing.assert_array_equal(resampled.command, recording.command)
    assert resampled.dataset.attrs["sample_time"] == sample_time


def test_resampling_masks_what_draws_on_a_masked_row(build):
    mask = np.ones((11, 2), dtype=bool)
    mask[5, 0] = False
    recording = build(position_mask=mask)
    assert np.flatnonzero(~recording.resample(0.05).position_mask[:, 0]).tolist() == [9, 10, 11]
    assert np.flatnonzero(~recording.resample(0.2).position_mask[:, 0]).tolist() == []  # 0.4 and 0.6 lie on rows
    assert recording.resample(0.05).position_mask[:, 1].all()


def test_resampling_turns_the_object_at_constant_rate(build):
    angle = 2.0 * np.linspace(0.0, 1.0, 11)
    pose = np.zeros((11, 7))
    pose[:, 5], pose[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    pose[::2, 3:] *= -1.0  # the same rotations
    resampled = build(object_pose=pose).resample(0.03)
    found = 2.0 * np.arctan2(resampled.object_pose[:, 5], resampled.object_pose[:, 6])
    np.testing.assert_allclose(found, 2.0 * resampled.time, atol=1e-9)


@pytest.mark.parametrize("sample_time", [0.0, -1.0, np.nan, 1.5])
def test_impossible_sample_times_are_rejected(recording, sample_time):
    with pytest.raises(InputError, match="cannot resample"):
        recording.resample(sample_time)


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(2, 30), optional=st.booleans())
def test_saving_and_loading_changes_nothing(build, tmp_path_factory, seed, rows, optional):
    rng = np.random.default_rng(seed)
    content: dict[str, object] = {"position": rng.uniform(-1.0, 1.0, (rows, 2, 3)), "settings": {"payload_mass": 0.1}}
    if optional:
        pose = rng.normal(size=(rows, 7))
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        content |= {"tension": rng.normal(size=(rows, 2)), "motor_angle": rng.normal(size=(rows, 2))}
        content |= {"object_pose": pose, "position_mask": rng.uniform(size=(rows, 2)) < 0.9, "synthetic": True}
        content["position_mask"][0] = True
    saved = build(rows=rows, **content)
    path = tmp_path_factory.mktemp("netcdf") / "recording.nc"
    saved.save(path)
    loaded = Trajectory.load(path)
    xr.testing.assert_identical(loaded.dataset, saved.dataset)
    assert loaded.sha256 == saved.sha256
    assert loaded.settings == saved.settings
    assert loaded.synthetic == optional
    assert loaded.position_mask.dtype == bool


def test_a_corrupt_file_is_named(recording, tmp_path):
    path = tmp_path / "recording.nc"
    recording.save(path)
    whole = path.read_bytes()
    for damaged in (b"", b"not HDF5 at all", whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"recording\.nc: is not a readable NetCDF file"):
            Trajectory.load(path)


def test_altered_numbers_are_noticed(recording, tmp_path):
    path = tmp_path / "recording.nc"
    altered = recording.dataset.copy(deep=True)
    altered["position"][3, 1, 2] += 1e-3
    altered.to_netcdf(path, engine="h5netcdf")
    with pytest.raises(InputError, match="does not match its hash"):
        Trajectory.load(path)


def test_a_foreign_file_is_named(tmp_path):
    path = tmp_path / "foreign.nc"
    xr.Dataset({"temperature": ("time", [1.0, 2.0])}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(InputError, match="not a trajectory of ours"):
        Trajectory.load(path)
    with pytest.raises(InputError, match="no such file"):
        Trajectory.load(tmp_path / "absent.nc")


def test_a_folder_that_is_not_there_cannot_be_written_to(recording, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        recording.save(Path(tmp_path / "absent" / "recording.nc"))


def test_renaming_keeps_content_and_merges_settings(build):
    named = build(settings={"a": 1}).with_attributes(name="new", settings={"b": 2})
    assert named.name == "new"
    assert named.settings == {"a": 1, "b": 2}
