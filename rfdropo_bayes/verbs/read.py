"""Recordings from files: the table [data] of an experiment file, as a call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rfdropo_bayes.data import DataSpec, Trajectory, load_recordings
from rfdropo_bayes.signatures import with_keys_of


@with_keys_of(DataSpec, without=("fit", "test"))
def read(
    files: str | Path | Mapping[str, Any] | Sequence[str | Path | Mapping[str, Any]],
    format: str = "netcdf",
    columns: Mapping[str, Any] | None = None,
    *,
    folder: Path | str = Path(),
    **keys: Any,
) -> list[Trajectory]:
    """Read recordings.

    Args:
        files: names and patterns, relative to $RFDROPO_DATA or ``folder``; an entry may also be a dictionary with
            ``observations``, ``commands``, ``rows`` and ``episodes``.
        format: csv, motive-csv, rosbag, lerobot, mat, npz, netcdf, asl-csv, optitrack-csv or sofa-csv.
        columns: meaning of each column, for the first six formats, as in an experiment file's [data.columns].
        folder: base of relative names.
        keys: further keys of [data], such as ``resample``, ``missing`` or ``initial_command``.

    Raises:
        InputError: a file that is missing or damaged, a pattern that matches nothing, or an unknown key.
    """
    entries = [files] if isinstance(files, str | Path | Mapping) else list(files)
    named = [dict(entry) if isinstance(entry, Mapping) else str(entry) for entry in entries]
    table = {"format": format, "fit": named, **({} if columns is None else {"columns": dict(columns)}), **keys}
    return load_recordings(DataSpec.parse(table, where="read"), Path(folder))
