"""Shared fixtures: where the measured data are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def datasets() -> Path:
    """Folder of the measured data sets; the test is skipped where they are absent."""
    folder = Path(os.environ.get("RFDROPO_DATA", REPOSITORY.parent / "shared" / "datasets"))
    if not folder.is_dir():
        pytest.skip(f"measured data not found at {folder}; set RFDROPO_DATA to the folder that holds them")
    return folder
