"""Tables of TOML files as validated objects, with errors a user can act on."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypeVar, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ValidationError

from rfdropo_bayes.errors import InputError

Parsed = TypeVar("Parsed", bound=BaseModel)


def nearest(name: str, known: Iterable[str]) -> str:
    """A remedy for a mistyped name: the closest known name, or the list of all names."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"


def read_toml(text: str) -> dict[str, Any]:
    """Tables of a TOML text.

    Raises:
        tomllib.TOMLDecodeError: the text is not TOML; the message has a remedy for Windows paths.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        place = re.search(r"line (\d+)", str(error))
        line = text.splitlines()[int(place[1]) - 1] if place else ""
        if '"' not in line or "\\" not in line:
            raise
        said = f"{error}: in double quotes a backslash begins a sign of its own; write paths with / or in single quotes"
        raise tomllib.TOMLDecodeError(said) from None


def plain(value: Any) -> Any:
    """A value as TOML and JSON write it: NumPy's numbers become Python's, in tables and lists as well."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if type(value) in (list, tuple):
        return type(value)(plain(entry) for entry in value)
    return value


def parse_table(schema: type[Parsed], table: Mapping[str, Any], *, where: str) -> Parsed:
    """Validate a table.

    Raises:
        InputError: for the first fault: its key, the expected value, and the nearest valid key if the key is unknown.
    """
    try:
        return schema.model_validate(plain(dict(table)))
    except ValidationError as error:
        # A renamed key is both unknown and missing: its own name says more.
        first = min(error.errors(include_url=False), key=lambda found: found["type"] != "extra_forbidden")
        inner = first.get("ctx", {}).get("error")
        if isinstance(inner, InputError):
            raise inner from None
        path, here = _follow(schema, first["loc"])
        if first["type"] == "extra_forbidden":
            known = sorted({name for table in here for name in table.model_fields})
            raise InputError(f"unknown key {'.'.join(path)!r}", where=where, remedy=nearest(path[-1], known)) from None
        if first["type"] == "missing":
            raise InputError(f"the key {'.'.join(path)!r} is missing", where=where, remedy="add it") from None
        message = first["msg"].removeprefix("Value error, ")
        # A whole table or list would fill the screen; its name says enough.
        given = f" = {first['input']!r}" if isinstance(first["input"], str | int | float | bool) else ""
        # An error of the whole file has no key, and its message has the remedy.
        what, remedy = (f"{'.'.join(path)}{given}: {message}", "correct the value") if path else (message, "")
        raise InputError(what, where=where, remedy=remedy) from None


def changed(table: Parsed, *, where: str, **values: Any) -> Parsed:
    """The same table with other values of some keys, validated as if it had been read with them.

    Raises:
        InputError: as `parse_table`.
    """
    given = {name: value for name, value in table if name in table.model_fields_set}
    return parse_table(type(table), {**given, **values}, where=where)


def parse_assignment(assignment: str) -> tuple[list[str], Any]:
    """Keys and value of ``table.key=value``; a bare word is a string, so that names need no quotes on a command line.

    Raises:
        InputError: the table has another form.
    """
    name, equals, text = assignment.partition("=")
    keys = [key.strip() for key in name.split(".")]
    if not equals or not all(keys):
        raise InputError(f"{assignment!r} is not of the form name=value", where="--set", remedy="e.g. --set seed=1")
    try:
        return keys, tomllib.loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return keys, text.strip()


def set_entry(tables: dict[str, Any], keys: Sequence[str], value: Any) -> None:
    """Set an entry of nested tables in place; tables on the way to it are made.

    Raises:
        InputError: a key on the way holds something else than a table.
    """
    table: Any = tables
    for key in keys[:-1]:
        table = table.setdefault(key, {})
        if not isinstance(table, dict):
            raise InputError(f"{key!r} in {'.'.join(keys)!r} is not a table", where="--set", remedy="check the key")
    table[keys[-1]] = value


def _follow(schema: type[BaseModel], location: Sequence[str | int]) -> tuple[list[str], list[type[BaseModel]]]:
    """User's name of a location from pydantic, and the tables allowed there.

    Pydantic puts the tag of a union, such as a shape's name, between the keys; the file has no such key.
    """
    path: list[str] = []
    here: list[type[BaseModel]] = [schema]
    for part in location:
        tagged = [table for table in here if _tag(table) == part]
        if len(here) > 1 and tagged:
            here = tagged
            continue
        path.append(str(part))
        fields = [table.model_fields[str(part)] for table in here if part in table.model_fields]
        if fields:
            here = [table for field in fields for table in _tables_in(field.annotation)] or here
    return path, here


def _tag(table: type[BaseModel]) -> Any:
    """The only allowed value of a table's first field, if it has only one."""
    first = next(iter(table.model_fields.values()), None)
    choices = get_args(first.annotation) if first is not None and get_origin(first.annotation) is Literal else ()
    return choices[0] if len(choices) == 1 else None


def _tables_in(annotation: Any) -> list[type[BaseModel]]:
    """The tables that an annotation such as ``tuple[A | B, ...]`` mentions."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in get_args(annotation) for table in _tables_in(part)]
