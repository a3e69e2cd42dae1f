"""Tables of TOML files as validated objects, with errors a user can act on."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from rfdropo_bayes.errors import InputError

Parsed = TypeVar("Parsed", bound=BaseModel)


def parse_table(schema: type[Parsed], table: Mapping[str, Any], *, where: str) -> Parsed:
    """Validate a table.

    Raises:
        InputError: the first thing that is wrong: its key, what was expected, and the nearest valid key if the key is
            unknown.
    """
    try:
        return schema.model_validate(dict(table))
    except ValidationError as error:
        # A renamed key is both unknown and missing: its own name says more.
        first = min(error.errors(include_url=False), key=lambda found: found["type"] != "extra_forbidden")
        inner = first.get("ctx", {}).get("error")
        if isinstance(inner, InputError):
            raise inner from None
        path = [str(part) for part in first["loc"]]
        if first["type"] == "extra_forbidden":
            known = sorted(_fields_at(schema, path[:-1]))
            close = difflib.get_close_matches(path[-1], known, n=1)
            remedy = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
            raise InputError(f"unknown key {'.'.join(path)!r}", where=where, remedy=remedy) from None
        if first["type"] == "missing":
            raise InputError(f"the key {'.'.join(path)!r} is missing", where=where, remedy="add it") from None
        message = first["msg"].removeprefix("Value error, ")
        # A whole table or list would fill the screen; its name says enough.
        given = f" = {first['input']!r}" if isinstance(first["input"], str | int | float | bool) else ""
        raise InputError(f"{'.'.join(path)}{given}: {message}", where=where, remedy="mend the value") from None


def _fields_at(schema: type[BaseModel], path: list[str]) -> set[str]:
    """Names of the fields of the model found by following ``path`` from ``schema``."""
    for part in path:
        field = schema.model_fields.get(part)
        if field is None:
            continue
        candidates = [field.annotation, *getattr(field.annotation, "__args__", ())]
        models = [item for item in candidates if isinstance(item, type) and issubclass(item, BaseModel)]
        if models:
            schema = models[0]
    return set(schema.model_fields)
