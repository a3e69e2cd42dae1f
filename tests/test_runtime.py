"""Process-wide settings."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rfdropo_bayes.runtime import CALLBACK_THREADS, keep_callback_threads, keep_compilations

VARIABLES = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")


@pytest.fixture
def unset(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An environment in which the user chose nothing but the cache folder."""
    for name in VARIABLES:
        # Set first, so that the fixture takes away afterwards what the call sets.
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def test_compilations_are_kept_in_the_cache_folder_of_the_user(unset: Path) -> None:
    keep_compilations()
    folder = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    assert folder.parent == unset / "rfdropo_bayes"
    keep_compilations()
    assert Path(os.environ["JAX_COMPILATION_CACHE_DIR"]) == folder


def test_a_folder_that_the_user_chose_stays(unset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/somewhere")
    keep_compilations()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "/somewhere"


@pytest.mark.parametrize(
    ("processors", "given", "threads"), [(1, None, CALLBACK_THREADS), (1, "2", "2"), (16, None, None)]
)
def test_callbacks_have_the_threads_that_they_wait_for(
    processors, given, threads, monkeypatch: pytest.MonkeyPatch
) -> None:
    """XLA reads the variable when it makes its pool; a number that the user chose stays, and so does that of many
    processors."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(processors)), raising=False)
    monkeypatch.setenv("PJRT_NPROC", given or "")
    if given is None:
        monkeypatch.delenv("PJRT_NPROC")
    keep_callback_threads()
    assert os.environ.get("PJRT_NPROC") == (None if threads is None else str(threads))
