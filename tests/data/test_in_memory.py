"""Recordings from arrays, tables and data sets: one content, whichever way it came."""

from __future__ import annotations

import inspect
import re

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import xarray as xr

from rfdropo_bayes.data import DataSpec, Trajectory, load_recordings
from rfdropo_bayes.errors import InputError

TIME = 0.1 * np.arange(20)
PLACE = np.stack([0.01 * np.sin(TIME), 0.02 * np.cos(TIME), 0.1 + 0.0 * TIME], axis=-1)[:, None] * [[[1.0]], [[0.5]]][0]
PLACE = np.concatenate([0.5 * PLACE, PLACE], axis=1)  # (time, 2 markers, 3) [m]
PULL = np.stack([0.01 * (TIME > 0.5), 0.005 * (TIME > 1.0)], axis=-1)  # [m]
NAMES = {"markers": ["middle", "tip"], "channels": ["left", "right"]}
LABELS = {"marker": NAMES["markers"], "channel": NAMES["channels"], "axis": list("xyz")}


def arrays(**changes):
    return Trajectory.from_arrays(**{"time": TIME, "position": PLACE, "command": PULL, **NAMES, **changes})


def test_units_are_converted_and_names_kept():
    millimetres = arrays(position=1e3 * PLACE, position_unit="mm", command=100.0 * PULL, command_unit="cm")
    assert millimetres.sha256 == arrays().sha256 or np.allclose(millimetres.position, arrays().position)
    np.testing.assert_allclose(millimetres.command, PULL)
    assert millimetres.marker_names == ("middle", "tip")
    turned = arrays(command=np.degrees(PULL), command_unit="deg")
    assert turned.command_unit == "rad"
    np.testing.assert_allclose(turned.command, PULL)


def test_the_keywords_of_arrays_are_shown_and_a_mistyped_one_is_named():
    """What help and tab completion show is what may be given."""
    shown = inspect.signature(Trajectory.from_arrays).parameters
    assert {"time", "position", "command", "markers", "channels", "command_unit", "initial_command"} <= set(shown)
    assert "given" not in shown
    documented = Trajectory.from_arrays.__doc__ or ""
    assert [name for name in shown if not re.search(rf"``{name}``|\b{name}:", documented)] == []
    with pytest.raises(InputError, match=r"from_arrays: unknown keyword 'positions'; did you mean 'position'\?"):
        arrays(positions=PLACE)
    with pytest.raises(InputError, match="not given: channels"):
        Trajectory.from_arrays(time=TIME, position=PLACE, command=PULL, markers=["middle", "tip"])


def test_a_marker_that_is_seen_alone_may_stand_still():
    """As in a prediction from a first row in which the other markers were lost."""
    dataset = arrays().dataset.copy(deep=True)
    dataset["position_mask"][:] = False
    dataset["position_mask"][0, 0] = True
    assert Trajectory(dataset).position_mask.sum() == 1
    dataset["position"] *= 1e-3
    with pytest.raises(InputError, match="metres given as millimetres"):
        Trajectory(dataset)


def test_a_recording_shows_itself_in_a_line():
    lost = PLACE.copy()
    lost[3, 1] = np.nan
    run = arrays(position=lost, name="a<b")
    line = "Trajectory a<b: 20 rows over 1.9 s; markers middle, tip; 2 commands [m]: left, right; 1 of 40 positions"
    assert repr([run]) == f"[<{line} left out>]"
    assert run._repr_html_().startswith("<p>Trajectory a&lt;b: 20 rows")
    assert "left out" not in repr(arrays())


