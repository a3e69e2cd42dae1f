"""Folders of runs: write protection, record of the run, and its completion."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from rfdropo_bayes import __version__
from rfdropo_bayes.errors import InputError, Interrupted
from rfdropo_bayes.files import output_folder, unwritten, write_text
from rfdropo_bayes.interrupts import interrupted, running
from rfdropo_bayes.model.experiment_file import FILE_KEYS, ROBOT_COPY, describe, self_contained
from rfdropo_bayes.tables import plain

RUN, CONFIG, LOG, CHECKPOINTS, PAGE = "run.json", "config.toml", "log.jsonl", "checkpoints", "report.html"
RUNNING, INTERRUPTED, FAILED, DONE = "running", "interrupted", "failed", "done"
SCHEMA_VERSION = 1
NAMED_DIFFERENCES = 3
# Results of a run do not depend on these: title and length of the run.
FREE_TO_CHANGE = (
    "experiment.title",
    "experiment.audit.minutes",
    "experiment.design.minutes",
    "experiment.training.steps",
)


MOVABLE = ("experiment.data.fit", "experiment.data.test")


class RunKind(NamedTuple):
    """Output files of a command: the first of ``results`` marks its completion; whether it can be resumed; and whether
    several programs may share its folder, each with its own rows.
    """

    results: tuple[str, ...]
    resumable: bool = False
    shared: bool = False


COMMANDS = {
    "calibrate": RunKind(("summary.json", "posterior.nc", PAGE), resumable=True),
    "adapt": RunKind(("summary.json", "posterior.nc", PAGE)),
    "simulate": RunKind(("simulation.json",)),
    "predict": RunKind(("prediction.json", "prediction.nc", "prediction.csv")),
    "audit": RunKind(("audit.json", "extended.toml", PAGE), resumable=True),
    "design": RunKind(("design.json", "next_commands.csv")),
    "train": RunKind(("summary.json", "policy.onnx", "card.md", "curve.png", "episodes.jsonl", PAGE), resumable=True),
    "evaluate": RunKind(("evaluation.json", "evaluation.md", "episodes.csv", "success.png")),
}


@contextmanager
def run_folder(
    out: Path,
    command: str,
    *,
    tables: Mapping[str, Any] | None = None,
    folder: Path = Path(),
    options: Mapping[str, Any] | None = None,
    data: Mapping[str, str] | None = None,
    texts: Mapping[str, str] | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> Iterator[Path]:
    """The folder of one run, with ``run.json`` and the files needed to repeat it: ``config.toml``, the robot.

    A finished run is not replaced, and an interrupted run is not restarted, unless ``overwrite`` is set. A resumed run
    keeps its settings.

    Args:
        out: the folder.
        command: name of the command, one of `COMMANDS`.
        tables: tables of the experiment, if any; folder: folder of its file.
        options: settings of the command line that results depend on.
        data: hashes of the recordings, by their names.
        texts: files named in the tables that exist in no folder, such as the description of a robot made in Python.
        resume: continue the run in the folder, if any.
        overwrite: delete an earlier run of this program in the folder, and start anew.

    Yields:
        the folder.

    Raises:
        InputError: a folder that cannot be written, that holds another run, in which another program is running, or
            whose run had other settings.
        Interrupted: Ctrl-C.
    """
    out = output_folder(out)
    with _held(out, shared=COMMANDS[command].shared):
        earlier = _read(out / RUN)
        settings: dict[str, Any] = {"experiment": {}, "options": dict(options or {}), "data": dict(data or {})}
        check_folder(out, command, resume=resume, overwrite=overwrite)
        if resume and earlier is not None:
            with TemporaryDirectory() as trial:  # a run that does not continue keeps its files
                _check_settings(out, earlier["settings"], settings | _brought_along(tables, folder, texts, Path(trial)))
        settings |= _brought_along(tables, folder, texts, out)
        if not resume:
            _clear(out, COMMANDS[command].results)
        if tables is not None:
            write_text(out / CONFIG, describe(settings["experiment"]))
        record = {"schema_version": SCHEMA_VERSION, "command": command, "version": __version__, "settings": settings}
        _write(out, record, RUNNING)
        try:
            with running(checks=COMMANDS[command].resumable):
                yield out
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt) or interrupted():
                with suppress(InputError):
                    _write(out, record, INTERRUPTED)
                raise Interrupted(str(out), "--resume" if COMMANDS[command].resumable else None) from None
            with suppress(InputError):
                _write(out, record, FAILED)
            if isinstance(error, OSError) and not isinstance(error, FileNotFoundError):
                raise unwritten(error, Path(error.filename or out)) from None
            raise
        _write(out, record, DONE)


@contextmanager
def _held(out: Path, *, shared: bool) -> Iterator[None]:
    """Hold the lock of a folder, which the system gives back however the program ends.

    Raises:
        InputError: another program uses the folder, and may not share it.
    """
    try:
        import fcntl
    except ImportError:  # no locks of this kind on Windows
        yield
        return
    handle = os.open(out, os.O_RDONLY)
    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise InputError(
            "another program is running in this folder",
            where=str(out),
            remedy="wait until it has ended, or choose another folder with --out",
        ) from None
    except OSError:  # a file system without locks
        pass
    try:
        yield
    finally:
        os.close(handle)


def _brought_along(
    tables: Mapping[str, Any] | None, folder: Path, texts: Mapping[str, str] | None, out: Path
) -> dict[str, Any]:
    """The experiment with paths valid from any folder, and the digest of its robot; ``out`` gets copies of its
    files.
    """
    made = dict(texts or {})
    for name, text in made.items():
        write_text(out / name, text)
    if tables is None:
        return {}
    return {"experiment": self_contained(tables, folder, out, made), "robot": _digest(out / ROBOT_COPY)}


def hashes(recordings: Iterable[Any]) -> dict[str, str]:
    """Hash of the content of each recording (`Trajectory`), by its name."""
    return {recording.name: recording.sha256[:12] for recording in recordings}


def command_of(out: Path) -> str | None:
    """The command that wrote a folder, by its run.json or else by its results; None for a folder of no run."""
    found = _read(out / RUN)
    if found is not None:
        return str(found["command"])
    firsts = [kind.results[0] for kind in COMMANDS.values()]
    for name, kind in COMMANDS.items():
        telling = kind.results[: 1 if firsts.count(kind.results[0]) == 1 else 2]
        if all((out / result).is_file() for result in telling):
            return name
    return None


def run_ended(out: Path) -> bool:
    """Whether a folder holds a run that came to its end."""
    found = _read(out / RUN)
    return found is not None and found.get("status") == DONE


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return found if isinstance(found["settings"], dict) and found["command"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _write(out: Path, record: Mapping[str, Any], status: str) -> None:
    write_text(out / RUN, json.dumps(plain({**record, "status": status}), indent=2, default=str) + "\n")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def _clear(out: Path, results: Sequence[str]) -> None:
    """Remove the files of an earlier run of this command."""
    try:
        for name in (*results, LOG):
            (out / name).unlink(missing_ok=True)
        shutil.rmtree(out / CHECKPOINTS, ignore_errors=True)
    except OSError as error:
        raise unwritten(error, Path(error.filename or out)) from None


def check_folder(out: Path, command: str, *, resume: bool = False, overwrite: bool = False) -> None:
    """See that a command may write to a folder.

    Raises:
        InputError: the folder holds a run, and no option asks to continue or to replace it.
    """
    if resume and overwrite:
        raise InputError("--resume and --overwrite contradict each other", remedy="give one of them")
    if overwrite:
        return
    earlier = _read(out / RUN)
    ran = earlier["command"] if earlier else command
    if resume:
        if ran != command:
            raise InputError(
                f"holds a run of {ran}, which {command} cannot resume",
                where=str(out),
                remedy="choose another folder with --out",
            )
        return
    if (earlier is not None and earlier.get("status") == DONE) or (out / COMMANDS[command].results[0]).exists():
        raise InputError(
            f"holds a finished run of {ran}",
            where=str(out),
            remedy="choose another folder with --out, or replace it with --overwrite",
        )
    if (
        earlier is not None
        and (out / CHECKPOINTS).is_dir()
        and any(path.is_file() for path in (out / CHECKPOINTS).rglob("*"))
    ):
        remedy = "go on with --resume, or start anew with --overwrite"
        if ran != command:
            remedy = "choose another folder with --out, or replace it with --overwrite"
        raise InputError(f"holds an interrupted run of {ran}", where=str(out), remedy=remedy)


def _check_settings(out: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise InputError if the run began with other settings; names the first few. Recordings of the same content may
    have been moved.
    """
    old, new = dict(_flat(before)), dict(_flat(json.loads(json.dumps(plain(dict(now)), default=str))))
    if before.get("data") and before["data"] == now["data"]:
        for tables, name in product((old, new), MOVABLE):
            if name in tables:
                tables[name] = [_without_folders(entry) for entry in tables[name]]
    differing = [name for name in {**old, **new} if name not in FREE_TO_CHANGE and old.get(name) != new.get(name)]
    if not differing:
        return
    absent = "not set"
    words = [
        f"{name.removeprefix('experiment.')} was {old.get(name, absent)} and is now {new.get(name, absent)}"
        for name in differing[:NAMED_DIFFERENCES]
    ]
    more = f", and {len(differing) - NAMED_DIFFERENCES} more" if len(differing) > NAMED_DIFFERENCES else ""
    raise InputError(
        f"cannot resume a run with other settings: {', '.join(words)}{more}",
        where=str(out),
        remedy="resume with the settings it began with, or start anew with --overwrite",
    )


def _without_folders(entry: Any) -> Any:
    """A recording's entry with file names without folders."""
    if isinstance(entry, dict):
        return {key: _without_folders(value) if key in FILE_KEYS else value for key, value in entry.items()}
    return Path(str(entry)).name


def _flat(tables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tables.items():
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
