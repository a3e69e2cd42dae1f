"""Commands of one's own columns, with at most the first row of what was measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.data import CsvColumns, DataSpec, common_beginning, load_unseen, start_is_known
from rfdropo_bayes.data.plain_csv import command_columns

COLUMNS = {
    "time": "t",
    "time_unit": "ms",
    "commands": ["u1", "u2"],
    "command_unit": "mm",
    "positions": [["x1", "y1", "z1"], ["x2", "y2", "z2"]],
    "position_unit": "mm",
    "axes": ["x", "z", "-y"],
}
TIME = 0.05 * np.arange(4)
COMMAND = np.array([[0.0, 0.0], [0.002, 0.0], [0.002, 0.003], [0.004, 0.003]])


@pytest.fixture
def spec() -> DataSpec:
    return DataSpec.model_validate({"format": "csv", "fit": ["fitted.csv"], "columns": COLUMNS})


def written(folder: Path) -> None:
    """The file that a proposed experiment is written to, and a start pose."""
    table = command_columns(CsvColumns.model_validate(COLUMNS), TIME, COMMAND)
    assert list(table) == ["t", "u1", "u2"]
    pd.DataFrame(table).to_csv(folder / "next.csv", index=False)
    row = {f"{axis}{m}": 100.0 * m + k for m in (1, 2) for k, axis in enumerate("xyz")}
    pd.DataFrame([row, row]).to_csv(folder / "start.csv", index=False)


def test_commands_alone_are_read_back_as_they_were_written(tmp_path: Path, spec: DataSpec) -> None:
    written(tmp_path)
    found = load_unseen(spec, tmp_path, "next.csv")
    np.testing.assert_allclose(found.command, COMMAND, atol=1e-12)
    np.testing.assert_allclose(found.command_time, TIME, atol=1e-12)
    np.testing.assert_allclose(found.time, 0.05 * np.arange(5), atol=1e-12)  # the last command has an outcome, too
    assert found.command_unit == "m"
    assert not start_is_known(found)


def test_the_start_pose_is_one_row_of_another_file_in_the_base_frame(tmp_path: Path, spec: DataSpec) -> None:
    written(tmp_path)
    found = load_unseen(spec, tmp_path, "next.csv", "start.csv")
    assert start_is_known(found)
    assert np.asarray(found.position_mask).sum() == 2  # both markers, in the first row only
    np.testing.assert_allclose(found.position[0, 1], [0.200, 0.202, -0.201], atol=1e-12)


def test_new_commands_begin_as_the_fitted_recordings_do(tmp_path: Path, spec: DataSpec) -> None:
    """Unless [data] says how they do; where the fitted ones differ, the first command is taken for the one before."""
    pd.DataFrame(command_columns(CsvColumns.model_validate(COLUMNS), TIME, COMMAND + 0.01)).to_csv(
        tmp_path / "next.csv", index=False
    )
    found = {begun: load_unseen(spec, tmp_path, "next.csv", begun=begun) for begun in ("zero", "first", None)}
    assert not found["zero"].initial_command.any()
    assert "as in the fitted recordings" in found["zero"].first_command
    for begun in ("first", None):
        np.testing.assert_array_equal(found[begun].initial_command, found[begun].command[0])
    assert "assumed" in found[None].first_command
    said = load_unseen(spec.model_copy(update={"initial_command": "first"}), tmp_path, "next.csv", begun="zero")
    np.testing.assert_array_equal(said.initial_command, said.command[0])
    assert common_beginning([found["zero"], found["zero"]]) == "zero"
    assert common_beginning([found["zero"], found["first"]]) is None


def test_new_poses_at_rest_have_the_command_of_their_own_row(tmp_path: Path) -> None:
    """Also after a fit whose recordings began with zero or with their first command."""
    columns = {**COLUMNS, "commands_with_poses": True}
    spec = DataSpec.model_validate({"format": "csv", "fit": ["fitted.csv"], "columns": columns})
    table = command_columns(CsvColumns.model_validate(columns), TIME, COMMAND + 0.01)
    poses = {f"{axis}{m}": 100.0 * m + k + np.arange(len(TIME)) for m in (1, 2) for k, axis in enumerate("xyz")}
    pd.DataFrame(table | poses).to_csv(tmp_path / "next.csv", index=False)
    for begun in ("zero", "first", None):
        found = load_unseen(spec, tmp_path, "next.csv", begun=begun)
        np.testing.assert_allclose(np.vstack([found.initial_command, found.command]), COMMAND + 0.01, atol=1e-12)
    pd.DataFrame(table).to_csv(tmp_path / "alone.csv", index=False)
    alone = load_unseen(spec, tmp_path, "alone.csv", begun="zero")
    np.testing.assert_allclose(alone.time, TIME - TIME[0], atol=1e-12)
    np.testing.assert_allclose(alone.command_at(alone.time), COMMAND + 0.01, atol=1e-12)