def test_a_table_and_a_data_set_give_the_same():
    frame = pd.DataFrame({"t": TIME, "left": PULL[:, 0], "right": PULL[:, 1]})
    for m, marker in enumerate(NAMES["markers"]):
        for axis in range(3):
            frame[f"{marker}_{'xyz'[axis]}"] = 1e3 * PLACE[:, m, axis]
    columns = {
        "time": "t",
        "commands": ["left", "right"],
        "command_unit": "m",
        "positions": [tuple(f"{marker}_{axis}" for axis in "xyz") for marker in NAMES["markers"]],
        "position_unit": "mm",
        "markers": NAMES["markers"],
    }
    dataset = xr.Dataset(
        {
            "position": (("marker", "time", "axis"), 100.0 * PLACE.transpose(1, 0, 2), {"units": "cm"}),
            "command": (("time", "channel"), PULL, {"units": "m"}),
        },
        {"time": TIME, "marker": NAMES["markers"], "channel": NAMES["channels"], "axis": list("xyz")},
    )
    for other in (Trajectory.from_pandas(frame, columns), Trajectory.from_xarray(dataset)):
        np.testing.assert_allclose(other.position, PLACE, atol=1e-15)
        np.testing.assert_allclose(other.command, PULL)
        assert (other.marker_names, other.cable_names) == (("middle", "tip"), ("left", "right"))
    assert Trajectory.from_xarray(arrays().dataset).sha256 == arrays().sha256
    dated = dataset.assign_coords(time=pd.Timestamp("2024-05-01") + pd.to_timedelta(TIME, "s"))
    counted = dataset.assign_coords(time=("time", 1e3 * TIME, {"units": "ms"}))
    for other in (dated, counted):
        np.testing.assert_allclose(Trajectory.from_xarray(other).time, TIME, atol=1e-9)


def test_every_variable_of_a_data_set_counts_in_the_unit_that_it_states():
    """Angles in degrees, commands that are stamped in milliseconds, and a pose in centimetres."""
    sent, angle = np.arange(10) * 0.2, np.stack([TIME, -TIME], axis=-1)
    pose = np.tile([0.1, 0.2, 0.05, 0.0, 0.0, 0.6, 0.8], (len(TIME), 1))

    def dataset(**units):
        clock = {} if "command_time" not in units else {"units": units["command_time"]}
        size = {"ms": 1e3, "deg": np.degrees(1.0), "cm": 100.0, "mm": 1e3}
        scale = {key: size.get(unit, 1.0) for key, unit in units.items()}
        told = {key: {"units": unit} for key, unit in units.items()}
        scaled = pose * np.repeat([scale.get("object_pose", 1.0), 1.0], [3, 4])
        return xr.Dataset(
            {
                "position": (("time", "marker", "axis"), PLACE),
                "command": (("command_time", "channel"), PULL[:10]),
                "initial_command": (
                    ("channel",),
                    np.array([0.001, 0.002]) * scale.get("initial_command", 1.0),
                    told.get("initial_command", {}),
                ),
                "tension": (("time", "channel"), 1.0 + PULL, told.get("tension", {})),
                "motor_angle": (
                    ("time", "channel"),
                    angle * scale.get("motor_angle", 1.0),
                    told.get("motor_angle", {}),
                ),
                "object_pose": (("time", "pose"), scaled, told.get("object_pose", {})),
            },
            {"time": TIME, "command_time": ("command_time", sent * scale.get("command_time", 1.0), clock), **LABELS},
        )

    plain = Trajectory.from_xarray(dataset())
    units = {"command_time": "ms", "motor_angle": "deg", "object_pose": "cm", "initial_command": "mm", "tension": "N"}
    other = Trajectory.from_xarray(dataset(**units))
    for key in ("command_time", "motor_angle", "object_pose", "initial_command", "tension"):
        np.testing.assert_allclose(getattr(other, key), getattr(plain, key), atol=1e-12, err_msg=key)
    np.testing.assert_allclose(other.command_time, sent)
    np.testing.assert_allclose(other.motor_angle, angle)
    for key, unit in (("tension", "mN"), ("motor_angle", "turns"), ("initial_command", "deg")):
        with pytest.raises(InputError, match=f"{key}: unknown unit '{unit}'"):
            Trajectory.from_xarray(dataset(**{key: unit}))


