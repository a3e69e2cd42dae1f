"""Keywords that a function passes on, shown in its help, tab completion and errors on typos."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Callable, Collection, Container, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.tables import nearest, parse_table

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

WIDTH = 110
"""Columns of a docstring."""

Called = TypeVar("Called", bound=Callable[..., Any])
Table = TypeVar("Table", bound="BaseModel")


def with_keywords_of(source: Callable[..., Any], *, without: Container[str] = ()) -> Callable[[Called], Called]:
    """Put the keywords of ``source`` into the signature of a function, in the place of its ``**given``.

    Args:
        source: the function or class that the keywords are handed on to.
        without: names of ``source`` that the function does not take.
    """

    def decorate(function: Called) -> Called:
        own = inspect.signature(function)
        kept = [entry for entry in own.parameters.values() if entry.kind is not entry.VAR_KEYWORD]
        taken = {entry.name for entry in kept}
        added = [
            entry.replace(kind=entry.KEYWORD_ONLY)
            for entry in inspect.signature(source).parameters.values()
            if entry.name not in taken and entry.name not in without
        ]
        function.__signature__ = own.replace(parameters=[*kept, *added])  # type: ignore[attr-defined]
        return function

    return decorate


def with_keys_of(schema: type[BaseModel], *, without: Container[str] = ()) -> Callable[[Called], Called]:
    """Put the keys of a table of an experiment file into a function's signature, in the place of its ``**keys``, and
    their meaning behind the arguments in its docstring.

    Args:
        schema: the table that the keywords are handed on to.
        without: keys that the function does not take, or has as named arguments.
    """

    def decorate(function: Called) -> Called:
        own = inspect.signature(function).parameters.values()
        taken = {entry.name for entry in own if entry.kind is not entry.VAR_KEYWORD}
        told = _told(
            {key: field for key, field in schema.model_fields.items() if key not in taken and key not in without}
        )
        head, args, rest = inspect.cleandoc(function.__doc__ or "").partition("Args:\n")
        documented, gap, tail = rest.partition("\n\n")
        function.__doc__ = "\n".join([f"{head}{args}{documented}", *told]) + gap + tail
        return with_keywords_of(schema, without=without)(function)

    return decorate


def as_options(kind: type[Table]) -> type[Table]:
    """Options of a call as a table of an experiment file; keys and values are checked at creation."""

    def init(self: Table, **given: Any) -> None:
        found = parse_table(kind, given, where=kind.__name__)
        super(kind, self).__init__(**found.model_dump(exclude_unset=True))

    kind.__init__ = init  # type: ignore[method-assign, assignment]
    kind.__doc__ = "\n".join([inspect.cleandoc(kind.__doc__ or ""), "", "Attributes:", *_told(kind.model_fields)])
    return kind


def stated(options: Table | None, kind: type[Table]) -> dict[str, Any]:
    """The keys that a call states of its options; none without options.

    Raises:
        InputError: something else was given.
    """
    if options is None:
        return {}
    if not isinstance(options, kind):
        what = f"a {type(options).__name__} is no {kind.__name__}"
        raise InputError(what, where="options", remedy=f"make them with rb.{kind.__name__}(...)")
    return options.model_dump(exclude_unset=True)


def _told(fields: Mapping[str, FieldInfo]) -> list[str]:
    """Each key with its meaning, as a docstring lists arguments."""
    return [
        textwrap.fill(f"{name}: {field.description}.", WIDTH, initial_indent=" " * 4, subsequent_indent=" " * 8)
        for name, field in fields.items()
    ]


def see_keywords(
    given: Collection[str], source: Callable[..., Any], where: str, *, without: Container[str] = ()
) -> None:
    """See that ``source`` can be called with these keywords.

    Raises:
        InputError: a keyword that the function lacks (the message offers the nearest), or missing keywords.
    """
    known = {name: entry for name, entry in inspect.signature(source).parameters.items() if name not in without}
    for name in given:
        if name not in known:
            raise InputError(f"unknown keyword {name!r}", where=where, remedy=nearest(name, known))
    missing = [name for name, entry in known.items() if entry.default is entry.empty and name not in given]
    if missing:
        raise InputError(f"not given: {', '.join(missing)}", where=where, remedy="add them")
