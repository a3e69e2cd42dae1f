"""Numbers of NumPy in tables, files and options, and paths of Windows in TOML."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest

from rfdropo_bayes.data import DataSpec
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import write_json
from rfdropo_bayes.inference.method_options import settings_text
from rfdropo_bayes.inference.methods import make_config
from rfdropo_bayes.model.experiment_file import describe, read_tables

TABLE = {"seed": np.int64(3), "model": {"fixed": {"e": np.float32(0.5)}, "rows": [np.int32(1), (np.int64(2), 3)]}}
PLAIN = {"seed": 3, "model": {"fixed": {"e": 0.5}, "rows": [1, [2, 3]]}}


def test_numbers_of_numpy_are_written_as_those_of_python(tmp_path):
    assert tomllib.loads(describe(TABLE)) == PLAIN
    write_json(tmp_path / "a.json", TABLE)
    assert json.loads((tmp_path / "a.json").read_text()) == PLAIN


def test_numbers_of_numpy_are_options_and_keys():
    one, other = (make_config("smc", {"rollouts": number}) for number in (np.int64(4000), 4000))
    assert one == other
    assert settings_text(np.int64(40)) == settings_text(40)
    entry = {"observations": "a.nc", "rows": (np.int64(0), np.int64(9))}
    spec = DataSpec.parse({"format": "netcdf", "fit": [entry], "resample": np.float32(0.5)})
    assert spec.fit[0].rows == (0, 9)
    assert spec.resample == 0.5


@pytest.mark.parametrize("line", [r'folder = "C:\Users\ann"', r'folder = "D:\data\run.csv"'])
def test_a_path_of_windows_in_double_quotes_is_explained(tmp_path, line):
    (tmp_path / "a.toml").write_text(f"seed = 0\n{line}\n")
    with pytest.raises(InputError, match="write paths with / or in single quotes"):
        read_tables(tmp_path / "a.toml")
