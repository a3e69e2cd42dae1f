"""Rows of a recording of which a fit keeps every so many."""

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.data.spec import DataSpec, load_recordings
from rfdropo_bayes.errors import InputError


def table(fit: dict, test: dict, **columns) -> DataSpec:
    names = {"commands": ["u"], "command_unit": "mm", "positions": [["x", "y", "z"]], "position_unit": "mm", **columns}
    entries = {"fit": [{"observations": "run.csv", **fit}], "test": [{"observations": "run.csv", **test}]}
    return DataSpec.parse({"format": "csv", **entries, "columns": {"markers": ["tip"], **names}})


@pytest.fixture
def folder(tmp_path):
    k = np.arange(20.0)
    frame = pd.DataFrame({"t": 0.5 * k, "u": k, "x": 10 * k, "y": 0 * k, "z": 100 + 0 * k})
    frame.to_csv(tmp_path / "run.csv", index=False)
    return tmp_path


def test_every_third_row_has_the_command_and_the_time_of_the_file(folder):
    spec = table({"every": 3, "rows": [2, 19]}, {"every": 3, "rows": [3, 19]}, time="t", commands_with_poses=True)
    for role, first in (("fit", 2), ("test", 3)):
        (run,) = load_recordings(spec, folder, role)
        rows = np.arange(first, 20, 3)
        np.testing.assert_allclose(run.position[:, 0, 0], 0.01 * rows)
        np.testing.assert_allclose(run.time, 0.5 * (rows - first))
        np.testing.assert_allclose(run.command_at(run.time)[:, 0], 1e-3 * rows)


def test_rows_without_times_follow_each_other(folder):
    spec = table({"every": 4, "rows": [0, 19]}, {"every": 4, "rows": [2, 19]}, time="rows", commands_with_poses=True)
    (run,) = load_recordings(spec, folder, "fit")
    np.testing.assert_allclose(run.time, np.arange(5.0))
    np.testing.assert_allclose(run.command_at(run.time)[:, 0], 1e-3 * np.arange(0, 20, 4))


@pytest.mark.parametrize(
    ("fit", "test", "shared"),
    [
        ({"every": 4, "rows": [0, 19]}, {"every": 4, "rows": [2, 19]}, False),
        ({"every": 4, "rows": [0, 19]}, {"every": 6, "rows": [2, 19]}, True),  # row 8
        ({"every": 4, "rows": [0, 7]}, {"every": 6, "rows": [2, 19]}, False),
        ({"every": 4}, {"rows": [1, 3]}, False),
        ({"every": 4}, {"rows": [1, 4]}, True),
    ],
)
def test_a_test_recording_shares_no_row_with_the_fit(folder, fit, test, shared):
    spec = table(fit, test, time="t")
    if not shared:
        assert len(load_recordings(spec, folder)) == 1
        return
    with pytest.raises(InputError, match="shares rows"):
        load_recordings(spec, folder)
