"""Shared by all tests: array shapes checked at run time, and where the measured data are."""

from __future__ import annotations

import ctypes
import gc
import hashlib
import os
from pathlib import Path

import jax
import meshio
import numpy as np
import psutil
import pytest
from jaxtyping import install_import_hook

from rfdropo_bayes.runtime import keep_compilations
from tests.costs import Costs, spent

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


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--typed", action="store_true", help="check array shapes at run time (twice as slow)")
    parser.addoption("--drawn", metavar="COUNT", help="run so many of the tests, or so many percent, drawn by --by")
    parser.addoption("--by", metavar="SEED", default="", help="seed of --drawn")
    parser.addoption("--costs", metavar="FILE", help="write the processor seconds of every test to FILE, dearest first")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--typed"):  # before any test imports a module that is checked
        install_import_hook(checked_modules(), "beartype.beartype")
    share_compilations()
    config.spent_so_far = spent()
    config.pluginmanager.register(Costs(config.getoption("--costs")), "costs")


def share_compilations() -> None:
    """Keep what JAX compiles where programs keep it, for all workers and for the next run: half of what tests cost."""
    keep_compilations()
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    least = float(os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least)


@pytest.hookimpl(trylast=True)  # after -m and -k
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    count = config.getoption("--drawn")
    if count is None or not items:
        return
    wanted = max(1, round(len(items) * float(count[:-1]) / 100.0)) if count.endswith("%") else int(count)
    seed = config.getoption("--by")
    order = sorted(items, key=lambda item: hashlib.sha256(f"{seed} {item.nodeid}".encode()).digest())
    kept = set(order[:wanted])
    config.hook.pytest_deselected(items=order[wanted:])
    items[:] = [item for item in items if item in kept]


@pytest.hookimpl(tryfirst=True)  # before the fixtures, which compile as well
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let JAX compile in haste for tests that are not slow: they run each program for milliseconds, and to optimise it
    takes a third of what they cost."""
    jax.config.update("jax_disable_most_optimizations", item.get_closest_marker("slow") is None)


MOST_MEMORY = 2.5e9  # bytes of a process above which what JAX compiled for earlier modules is dropped


@pytest.fixture(scope="module", autouse=True)
def compiled_programs_are_dropped():
    """After a module of tests, drop the compiled programs once they fill the memory: 4 GB a process without this."""
    yield
    if psutil.Process().memory_info().rss > MOST_MEMORY:
        jax.clear_caches()
        gc.collect()
        if hasattr(ctypes.CDLL(None), "malloc_trim"):  # glibc keeps what was freed, unless asked
            ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="session")
def datasets() -> Path:
    """Folder of the measured data sets; the test is skipped where they are absent."""
    folder = Path(os.environ.get("RFDROPO_DATA", REPOSITORY.parent / "shared" / "datasets"))
    if not folder.is_dir():
        pytest.skip(f"measured data not found at {folder}; set RFDROPO_DATA to the folder that holds them")
    return folder


BAR_CELLS = (2, 2, 10)
BAR_SIZE = (26.0, 26.0, 195.0)  # [mm]
CUBE_TETRAHEDRA = np.array([[0, 1, 3, 7], [0, 1, 7, 5], [0, 5, 7, 4], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7]])


@pytest.fixture(scope="session")
def bar_mesh(tmp_path_factory) -> Path:
    """Mesh file in mm: a bar of few tetrahedra about the axis, as long and as thick as the SOFA trunk."""
    nx, ny, nz = BAR_CELLS
    z, y, x = np.meshgrid(
        np.linspace(0.0, BAR_SIZE[2], nz + 1),
        np.linspace(-BAR_SIZE[1] / 2, BAR_SIZE[1] / 2, ny + 1),
        np.linspace(-BAR_SIZE[0] / 2, BAR_SIZE[0] / 2, nx + 1),
        indexing="ij",
    )
    offset = np.array([(c * (ny + 1) + b) * (nx + 1) + a for c in range(2) for b in range(2) for a in range(2)])
    first = np.array([(k * (ny + 1) + j) * (nx + 1) + i for k in range(nz) for j in range(ny) for i in range(nx)])
    elements = (first[:, None, None] + offset[CUBE_TETRAHEDRA]).reshape(-1, 4)
    path = tmp_path_factory.mktemp("mesh") / "bar.vtk"
    meshio.write_points_cells(path, np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), [("tetra", elements)])
    return path
