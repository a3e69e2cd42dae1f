"""The house rules that a machine can check: who imports whom, and how long a module or a function may be."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "rfdropo_bayes"

# Modules at the bottom, open to every room.
FOUNDATION = {"cautions", "errors", "files", "groups", "interrupts", "runtime", "signatures", "tables"}

# In the order of docs/architecture.md, which says why: a room imports from rooms above it, of these from those
# named here; from the foundation and the standard library, too.
MAY_IMPORT: dict[str, set[str]] = {
    "data": set(),
    "posteriors": set(),
    "robots": set(),
    "fem": set(),
    "simulators": {"robots", "fem"},
    "mechanisms": {"robots", "fem", "simulators"},
    "bayes": {"data", "posteriors", "robots", "simulators", "mechanisms"},
    "inference": {"posteriors", "bayes"},
    "discrepancy": {"data", "posteriors", "simulators", "mechanisms", "bayes", "inference"},
    "prediction": {"data", "posteriors", "simulators", "bayes", "inference"},
    "report": {"data", "posteriors", "bayes", "inference", "discrepancy"},
    "policies": {"posteriors", "robots", "simulators", "mechanisms", "inference", "report"},
    "deployment": {"data", "robots"},
}
MAY_IMPORT["model"] = set(MAY_IMPORT)
MAY_IMPORT["results"] = set(MAY_IMPORT)
MAY_IMPORT["verbs"] = set(MAY_IMPORT)
MAY_IMPORT["cli"] = set(MAY_IMPORT)
MAY_IMPORT["__main__"] = {"cli"}
MAY_IMPORT["__init__"] = set(MAY_IMPORT)  # the front door: for type checkers alone

WITHOUT_JAX = {"data", "posteriors", "robots", "deployment"}  # read recordings and drive motors on a small computer
JAX_FAMILY = {"jax", "jaxlib", "numpyro", "blackjax"}

MODULE_LINES = 700
FUNCTION_LINES = 120  # a page and a half
NAMELESS = re.compile(r"(^|_)(utils?|utilities|helpers?|managers?|magic|misc|common|stuff)(_|$)")

MODULES = sorted(PACKAGE.rglob("*.py"))


def relative(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def room_of(path: Path) -> str:
    """First part of a module's path inside the package: a room, or a module of the foundation."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imported_modules(source: str, package: list[str]) -> set[str]:
    """Dotted names a module imports, wherever the statement stands; relative imports are resolved in ``package``."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            if origin == "rfdropo_bayes":  # `from rfdropo_bayes import fem` imports the room fem
                names.update(f"{origin}.{alias.name}" for alias in node.names)
            else:
                names.add(origin)
    return names


@functools.cache
def imports_of(path: Path) -> set[str]:
    package = ["rfdropo_bayes", *path.relative_to(PACKAGE).parts[:-1]]
    return imported_modules(path.read_text(), package)


def forbidden_rooms(room: str, imported: set[str]) -> set[str]:
    """Rooms among the imported modules that ``room`` may not know."""
    rooms = {name.split(".")[1] for name in imported if name.startswith("rfdropo_bayes.")}
    return rooms - MAY_IMPORT.get(room, set()) - FOUNDATION - {room, "__version__"}


def test_rooms_import_from_rooms_above_them_in_the_table_only() -> None:
    """Every room's permissions are rooms listed above it, so the imports cannot form a circle."""
    seen: set[str] = set()
    for room, allowed in MAY_IMPORT.items():
        assert allowed <= seen, f"{room} may import {sorted(allowed - seen)}, which stand below it"
        seen.add(room)


def test_every_room_is_in_the_table() -> None:
    known = set(MAY_IMPORT) | FOUNDATION
    assert {room_of(path) for path in MODULES} <= known


def test_the_parser_sees_every_way_to_import() -> None:
    source = (
        "import rfdropo_bayes.fem.layered\nfrom rfdropo_bayes import discrepancy\nfrom . import cables\n"
        "from ..data import Trajectory\nfrom .. import report\ndef late():\n    from rfdropo_bayes.cli import main\n"
    )
    imported = imported_modules(source, ["rfdropo_bayes", "robots"])
    assert forbidden_rooms("robots", imported) == {"fem", "discrepancy", "data", "report", "cli"}


def test_imports_come_from_above() -> None:
    below = {
        relative(path): forbidden_rooms(room_of(path), imports_of(path))
        for path in MODULES
        if room_of(path) != "__init__"  # the front door names what stands in every room
    }
    wrong = {name: sorted(rooms) for name, rooms in below.items() if rooms}
    assert not wrong, f"imports from rooms below; see the table in docs/architecture.md: {wrong}"


def test_rooms_that_touch_hardware_and_files_do_not_import_jax() -> None:
    wrong = [
        relative(path)
        for path in MODULES
        if room_of(path) in WITHOUT_JAX and {name.split(".")[0] for name in imports_of(path)} & JAX_FAMILY
    ]
    assert not wrong


def test_nothing_they_import_loads_jax() -> None:
    rooms = sorted(WITHOUT_JAX & {room_of(path) for path in MODULES})
    loads = "; ".join(f"import rfdropo_bayes.{room}; 'jax' in sys.modules and sys.exit('{room}')" for room in rooms)
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {loads}"], cwd=REPOSITORY, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, f"loads JAX, or cannot be imported: {done.stderr}"


def test_one_room_knows_arviz() -> None:
    """ArviZ is being rewritten: what depends on its version stays behind `posteriors`."""
    others = [path for path in MODULES if room_of(path) != "posteriors"]
    assert not [relative(path) for path in others if "arviz" in {name.split(".")[0] for name in imports_of(path)}]


def too_long(path: Path) -> list[str]:
    """What is longer in a module than the rules allow."""
    text, name = path.read_text(), relative(path)
    length = text.count("\n")
    found = [f"{name}: {length} lines"] if length > MODULE_LINES else []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > FUNCTION_LINES:
                found.append(f"{name}:{node.name}: {lines} lines")
    return found


def test_modules_and_functions_are_as_long_as_their_story_and_no_longer() -> None:
    assert not [line for path in MODULES for line in too_long(path)]


def test_module_names_are_nouns_of_the_field() -> None:
    nameless = [
        relative(path)
        for path in MODULES
        if any(NAMELESS.search(part) for part in path.relative_to(PACKAGE).with_suffix("").parts)
    ]
    assert not nameless, "name each after what it holds"
