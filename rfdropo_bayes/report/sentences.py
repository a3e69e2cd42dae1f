"""Verdicts of several sentences, for a line each."""

from __future__ import annotations

import re

END = re.compile(r"(?<=[^\s.]\.)\s+(?=[A-Z])")


def sentences(text: str) -> list[str]:
    """The sentences of a verdict; a full stop inside a number or a name does not end a sentence."""
    return END.split(text)
