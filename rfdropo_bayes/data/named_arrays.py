"""Files of arrays with names: MATLAB's ``.mat`` and NumPy's ``.npz``.

An array of one column gives a column of its name, ``t``. Columns of wider arrays have numbers, ``tip[0]``; an array of
rows, markers and axes gives ``markers[1][2]``. The fields of a structure follow a full stop: ``run.tip[0]``. Rows are
along the first axis, or along the second axis of an array that is as wide as the others are long. Arrays of another
length, texts and scalars are passed over.
"""

from __future__ import annotations

import zipfile
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rfdropo_bayes.errors import InputError

MAT, NPZ = "mat", "npz"
FORMATS = (MAT, NPZ)
MATLAB, ZIP, HDF5 = b"MATLAB", b"PK\x03\x04", b"\x89HDF\r\n\x1a\n"
NUMBERS = "biufMm"  # kinds of arrays that are read: numbers, dates and durations


def array_format(path: Path, first: bytes) -> str | None:
    """Format of a file, one of `FORMATS`, by its first bytes; None for other files."""
    if first.startswith(MATLAB) or (first.startswith(HDF5) and path.suffix == ".mat"):
        return MAT
    if first.startswith(ZIP) and zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as file:
            return NPZ if any(name.endswith(".npy") for name in file.namelist()) else None
    return None


def read_arrays(path: Path) -> pd.DataFrame:
    """The arrays of a file with the most common number of rows, side by side.

    Raises:
        InputError: a damaged file, or a file without arrays of numbers.
    """
    try:
        arrays = _of_npz(path) if path.suffix != ".mat" else _of_mat(path)
    except (OSError, ValueError, KeyError, TypeError, NotImplementedError, zipfile.BadZipFile) as error:
        raise InputError(
            f"is not a readable file of arrays ({type(error).__name__}: {error})".replace("\n", " "),
            where=str(path),
            remedy="save it again, from MATLAB with arrays in place of tables and timetables",
        ) from None
    arrays = {name: np.atleast_1d(np.squeeze(array)) for name, array in arrays.items() if array.dtype.kind in NUMBERS}
    long = Counter(max(array.shape) for array in arrays.values() if array.size > 1)
    if not long:
        raise InputError("holds no arrays of numbers", where=str(path), remedy="save each signal as an array")
    rows = max(long, key=lambda length: (long[length], length))
    return pd.DataFrame({name: column for key in arrays for name, column in _columns(key, arrays[key], rows)})


def _columns(name: str, array: np.ndarray, rows: int) -> list[tuple[str, np.ndarray]]:
    """The columns of an array under their names; none of an array with another number of rows."""
    if array.shape[0] != rows and array.ndim == 2 and array.shape[1] == rows:
        array = array.T
    if array.shape[0] != rows:
        return []
    if array.ndim == 1:
        return [(name, array)]
    places = np.ndindex(array.shape[1:])
    return [(f"{name}[{']['.join(map(str, place))}]", array[(slice(None), *place)]) for place in places]


def _of_npz(path: Path) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {}
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        for name in file.files:
            with suppress(ValueError):  # an array of Python objects
                arrays[name] = file[name]
    return arrays


def _of_mat(path: Path) -> dict[str, np.ndarray]:
    with path.open("rb") as file:
        first = file.read(128)
    return _of_hdf5(path) if first.startswith(HDF5) or b"MATLAB 7.3" in first else _of_older(path)


def _of_older(path: Path) -> dict[str, np.ndarray]:
    """MATLAB's files before 7.3."""
    from scipy.io import loadmat

    arrays: dict[str, np.ndarray] = {}

    def gather(name: str, value: Any) -> None:
        if isinstance(value, np.ndarray) and value.dtype.names:
            if value.size == 1:
                for field in value.dtype.names:
                    gather(f"{name}.{field}", value[field].item())
        elif isinstance(value, np.ndarray):
            arrays[name] = value

    for name, value in loadmat(path).items():
        if not name.startswith("__"):
            gather(name, value)
    return arrays


def _of_hdf5(path: Path) -> dict[str, np.ndarray]:
    """MATLAB's files from 7.3 on, which hold arrays with their axes the other way round."""
    import h5py

    arrays: dict[str, np.ndarray] = {}

    def gather(name: str, value: Any) -> None:
        if isinstance(value, h5py.Dataset) and not name.startswith("#"):
            arrays[name.replace("/", ".")] = np.asarray(value).T

    with h5py.File(path) as file:
        file.visititems(gather)
    return arrays
