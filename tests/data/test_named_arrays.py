"""Files of MATLAB and NumPy: arrays by name, and their columns by number."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from rfdropo_bayes.data import DataSpec, load_recordings
from rfdropo_bayes.data.mapped_formats import recognised_format
from rfdropo_bayes.data.named_arrays import read_arrays
from rfdropo_bayes.errors import InputError

TIME = 0.05 * np.arange(30)
SENT = np.column_stack([np.sin(TIME), np.cos(TIME)])
PLACE = np.tile([[0.0, 0.0, 60.0], [0.0, 0.0, 120.0]], (30, 1, 1))
PLACE[..., 0] += 10.0 * np.sin(TIME)[:, None]
ARRAYS = {"t": TIME, "u": SENT, "markers": PLACE, "gain": 3.0, "name": "monday"}
COLUMNS = {
    "time": "t",
    "commands": ["u[0]", "u[1]"],
    "command_unit": "mm",
    "positions": [[f"markers[{k}][{axis}]" for axis in range(3)] for k in range(2)],
    "position_unit": "mm",
}


def write_npz(path):
    np.savez(path, **ARRAYS, extra=np.array([{}], dtype=object))


def write_hdf5(path):
    """As MATLAB 7.3: the text before the first 512 bytes, and the axes the other way round."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in ARRAYS.items():
            if name != "name":
                file[name] = np.asarray(value).T if np.ndim(value) > 1 else np.atleast_2d(value).T
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")


@pytest.mark.parametrize(
    ("file", "write"),
    [
        ("run.npz", write_npz),
        ("run.mat", lambda path: savemat(path, ARRAYS)),
        ("turned.mat", lambda path: savemat(path, ARRAYS | {"u": SENT.T})),
        ("run.mat", write_hdf5),
    ],
)
def test_arrays_are_recordings(tmp_path, file, write):
    write(tmp_path / file)
    assert recognised_format(tmp_path / file) == file[-3:]
    (found,) = load_recordings(DataSpec.parse({"format": file[-3:], "fit": [file], "columns": COLUMNS}), tmp_path)
    assert found.name == file[:-4]
    np.testing.assert_allclose(found.time, TIME)
    np.testing.assert_allclose(found.command, 1e-3 * SENT)
    np.testing.assert_allclose(found.position, 1e-3 * PLACE)


def test_the_fields_of_a_structure_follow_a_full_stop(tmp_path):
    savemat(tmp_path / "run.mat", {"run": {"t": TIME, "u": SENT}})
    assert list(read_arrays(tmp_path / "run.mat").columns) == ["run.t", "run.u[0]", "run.u[1]"]


@pytest.mark.parametrize("file", ["run.mat", "run.npz"])
def test_a_damaged_file_is_said(tmp_path, file):
    (savemat if file.endswith("mat") else lambda path, arrays: np.savez(path, **arrays))(tmp_path / file, ARRAYS)
    (tmp_path / file).write_bytes((tmp_path / file).read_bytes()[:300])
    with pytest.raises(InputError, match="is not a readable file of arrays"):
        read_arrays(tmp_path / file)