def test_missing_positions_are_masked_and_counted():
    holes = PLACE.copy()
    holes[3, 1] = np.nan
    assert not arrays(position=holes).position_mask[3, 1]
    assert "1 lost" in arrays(position=holes).left_out or "missing" in arrays(position=holes).left_out


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"position_unit": "inch"}, "unknown unit 'inch'"),
        ({"position": 1e3 * PLACE}, "millimetres given as metres"),
        ({"markers": ["tip"]}, r"and not \(20 times, 1 markers, 3\)"),
        ({"command": PULL[:5]}, ""),
        ({"time": TIME[::-1]}, "does not increase"),
    ],
)
def test_what_does_not_fit_is_said(changes, said):
    if not said:  # commands may end before the observations do
        assert len(arrays(**changes).command) == 5
        return
    with pytest.raises(InputError, match=said):
        arrays(**changes)


def swinging(rest_first: bool, **changes) -> Trajectory:
    """An arm at 20 Hz that is sent 10 mm in the first row, and sets out from rest or stands there already."""
    time = 0.05 * np.arange(80)
    sent = np.where(time < 2.0, 0.01, -0.005)
    before = 0.0 if rest_first else sent[0]
    level = np.empty(80)
    for row in range(80):
        before += (1.0 - np.exp(-0.05 / 0.2)) * (sent[max(row - 1, 0)] - before) * (row > 0)
        level[row] = before
    place = np.stack([5.0 * level, 0.0 * time, 0.2 + 0.0 * time], axis=-1)[:, None]
    place += np.random.default_rng(0).normal(0.0, 1e-5, place.shape)
    given = {"time": time, "position": place, "command": sent[:, None], "markers": ["tip"], "channels": ["pull"]}
    return Trajectory.from_arrays(**(given | changes))


@pytest.mark.parametrize(("rest_first", "initial"), [(True, 0.0), (False, 0.01)])
def test_the_command_before_the_first_row_is_recognised_as_in_files(rest_first, initial, tmp_path):
    found = swinging(rest_first)
    assert found.initial_command == pytest.approx([initial])
    assert "recognised" in found.first_command
    frame = pd.DataFrame({"t": found.time, "pull": found.command[:, 0]})
    frame[["x", "y", "z"]] = found.position[:, 0]
    columns = {"time": "t", "commands": ["pull"], "command_unit": "m", "position_unit": "m"}
    columns["positions"] = [["x", "y", "z"]]
    frame.to_csv(tmp_path / "run.csv", index=False)
    spec = DataSpec.parse({"format": "csv", "fit": ["run.csv"], "columns": columns})
    for other in (Trajectory.from_pandas(frame, columns), *load_recordings(spec, tmp_path)):
        assert other.first_command == found.first_command


def test_a_command_before_the_first_row_that_is_given_is_taken():
    assert swinging(True, initial_command="first").initial_command == pytest.approx([0.01])
    assert swinging(False, initial_command="zero").initial_command == pytest.approx([0.0])
    given = swinging(False, initial_command=[2.0], command=np.full((80, 1), 5.0), command_unit="mm")
    assert given.initial_command == pytest.approx([0.002])


@pytest.mark.parametrize(
    "missing",
    [
        lambda values: values.astype(object),
        lambda values: np.where(np.isnan(values), None, values.astype(object)),
        lambda values: np.where(np.isnan(values), pd.NA, values.astype(object)),
        lambda values: np.ma.masked_invalid(values),
        lambda values: np.ma.array(np.nan_to_num(values, nan=7.0), mask=np.isnan(values)),
        lambda values: values.tolist(),
    ],
    ids=["object", "None", "pd.NA", "masked", "masked, with values", "list"],
)
def test_every_way_to_say_that_a_position_is_missing(missing):
    holes = PLACE.copy()
    holes[3:5, 1] = np.nan
    found = arrays(position=missing(holes))
    assert np.argwhere(~found.position_mask).tolist() == [[3, 1], [4, 1]]
    assert found.settings["faults"]["missing"] == [0, 2]


