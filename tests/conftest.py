"""Shared by all tests: array shapes checked at run time, and where the measured data are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

REPOSITORY = Path(__file__).resolve().parents[1]

# Rooms in which beartype checks every call against its jaxtyping annotations: the numerical ones. Rooms at the border
# (data, robots, posteriors) refuse wrong shapes themselves, with an InputError, and are tested for that.
CHECKED_ROOMS = ("fem", "bayes", "inference")
UNCHECKED_MODULES = (
    "rfdropo_bayes.fem.native.",  # compiled by Numba, which cannot see through a wrapper
    # These take NumPy arrays and plain floats where they are annotated with JAX arrays.
    "rfdropo_bayes.fem.tetrahedra",
    "rfdropo_bayes.fem.cables",
    "rfdropo_bayes.bayes.noise",
)


def checked_modules() -> list[str]:
    """Dotted names of the modules that are checked; a package's own name would stand for everything inside it."""
    paths = [path for room in CHECKED_ROOMS for path in (REPOSITORY / "rfdropo_bayes" / room).rglob("*.py")]
    names = (".".join(path.relative_to(REPOSITORY).with_suffix("").parts) for path in paths)
    return sorted(name for name in names if not name.endswith("__init__") and not name.startswith(UNCHECKED_MODULES))


install_import_hook(checked_modules(), "beartype.beartype")


@pytest.fixture(scope="session")
def datasets() -> Path:
    """Folder of the measured data sets; the test is skipped where they are absent."""
    folder = Path(os.environ.get("RFDROPO_DATA", REPOSITORY.parent / "shared" / "datasets"))
    if not folder.is_dir():
        pytest.skip(f"measured data not found at {folder}; set RFDROPO_DATA to the folder that holds them")
    return folder
