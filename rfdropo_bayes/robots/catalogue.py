"""Robot files by name: bundled robots, or any path."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots.sections import body_tables
from rfdropo_bayes.tables import read_toml

PACKAGE = Path(__file__).resolve().parents[1]
FOLDERS = (PACKAGE / "models" / "robots", PACKAGE.parent / "models" / "robots")
"""Folders of robot files: inside an installed package, and beside it in a clone."""


def known_robots() -> dict[str, Path]:
    """The robots that come with the package: name -> file."""
    return {path.stem: path for folder in reversed(FOLDERS) for path in sorted(folder.glob("*.toml"))}


def robot_tables(path: Path) -> dict[str, Any]:
    """Tables of a robot file, merged with its base robots, and its body as a section profile.

    Raises:
        InputError: an unreadable file, an unknown base, or shapes that make no body.
    """
    tables = _read(path)
    if isinstance(tables.get("body"), dict):
        tables["body"] = body_tables(tables["body"], str(path))
    return tables


def _read(path: Path, derived: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Tables of a robot file; its own tables replace the tables of its ``base``."""
    try:
        table = read_toml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {error}", where=str(path), remedy="give a readable TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not valid TOML: {error}", where=str(path), remedy="correct the file") from None
    if "base" not in table:
        return table
    if path in derived:
        raise InputError("is its own base", where=str(path), remedy="name another robot as base, or none")
    return _read(find_robot_file(str(table.pop("base"))), (*derived, path)) | table


def find_robot_file(name_or_path: str | Path) -> Path:
    """The file of a robot that comes with the package, or the path itself.

    Raises:
        InputError: neither the name of a robot nor the path of a file.
    """
    known = known_robots()
    if str(name_or_path) in known:
        return known[str(name_or_path)]
    path = Path(name_or_path)
    if path.suffix == ".toml" and path.is_file():
        return path
    if path.suffix == ".toml":
        beside = [file.name for file in path.parent.glob("*.toml")]
        near = difflib.get_close_matches(path.name, beside, n=1)
        raise InputError(
            "no such robot file",
            where=str(path),
            remedy=(f"did you mean {near[0]!r}? " if near else "")
            + "correct the path; it counts from the experiment file",
        )
    close = difflib.get_close_matches(str(name_or_path), list(known), n=1)
    raise InputError(
        f"unknown robot {str(name_or_path)!r}",
        remedy=(f"did you mean {close[0]!r}? " if close else "")
        + f"known: {', '.join(sorted(known)) or 'none'}; or give the path of a .toml file",
    )
