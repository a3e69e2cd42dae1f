"""Draw the rooms of the package from its imports, into docs/architecture.md.

    python tools/rooms.py

A room stands above the rooms that it imports. Imports that follow from others are left out of the picture.
"""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE, PAGE = ROOT / "rfdropo_bayes", ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- rooms: written by tools/rooms.py from the imports -->", "<!-- rooms end -->"
IMPORT = re.compile(r"^\s*(?:from|import) rfdropo_bayes\.(\w+)", re.MULTILINE)


def imports() -> dict[str, set[str]]:
    """Rooms (folders with modules) that each room imports."""
    rooms = {path.name for path in PACKAGE.iterdir() if any(path.glob("*.py"))}
    found = {room: set() for room in rooms}
    for room in rooms:
        for path in (PACKAGE / room).rglob("*.py"):
            found[room] |= set(IMPORT.findall(path.read_text(encoding="utf-8"))) & rooms - {room}
    return found


def needed(imported: dict[str, set[str]]) -> dict[str, set[str]]:
    """Imports that do not follow from others."""

    def below(room: str) -> set[str]:
        return imported[room].union(*map(below, imported[room]))

    return {room: names - set().union(*map(below, names)) for room, names in imported.items()}


def levels(imported: dict[str, set[str]]) -> dict[str, int]:
    """Height of each room: 0 without imports, otherwise above all rooms that it imports."""

    def height(room: str) -> int:
        return 1 + max(map(height, imported[room]), default=-1)

    return {room: height(room) for room in imported}


def picture(imported: dict[str, set[str]]) -> str:
    """A line per room, from the command line down to the rooms without imports."""
    rows, direct = defaultdict(list), needed(imported)
    for room, height in levels(imported).items():
        rows[height].append(room)
    lines: list[str] = []
    for height in sorted(rows, reverse=True):
        for room in sorted(rows[height]):
            arrow = f" -> {', '.join(sorted(direct[room]))}" if direct[room] else ""
            lines.append(f"{height:2d}  {room:12s}{arrow}".rstrip())
    return "\n".join(lines)


def drawn(page: str, imported: dict[str, set[str]]) -> str:
    """A page with the picture between its marks."""
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n```\n{picture(imported)}\n```\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    PAGE.write_text(drawn(PAGE.read_text(encoding="utf-8"), imports()), encoding="utf-8")
