"""Count the definitions that a reader opens on the way from a question to its answer.

A walk starts at a function and follows its calls within the rooms of the question; a call into another room is one hop
and is not followed. A method counts if one class alone has its name, in a module that the caller's module imports,
directly or through others; methods of libraries, arrays and Python's own types do not. ``--list`` prints every hop.
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

PACKAGE = Path(__file__).resolve().parents[1] / "rfdropo_bayes"
WALKS = {  # question: its start, the rooms or modules that are followed, and the most hops
    "audit, from a problem to a verdict": ("discrepancy.pipeline", "audit", ("discrepancy",), 60),
    "predict, from a fit to bands": ("verbs.predict", "predict", ("verbs.predict", "prediction"), 40),
}
Place = tuple[str, str]
COMMON = {name for kind in (np.ndarray, str, dict, list, set, Path) for name in dir(kind)}


class Package:
    """The definitions of the package and what each calls."""

    def __init__(self) -> None:
        self.nodes: dict[Place, ast.AST] = {}
        self.names: dict[str, dict[str, Place]] = {}
        self.methods: defaultdict[str, list[Place]] = defaultdict(list)
        self.imports: defaultdict[str, set[str]] = defaultdict(set)
        self.libraries: defaultdict[str, set[str]] = defaultdict(set)
        for path in PACKAGE.rglob("*.py"):
            module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
            self._read(module, ast.parse(path.read_text()))

    def _read(self, module: str, tree: ast.Module) -> None:
        names = self.names[module] = {}
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names[node.name] = (module, node.name)
                self.nodes[module, node.name] = node
            for member in node.body if isinstance(node, ast.ClassDef) else []:
                if isinstance(member, ast.FunctionDef) and not member.name.startswith("__"):
                    place = (module, f"{node.name}.{member.name}")
                    self.nodes[place] = member
                    self.methods[member.name].append(place)
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                self.libraries[module] |= {alias.asname or alias.name for alias in node.names}
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rfdropo_bayes."):
                source = str(node.module).removeprefix("rfdropo_bayes.")
                names |= {alias.asname or alias.name: (source, alias.name) for alias in node.names}
                self.imports[module] |= {
                    source,
                    f"{source}.__init__",
                    *(f"{source}.{alias.name}" for alias in node.names),
                }

    def reached(self, module: str) -> set[str]:
        """Modules that a module imports, directly or through others, and itself."""
        found, waiting = {module}, [module]
        while waiting:
            new = self.imports[waiting.pop()] - found
            found |= new
            waiting += new
        return found

    def called(self, place: Place) -> set[Place]:
        """Places that a definition calls or uses; of a class its constructor alone."""
        node, found, reached = self.nodes[place], set[Place](), self.reached(place[0])
        for part in ast.walk(node) if isinstance(node, ast.FunctionDef) else []:
            if isinstance(part, ast.Name) and part.id in self.names[place[0]]:
                found.add(self.names[place[0]][part.id])
            elif isinstance(part, ast.Attribute) and len(self.methods[part.attr]) == 1:
                of_library = isinstance(part.value, ast.Name) and part.value.id in self.libraries[place[0]]
                if not of_library and part.attr not in COMMON:
                    found |= {each for each in self.methods[part.attr] if each[0] in reached}
        return {each for each in found if each in self.nodes and each != place}


def walk(package: Package, start: Place, rooms: tuple[str, ...]) -> list[Place]:
    """Every definition on the way, in the order in which a reader meets it."""
    waiting, met = [start], [start]
    while waiting:
        for place in sorted(package.called(waiting.pop(0)) - set(met)):
            met.append(place)
            if any(place[0] == room or place[0].startswith(f"{room}.") for room in rooms):
                waiting.append(place)
    return met


if __name__ == "__main__":
    package = Package()
    for question, (module, function, rooms, most) in WALKS.items():
        met = walk(package, (module, function), rooms)
        print(f"{question}: {len(met)} hops in {len({place for place, _ in met})} modules (at most {most} asked)")
        for place in sorted(met) if "--list" in sys.argv else []:
            print(f"  {'.'.join(place)}")
