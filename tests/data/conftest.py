"""Small recordings and files that the tests of this room share."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory

KINDS = (Origin, SentCommands, Measured)


def _recording(rows: int = 11, **changes: object) -> Trajectory:
    """Two markers moving linearly for a second, two cables, commands in every row but the last."""
    time = np.linspace(0.0, 1.0, rows)
    position = np.stack([[0.1, 0.0, 0.1], [0.0, 0.1, 0.2]])[None] + time[:, None, None] * np.array([0.02, 0.0, -0.01])
    content: dict[str, object] = {
        "name": "made",
        "robot": "trunk_sofa",
        "format": "netcdf",
        "time": time,
        "position": position,
        "command_time": time[:-1],
        "command": 1e-3 * np.arange(2 * (rows - 1)).reshape(-1, 2),
        "command_unit": "m",
        "marker_names": ["m1", "m2"],
        "cable_names": ["a", "b"],
    }
    content |= changes
    parts = ({f.name: content.pop(f.name) for f in fields(kind) if f.name in content} for kind in KINDS)
    recording = Trajectory.build(*(kind(**part) for kind, part in zip(KINDS, parts, strict=True)))
    assert not content, f"no part of a recording: {content}"
    return recording


@pytest.fixture
def recording() -> Trajectory:
    return _recording()


@pytest.fixture(scope="session")
def build() -> Callable[..., Trajectory]:
    return _recording


def _sofa_table(rows: int = 5) -> pd.DataFrame:
    """A valid sofa-csv episode: a straight trunk whose points all move 1 mm in y per action; cable 2 is pulled."""
    table = pd.DataFrame({"action": [-1] + [2] * (rows - 1)})
    for point in range(21):
        table[f"x{point}"] = 0.0
        table[f"y{point}"] = -1.0 * np.arange(rows)
        table[f"z{point}"] = 9.0 * point
    table["terminal"] = [False] * (rows - 1) + [True]
    return table


def _optitrack_table(rows: int = 12) -> pd.DataFrame:
    """A valid optitrack-csv recording at 10 Hz without a cube; action 1 then 9 by turns."""
    table = pd.DataFrame({"timestamp": 100.0 + 0.1 * np.arange(rows)})
    noise = np.random.default_rng(0).normal(0.0, 0.01, (rows, 4, 3))
    for marker in range(4):
        for axis, value in zip("xyz", (0.0, -10.0 * marker, 40.0 * (marker + 1)), strict=True):
            table[f"{axis}{marker + 1}"] = value + 0.5 * np.arange(rows) + noise[:, marker, "xyz".index(axis)]
    table["action"] = [-1] + [1 + 8 * (row % 2) for row in range(rows - 1)]
    return table


def _asl_tables(rows: int = 60) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Valid asl-csv observations and commands: 30 degrees on motor 1, disks drifting slowly."""
    noise = np.random.default_rng(1).normal(0.0, 1e-5, (rows, 3, 3))
    observations = pd.DataFrame({"ID": np.arange(rows)})
    for disk in range(3):
        for axis, value in zip("xyz", (0.1, -0.1 * (disk + 1), 0.12), strict=True):
            drift = 1e-4 * np.arange(rows)
            observations[f"{axis}{disk + 1}"] = value + drift + noise[:, disk, "xyz".index(axis)]
    commands = pd.DataFrame({"ID": np.arange(rows - 1)} | {f"u{motor}": 0.0 for motor in range(1, 7)})
    commands["u1"] = 30.0
    return observations, commands


def _write(table: pd.DataFrame, path: Path) -> Path:
    """Write a table as CSV, gzipped if the name says so."""
    text = table.to_csv(index=False)
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return path


@pytest.fixture(scope="session")
def sofa_table() -> Callable[..., pd.DataFrame]:
    return _sofa_table


@pytest.fixture(scope="session")
def optitrack_table() -> Callable[..., pd.DataFrame]:
    return _optitrack_table


@pytest.fixture(scope="session")
def asl_tables() -> Callable[..., tuple[pd.DataFrame, pd.DataFrame]]:
    return _asl_tables


@pytest.fixture(scope="session")
def write() -> Callable[[pd.DataFrame, Path], Path]:
    return _write
