"""Options of a method of inference, with a table of their meanings for display."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
from collections.abc import Mapping
from typing import Any, ClassVar

from rfdropo_bayes.tables import plain

_ENTRY = re.compile(r" {4}([a-z0-9_]+(?:, [a-z0-9_]+)*): (.*)")
_WIDTH = 110


class MethodOptions:
    """Base of the options of every method: frozen dataclasses with a section "Attributes" in their docstring."""

    called: ClassVar[str]  # name of the class in ``import rfdropo_bayes as rb``

    def __init_subclass__(cls, *, called: str) -> None:
        cls.called = called

    @property
    def call(self) -> str:
        """The call that makes these options, with all values that differ from the defaults."""
        own: Any = self
        given = {field.name: getattr(self, field.name) for field in dataclasses.fields(own)}
        changed = (
            f"{field.name}={_written(given[field.name])}"
            for field in dataclasses.fields(own)
            if given[field.name] != _default(field)
        )
        return f"rb.{self.called}({', '.join(changed)})"

    def __repr__(self) -> str:
        own: Any = self
        told = attributes_of(type(self))
        rows = [(field.name, _written(getattr(self, field.name))) for field in dataclasses.fields(own)]
        wide, long = (max(len(row[column]) for row in rows) for column in (0, 1))
        head = " ".join(inspect.cleandoc(self.__doc__ or "").partition("\n\n")[0].split())
        hanging = " " * (wide + long + 6)
        lines = [
            textwrap.fill(
                told[name], _WIDTH, initial_indent=f"  {name:{wide}}  {value:{long}}  ", subsequent_indent=hanging
            )
            for name, value in rows
        ]
        return "\n".join([self.call, head, *lines])


def options_table(options: Any) -> dict[str, Any]:
    """Options as a table of an experiment file: TOML has no word for None, so that such options are left out."""
    return _entry({field.name: getattr(options, field.name) for field in dataclasses.fields(options)})


def _entry(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _entry(each) for name, each in value.items() if each is not None}
    return [_entry(each) for each in value] if isinstance(value, list | tuple) else value


def attributes_of(kind: type) -> dict[str, str]:
    """Text on each name in the section "Attributes" of a docstring; ``a, b: text`` describes both."""
    _, _, section = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")
    texts: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines():
        entry = _ENTRY.match(line)
        if entry:
            names = entry[1].split(", ")
            texts |= dict.fromkeys(names, entry[2])
        elif line.startswith(" " * 8):
            texts |= {name: f"{texts[name]} {line.strip()}" for name in names}
    return texts


def settings_text(value: Any) -> str:
    """Options as the digest of a run has them: every field by name, in words that checkpoints of all versions share."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return repr(plain(value))
    fields = ", ".join(
        f"{field.name}={settings_text(getattr(value, field.name))}" for field in dataclasses.fields(value)
    )
    return f"{type(value).__qualname__}({fields})"


def _default(field: dataclasses.Field[Any]) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _written(value: Any) -> str:
    """A value in a few characters."""
    return f"{value:.12g}" if isinstance(value, float) else repr(value)
