"""Code that documents and notebooks show: it parses, it uses names and arguments that exist, and short scripts run."""

from __future__ import annotations

import ast
import inspect
import re
import shlex
import subprocess
import sys
import typing
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
import typer
from typer.core import TyperGroup
from typer.main import get_command

import rfdropo_bayes as rb
from rfdropo_bayes.cli.main import app

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY / "tools"))

import rooms  # noqa: E402

DOCUMENTS = sorted({*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").rglob("*.md"), *REPOSITORY.glob("*/*/README.md")})
NOTEBOOKS = sorted((REPOSITORY / "notebooks").glob("*.ipynb"))
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PACKAGE = "rfdropo_bayes"
DOOR = "rb"


def blocks() -> list[tuple[str, str]]:
    """Name and code of every Python block of a document, and of every notebook as a whole."""
    found = []
    for document in DOCUMENTS:
        for number, code in enumerate(BLOCK.findall(document.read_text(encoding="utf-8"))):
            found.append((f"{document.relative_to(REPOSITORY)}#{number}", code))
    for path in NOTEBOOKS:
        cells = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
        found.append((path.name, "\n".join(cells)))
    return found


BLOCKS = blocks()
NAMED = pytest.mark.parametrize(("name", "code"), BLOCKS, ids=[name for name, _ in BLOCKS])


def set_by_methods(holder: Any) -> set[str]:
    """Attributes that the methods of a class, other than a built-in one, set on its objects."""
    lineage = [each for each in getattr(holder, "__mro__", ()) if each.__module__ != "builtins"]
    return {name for each in lineage for name in re.findall(r"\bself\.(\w+)\b[^=\n]*=[^=]", inspect.getsource(each))}


class PublicNames(ast.NodeVisitor):
    """Follows what comes out of the front door through a script, and lists what does not exist.

    A variable has the type that the function or class which made it states; others are not looked at.
    """

    def __init__(self) -> None:
        self.types: dict[str, Any] = {}
        self.wrong: list[str] = []
        self.looked_at = 0

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            if alias.name.split(".")[0] == PACKAGE:
                import_module(alias.name)
                self.types.setdefault(alias.asname or alias.name, import_module(alias.name))

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        if (node.module or "").split(".")[0] == PACKAGE:
            module = import_module(str(node.module))
            for alias in node.names:
                self.looked_at += 1
                if not hasattr(module, alias.name):
                    self.wrong.append(f"{node.module} has no {alias.name}")

    def visit_Assign(self, node: ast.Assign) -> None:
        self.generic_visit(node)
        made = self.made_by(node.value)
        for target in node.targets:
            if isinstance(target, ast.Name):
                self.types.pop(target.id, None)
                if made is not None:
                    self.types[target.id] = made

    def visit_Attribute(self, node: ast.Attribute) -> None:
        self.generic_visit(node)
        self.meaning(node)

    def visit_Call(self, node: ast.Call) -> None:
        self.generic_visit(node)
        called = self.meaning(node.func)
        if not callable(called) or any(isinstance(a, ast.Starred) for a in node.args):
            return
        self.looked_at += 1
        try:
            signature = inspect.signature(called)
        except ValueError:
            return
        keywords = {k.arg: None for k in node.keywords if k.arg is not None}
        method = isinstance(node.func, ast.Attribute) and inspect.isfunction(called) and self.is_instance(node.func)
        try:
            signature.bind_partial(*[None] * (len(node.args) + method), **keywords)
        except TypeError as error:
            self.wrong.append(f"{ast.unparse(node.func)}(...): {error}")

    def is_instance(self, node: ast.Attribute) -> bool:
        """Whether a function is reached through an object, which is then its first argument."""
        return isinstance(node.value, ast.Name) and inspect.isclass(self.types.get(node.value.id))

    def made_by(self, node: ast.expr) -> Any:
        """The class of what a call returns, where it is stated and one."""
        if not isinstance(node, ast.Call):
            return None
        called = self.meaning(node.func)
        if inspect.isclass(called):
            return called
        routine = inspect.isfunction(called) or inspect.ismethod(called)
        stated = typing.get_type_hints(called).get("return") if routine else None
        return stated if inspect.isclass(stated) and stated.__module__.startswith(PACKAGE) else None

    def meaning(self, node: ast.expr) -> Any:
        """The object that a dotted name stands for; None where it is not known."""
        if isinstance(node, ast.Name):
            return self.types.get(node.id)
        if not isinstance(node, ast.Attribute):
            return None
        holder = self.meaning(node.value)
        if holder is None:
            return None
        known = {*dir(holder), *getattr(holder, "__annotations__", {}), *set_by_methods(holder)}
        self.looked_at += 1
        if node.attr not in known and f"{ast.unparse(node)} does not exist" not in self.wrong:
            self.wrong.append(f"{ast.unparse(node)} does not exist")
        found = getattr(holder, node.attr, None)
        called = inspect.isfunction(found) or inspect.ismethod(found) or inspect.isclass(found)
        return found if called or inspect.ismodule(found) else None


def looked_through(code: str) -> PublicNames:
    found = PublicNames()
    found.visit(ast.parse(code))
    return found


@NAMED
def test_code_in_documents_and_notebooks_names_what_exists(name: str, code: str) -> None:
    found = looked_through(code)
    assert found.wrong == []
    assert found.looked_at or PACKAGE not in packages(code)


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("rb.calibrat(model, runs)", "rb.calibrat does not exist"),
        ("rb.calibrate(model, runs, methd=1)", "rb.calibrate(...): got an unexpected keyword argument 'methd'"),
        ("rb.SMC(rollout=3)", "rb.SMC(...): got an unexpected keyword argument 'rollout'"),
        ("fit = rb.calibrate(model, runs)\nfit.plot_pairs()", "fit.plot_pairs does not exist"),
        ("fit = rb.calibrate(model, runs)\nfit.plot_pair(axes=1)", "unexpected keyword argument 'axes'"),
        ("rb.Robot.lode('x')", "rb.Robot.lode does not exist"),
        ("from rfdropo_bayes.data import Trajectry", "rfdropo_bayes.data has no Trajectry"),
    ],
)
def test_names_that_do_not_exist_are_found(line: str, wrong: str) -> None:
    (found,) = looked_through(f"import rfdropo_bayes as rb\n{line}").wrong
    assert wrong in found


def test_names_that_exist_are_looked_at() -> None:
    found = looked_through("import rfdropo_bayes as rb\nfit = rb.calibrate(m, r)\nfit.plot_pair(ax=a)\nfit.rmse")
    assert found.wrong == []
    assert found.looked_at >= 5


def packages(code: str) -> Iterator[str]:
    """Modules that a script imports."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield str(node.module)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_import_the_front_door_alone(path: Path) -> None:
    code = dict(BLOCKS)[path.name]
    assert {name for name in packages(code) if name.split(".")[0] == PACKAGE} == {PACKAGE}
    assert f"import {PACKAGE} as {DOOR}" in code


def block(document: str, opening: str) -> str:
    """The Python block of a document that begins with some words."""
    (code,) = [code for name, code in BLOCKS if name.startswith(document) and code.startswith(opening)]
    return code


def test_the_engine_of_a_document_moves(tmp_path: Path) -> None:
    """The whole script of your_simulator.md: a tip that swings to where it is pulled."""
    (tmp_path / "engine.py").write_text(block("docs/your_simulator.md", "# engine.py"), encoding="utf-8")
    script = "import engine; box = engine.arm(stiffness=30.0); print(box.parameters['stiffness'].nominal)"
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, capture_output=True)
    scope: dict[str, Any] = {}
    exec(compile((tmp_path / "engine.py").read_text(), "engine.py", "exec"), scope)
    model = rb.Model(scope["arm"]())
    pulled = {"duration": 1.0, "interval": 0.5, "step": 0.01, "low": 0.0, "high": 0.02, "sample_time": 0.05}
    (run,) = rb.simulate(model, {**pulled, "recordings": ["try"]}, seed=1)
    assert run.marker_names == ("tip",)
    assert np.ptp(run.position[:, 0, 0]) > 1e-3
    np.testing.assert_allclose(run.position[:, 0, 2], 0.3)


@pytest.mark.slow
def test_the_problem_of_a_document_is_inferred() -> None:
    """The scripts of inference.md that follow each other: a line through five points."""
    script = ast.parse(block("docs/inference.md", "import jax\n"))
    last = script.body.pop()
    assert isinstance(last, ast.Expr)
    scope: dict[str, Any] = {}
    exec(compile(script, "inference.md", "exec"), scope)
    draws = eval(compile(ast.Expression(last.value), "inference.md", "eval"), scope)
    time, data = scope["Line"].time, scope["Line"].data
    precision = 1.0 + time @ time / 0.1**2  # of a standard normal prior and noise of 0.1
    assert float(draws.mean()) == pytest.approx(float(time @ data / 0.1**2 / precision), abs=5.0 * precision**-0.5)


WRITTEN = sorted([REPOSITORY / "README.md", *(REPOSITORY / "docs").glob("*.md")])
SHELL = re.compile(
    r"```sh\n(.*?)```|((?:^    (?:rfdropo|python) .*\n)+)|`((?:rfdropo|python) [^`]+)`", re.DOTALL | re.MULTILINE
)
COMMANDS = get_command(app)
(UsageError,) = typer.BadParameter.__bases__


def commands_in(text: str, program: str) -> list[list[str]]:
    """Words of the complete commands of a program in a page: in blocks, and in sentences with an argument."""
    code = "\n".join(match[1] or match[2] or match[3].replace("\n", " ") for match in SHELL.finditer(text))
    lines = re.findall(rf"^ *{program} (.+)$", re.sub(r"\\\n", " ", code), re.MULTILINE)
    found = [shlex.split(line, comments=True) for line in lines]
    return [words for words in found if len(words) > 1 and "..." not in words]


def usage_error(words: list[str]) -> str:
    """What the parser of the command line finds wrong; nothing is run."""
    assert isinstance(COMMANDS, TyperGroup)
    try:
        context = COMMANDS.make_context("rfdropo", words)
        name, command, rest = COMMANDS.resolve_command(context, words)
        assert command is not None
        command.make_context(name, rest, parent=context)
    except UsageError as error:
        return error.format_message()
    return ""


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: page.stem)
def test_commands_of_a_page_are_understood(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    wrong = [(words, said) for words in commands_in(text, "rfdropo") if (said := usage_error(words))]
    assert wrong == []


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: page.stem)
def test_scripts_of_a_page_exist_with_their_options(page: Path) -> None:
    for words in commands_in(page.read_text(encoding="utf-8"), "python"):
        if words[0] == "-m":
            sources = [*(REPOSITORY / "studies").glob("*.py")] if words[1] == "studies" else []
        else:
            sources = [REPOSITORY / words[0]]
        known = set(re.findall(r"[\w-]+", "".join(source.read_text(encoding="utf-8") for source in sources)))
        options = {word.partition("=")[0] for word in words if word.startswith("--")} if sources else set()
        assert not {option for option in options if not known & {option, option[2:].replace("-", "_")}}, words


def test_commands_that_do_not_exist_are_found() -> None:
    assert "No such option" in usage_error(["calibrate", "a.toml", "--ouut", "runs"])
    assert "Missing argument" in usage_error(["check", "--quick"])
    assert usage_error(["calibrat", "a.toml"])
    page = "`rfdropo check`, `rfdropo check a.toml`\n```sh\nrfdropo init a \\\n    --shape cone # note\npip x\n```\n"
    assert commands_in(page, "rfdropo") == [["check", "a.toml"], ["init", "a", "--shape", "cone"]]


def test_the_picture_of_the_rooms_is_drawn_from_the_imports() -> None:
    page = rooms.PAGE.read_text(encoding="utf-8")
    assert page == rooms.drawn(page, rooms.imports()), "run python tools/rooms.py"
    imported = {"a": set(), "b": {"a"}, "c": {"a", "b"}}
    assert rooms.needed(imported)["c"] == {"b"}
    assert rooms.levels(imported) == {"a": 0, "b": 1, "c": 2}


def test_every_page_of_the_site_is_in_its_navigation():
    """A page outside it has no list of neighbours beside it, and is found by links alone."""
    listed = set(re.findall(r": (\S+\.md)$", (REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE))
    moved = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
    outside = {"docs/reference/README.md"}  # a list of the pages beside it
    pages = [*DOCUMENTS, *REPOSITORY.glob("reports/*/details.md"), REPOSITORY / "reports" / "README.md"]
    paths = {path.relative_to(REPOSITORY).as_posix() for path in pages} - outside
    rooms = ("docs/", "reports/", "models/")
    wanted = {moved.get(path, path.removeprefix("docs/")) for path in paths if path in moved or path.startswith(rooms)}
    assert sorted(wanted - listed) == []


@pytest.mark.parametrize("path", sorted(REPOSITORY.glob("reports/*/README.md")), ids=lambda path: path.parent.name)
def test_a_report_answers_its_question_first(path: Path) -> None:
    """Question, answer, one table, caveat and command in at most 60 lines; all else is on a page of details."""
    text = path.read_text(encoding="utf-8")
    order = [text.find(f"**{word}") for word in ("Question", "Answer")]
    assert 0 < order[0] < order[1] < text.find("|---")
    assert re.search(r"`?(rfdropo|python|make|pytest) |tests/", text)
    assert "**Caveat" in text
    assert len(re.findall(r"^\|-", text, re.MULTILINE)) == 1
    assert len(text.splitlines()) <= 60
