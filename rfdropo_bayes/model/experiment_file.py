"""The experiment file as text and tables: read, overridden, looked through, and made to work from another folder.

Nothing heavy is imported here: a mistyped path is answered before JAX and the engines are loaded.
"""

from __future__ import annotations

import copy
import os
import shutil
import tomllib
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import find_files, unwritten
from rfdropo_bayes.tables import parse_assignment, plain, read_toml, set_entry

ROBOT_COPY = "robot.toml"
MODEL_FILES = (".toml", ".xml", ".urdf")
FILE_KEYS = ("observations", "commands")
NO_COMMANDS = "none"  # zero commands instead of a file of commands


def read_tables(path: Path) -> dict[str, Any]:
    """Tables of a TOML file.

    Raises:
        InputError: no such file, or not TOML.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise InputError(
            f"cannot read the experiment file: {reason}", where=str(path), remedy="check the path"
        ) from None
    try:
        return read_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"not valid TOML: {error}", where=str(path), remedy="correct the syntax there") from None


def override(tables: dict[str, Any], assignment: str, fields: Container[str]) -> None:
    """Apply one assignment to nested tables in place; a bare name outside ``fields`` is a parameter."""
    keys, value = parse_assignment(assignment)
    if len(keys) == 1 and keys[0] not in fields:
        tables.get("model", {}).get("priors", {}).pop(keys[0], None)
        keys = ["model", "fixed", keys[0]]
    set_entry(tables, keys, value)


def describe(tables: Mapping[str, Any]) -> str:
    """The tables as TOML text, for config.toml in the run folder."""
    import tomli_w

    return tomli_w.dumps(plain(dict(tables)))


def look_through(path: Path, overrides: Sequence[str] = ()) -> None:
    """Check that the files of an experiment exist.

    Other faults are found by `load_experiment` and by the rooms that read its tables.

    Raises:
        InputError: the experiment file cannot be read, or a recording or a robot file is missing.
    """
    tables = read_tables(path)
    folder = Path(path).resolve().parent
    for assignment in overrides:
        if assignment.split("=")[0].strip().startswith(("data.", "robot")):
            override(tables, assignment, {"robot"})
    robot = tables.get("robot")
    if isinstance(robot, str) and robot.endswith(MODEL_FILES) and not _robot_file(robot, folder).is_file():
        raise InputError(
            "no such robot file", where=str(folder / robot), remedy="correct robot = ... in the experiment"
        )
    for name in _recordings(tables):
        find_files(name, folder, folders=True)


def _recordings(tables: Mapping[str, Any]) -> Iterator[str]:
    data = tables.get("data")
    for role in ("fit", "test"):
        entries = data.get(role) if isinstance(data, dict) else None
        for entry in entries if isinstance(entries, list) else []:
            named = [entry.get(key) for key in FILE_KEYS] if isinstance(entry, dict) else [entry]
            yield from (name for name in named if isinstance(name, str) and name != NO_COMMANDS)


def _robot_file(robot: str, folder: Path) -> Path:
    """Path of a robot file, relative to the experiment or else to the current folder."""
    beside = folder / robot
    return beside if beside.is_file() else Path(robot)


def self_contained(
    tables: Mapping[str, Any], folder: Path, out: Path | None = None, made: Container[str] = ()
) -> dict[str, Any]:
    """Tables that are valid in another folder.

    Args:
        tables: tables of an experiment.
        folder: folder of the experiment file.
        out: folder for copies of the robot's file and of mechanisms' code; without it, their paths are written.
        made: names of files made by a program, which do not refer to existing files.

    Raises:
        InputError: a file cannot be copied.
    """
    placed = copy.deepcopy(dict(tables))
    if "robot" in placed and placed["robot"] not in made:
        placed["robot"] = _robot_placed(str(placed["robot"]), folder, out)
    for table, key in (("model", "mechanisms"), ("audit", "candidates")):
        if key in placed.get(table, {}):
            placed[table][key] = [code_placed(name, folder, out) for name in placed[table][key]]
    mesh = placed.get("simulator", {}).get("tetrahedra", {})
    if "mesh" in mesh:
        mesh["mesh"] = _placed(mesh["mesh"], folder)
    for role in ("fit", "test"):
        if role in placed.get("data", {}):
            placed["data"][role] = [_placed(entry, folder) for entry in placed["data"][role]]
    return placed


def _robot_placed(robot: str, folder: Path, out: Path | None) -> str:
    """A robot's name or path that is valid from any folder; names of bundled robots are unchanged."""
    file = _robot_file(robot, folder)
    if file.suffix == ".toml" and file.is_file():
        return _brought(file, out, ROBOT_COPY)
    if file.suffix in MODEL_FILES and file.is_file():  # it may name meshes beside it, and is not moved
        return str(file.resolve())
    return code_placed(robot, folder, out) if ".py:" in robot else robot


def _placed(entry: Any, folder: Path) -> Any:
    """A recording's path that is valid from any folder."""
    if isinstance(entry, dict):
        return {k: _placed(v, folder) if k in FILE_KEYS else v for k, v in entry.items()}
    try:
        beside = find_files(str(entry), folder, folders=True)[0].is_relative_to(folder)
    except InputError:
        return entry
    return os.path.normpath(folder / str(entry)) if beside else entry


def code_placed(source: str, folder: Path, out: Path | None = None) -> str:
    """``"mine.py:Mechanism"`` with a path that is valid from any folder; names in the registry are unchanged."""
    file, colon, name = source.partition(".py:")
    if not colon:
        return source
    code = folder / f"{file}.py"
    return f"{_brought(code, out, _copy_name(f'{file}.py'))}:{name}" if code.is_file() else source


def _copy_name(file: str) -> str:
    """Name of a copy; files with equal names in different folders get different names."""
    *folders, own = [part for part in Path(file).parts if part != Path(file).anchor]
    return "_".join(["above" if part == ".." else part for part in folders[-1:]] + [own])


def _brought(file: Path, out: Path | None, name: str) -> str:
    """Path of a file, or of the copy ``name`` in ``out``."""
    if out is None:
        return str(file.resolve())
    try:
        if not (out / name).exists() or not (out / name).samefile(file):
            shutil.copyfile(file, out / name)
    except OSError as error:
        raise unwritten(error, out / name) from None
    return name
