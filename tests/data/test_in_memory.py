"""Recordings from arrays, tables and data sets: one content, whichever way it came."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError

TIME = 0.1 * np.arange(20)
PLACE = np.stack([0.01 * np.sin(TIME), 0.02 * np.cos(TIME), 0.1 + 0.0 * TIME], axis=-1)[:, None] * [[[1.0]], [[0.5]]][0]
PLACE = np.concatenate([0.5 * PLACE, PLACE], axis=1)  # (time, 2 markers, 3) [m]
PULL = np.stack([0.01 * (TIME > 0.5), 0.005 * (TIME > 1.0)], axis=-1)  # [m]
NAMES = {"markers": ["middle", "tip"], "channels": ["left", "right"]}


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
