"""Process-wide settings."""

from __future__ import annotations

import os
import signal
import warnings
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.runtime import CALLBACK_THREADS, keep_callback_threads, keep_compilations, refuse_lost_threads

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


def in_a_fork(body: Callable[[], bool]) -> bool:
    """Whether something holds in a process that is forked off here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # JAX says that this may hang
        child = os.fork()
    if child == 0:
        signal.alarm(20)  # one that hangs dies
        try:
            os._exit(0 if body() else 1)
        finally:
            os._exit(2)
    return os.waitpid(child, 0)[1] == 0


def said(call: Callable[[], object]) -> str:
    """What an error of the user's says; nothing without one."""
    try:
        call()
    except rb.InputError as error:
        return str(error)
    return ""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no forks")
def test_a_fork_behind_the_back_of_jax_is_refused_in_one_line() -> None:
    """Its threads are not there: a computation would wait for them for ever."""
    jnp.zeros(1)
    remedy = 'multiprocessing.get_context("spawn")'
    refuse_lost_threads()
    for call in (
        refuse_lost_threads,
        lambda: rb.simulate(None, []),
        lambda: rb.calibrate(None),
        lambda: rb.predict(None, []),
    ):
        assert in_a_fork(lambda call=call: remedy in said(call) and "\n" not in said(call))
    assert in_a_fork(lambda: in_a_fork(lambda: remedy in said(refuse_lost_threads)))
    refuse_lost_threads()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no forks")
def test_a_fork_before_jax_has_started_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jax._src.xla_bridge._backends", {})
    assert in_a_fork(lambda: said(refuse_lost_threads) == "")