@pytest.mark.parametrize("backend", ["numpy_nullable", "pyarrow"])
def test_tables_with_types_of_their_own_for_missing_values(backend):
    if backend == "pyarrow":
        pytest.importorskip("pyarrow")
    frame = pd.DataFrame({"t": TIME, "u": PULL[:, 0], "x": PLACE[:, 1, 0], "y": PLACE[:, 1, 1], "z": PLACE[:, 1, 2]})
    frame.loc[6:9, ["x", "y", "z"]] = np.nan
    frame["f"] = np.where(frame.index == 2, np.nan, 1.0)
    columns = {"time": "t", "commands": ["u"], "command_unit": "m", "position_unit": "m", "tensions": ["f"]}
    columns["positions"] = [["x", "y", "z"]]
    found = Trajectory.from_pandas(frame.convert_dtypes(dtype_backend=backend), columns)
    np.testing.assert_array_equal(found.position_mask[:, 0], (np.arange(20) < 6) | (np.arange(20) > 9))
    assert found.missing == "1 missing tensions"
    assert found.sha256 == Trajectory.from_pandas(frame, columns).sha256
    gaps = Trajectory.from_pandas(frame.assign(u=frame["x"]).convert_dtypes(dtype_backend=backend), columns)
    assert any("4 of 20 cells of commands are empty, the first in row 6 of u" in note for note in gaps.notes)
    np.testing.assert_array_equal(gaps.command[6:10], gaps.command[[5] * 4])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"command": np.zeros((0, 2))}, "commands have the shape"),
        ({"command": PULL[:, 0]}, r"commands have the shape \(20,\), and not \(times, 2 channels\)"),
        ({"position": "here"}, "positions are not all numbers"),
        ({"object_pose": np.zeros((20, 6))}, r"poses have the shape \(20, 6\), and not \(20 times, 7\)"),
        ({"tension": np.zeros((19, 2))}, r"tensions have the shape \(19, 2\), and not \(20 times, 2 channels\)"),
        ({"motor_angle": np.zeros(20)}, r"motor angles have the shape \(20,\)"),
        ({"initial_command": [0.0]}, r"initial commands have the shape \(1,\), and not \(2 channels\)"),
        ({"time": TIME[:1], "position": PLACE[:1], "command": PULL[:1]}, "has 1 observation rows"),
        ({"time": 0.0 * TIME}, "row 1: time does not increase"),
        ({"command_time": 0.0 * TIME}, "row 1: command_time does not increase"),
        ({"time_unit": "min"}, "unknown unit 'min'"),
        ({"initial_command": "last"}, 'initial_command is \'last\'; give "first", "zero"'),
    ],
)
def test_shapes_and_numbers_are_checked_before_anything_needs_them(changes, said):
    with pytest.raises(InputError, match=said):
        arrays(**changes)


def test_a_table_with_two_columns_of_one_name_is_refused():
    frame = pd.DataFrame(np.zeros((3, 3)), columns=["t", "x", "x"])
    columns = {"time": "t", "commands": ["t"], "command_unit": "m", "position_unit": "m"}
    with pytest.raises(InputError, match="column 'x' appears twice"):
        Trajectory.from_pandas(frame, {**columns, "positions": [["x", "x", "x"]]})


def test_a_new_grid_far_finer_than_the_rows_is_refused():
    with pytest.raises(InputError, match=r"would be 1\.9e.* rows of 20"):
        arrays(time=1e9 * TIME).resample(0.01)


def test_tables_of_other_libraries_are_taken():
    columns = {"time": "t", "commands": ["u"], "command_unit": "mm", "position_unit": "mm"}
    columns |= {"positions": [["x", "y", "z"]]}
    frame = pd.DataFrame({"t": [0.0, 0.5, 1.0], "u": [1.0, 2.0, 2.0], "x": [9.0, 8.0, 7.0], "y": 0.0, "z": 100.0})
    found = Trajectory.from_pandas(pa.Table.from_pandas(frame), columns)
    np.testing.assert_array_equal(found.position, Trajectory.from_pandas(frame, columns).position)
    with pytest.raises(InputError, match="a dict is not a table; give a DataFrame"):
        Trajectory.from_pandas({"t": [0.0]}, columns)
