"""Files: found beside recordings, and written completely or not at all."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.tables import plain

DATA_VARIABLE = "RFDROPO_DATA"
_GLOB = "*?["


def find_files(pattern: str, base: Path, *, folders: bool = False) -> list[Path]:
    """Files of a name or pattern in the first folder that has any: RFDROPO_DATA, or else ``base``.

    Existing names, and existing folders at the start of a pattern, are literal, even with a pattern's signs in them.

    Args:
        pattern: the name or glob.
        base: folder to which ``path`` is relative.
        folders: whether a folder may replace the files in it.

    Raises:
        InputError: no such file.
    """
    variable = os.environ.get(DATA_VARIABLE)
    roots = [Path(variable), Path(base)] if variable else [Path(base)]
    wanted = Path(pattern)
    if wanted.is_absolute():
        roots, wanted = [Path(wanted.anchor)], wanted.relative_to(wanted.anchor)
    for root in roots:
        if (root / wanted).is_file() or (folders and (root / wanted).is_dir()):
            return [root / wanted]
    for root in roots:
        files = matching_files(root, wanted)
        found = [file for file in files if file.is_file() or (folders and file.is_dir())]
        if found:
            return found
        if files and files[0].is_dir():
            remedy = f'name its files, e.g. "{pattern.rstrip("/")}/*.csv"'
            raise InputError("is a folder, not a file", where=pattern, remedy=remedy)
    looked = " and ".join(str(root) for root in roots)
    raise InputError(
        f"no such file; looked in {looked} ({DATA_VARIABLE} is {'set' if variable else 'not set'})",
        where=pattern,
        remedy=f"correct the path, or set {DATA_VARIABLE} to the folder that holds the data",
    )


def matching_files(root: Path, wanted: Path) -> list[Path]:
    """Files and folders of a pattern below ``root``, in order; existing parts are literal."""
    parts = list(wanted.parts)
    while parts and (root / parts[0]).exists():
        root /= parts.pop(0)
    if not parts:
        return [root]
    rest = str(Path(*parts))
    return sorted(root.glob(rest)) if any(sign in rest for sign in _GLOB) else []


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A name to write to, which becomes ``path`` once the block has succeeded; else nothing is left of it.

    Raises:
        InputError: the file cannot be written, e.g. because the disk is full.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise unwritten(error, path) from None
    finally:
        with suppress(OSError):
            partial.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    with whole(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Any, *, finite: bool = False) -> None:
    """Write plain values as a JSON file, completely or not at all; with ``finite``, NaN is an error.

    Raises:
        InputError: the file cannot be written.
    """
    write_text(path, json.dumps(plain(content), indent=2, ensure_ascii=False, allow_nan=not finite) + "\n")


def append_line(path: Path, line: str) -> None:
    """Add a line to a file of JSON lines, and make its folder. An incomplete last line of a killed program is removed
    first.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b") as file:
            _end_last_line(file)
            file.write(f"{line}\n".encode())
    except OSError as error:
        raise unwritten(error, path) from None


def _end_last_line(file: BinaryIO) -> None:
    """Remove an incomplete last line of a file of JSON lines, and add a missing newline."""
    size = file.seek(0, os.SEEK_END)
    if size == 0:  # or a device, which ends nowhere
        return
    file.seek(size - 1)
    if file.read(1) == b"\n":
        return
    file.seek(0)
    content = file.read()
    start = content.rfind(b"\n") + 1
    try:
        json.loads(content[start:])
    except ValueError:
        file.truncate(start)
    else:
        file.write(b"\n")


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The JSON object of each line of a file, up to the first incomplete line; empty without a file."""
    found = []
    for line in path.read_bytes().splitlines() if path.exists() else []:
        try:
            found.append(json.loads(line))
        except ValueError:
            break
    return found


def output_folder(path: Path) -> Path:
    """Make a folder; InputError if it cannot be made or written to."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot make the output folder: {error.strerror}", where=str(path), remedy="choose another with --out"
        ) from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError("the output folder is not writable", where=str(path), remedy="choose another with --out")
    return path


def unwritten(error: OSError, path: Path) -> InputError:
    """The error of the operating system with a remedy."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return InputError(
        f"cannot be written ({error.strerror or error})",
        where=str(path),
        remedy="make room on the disk" if full else "choose a writable folder",
    )
