"""Every command that a document or the head of an experiment shows is one that the command line takes."""

from __future__ import annotations

import functools
import re
import shlex
import subprocess
from pathlib import Path

import pytest
import typer

from rfdropo_bayes.cli.main import app
from rfdropo_bayes.cli.options import experiment_name

ROOT = Path(__file__).resolve().parents[2]
# A line of its own, in a block or a comment; or a command in running words.
LINE = re.compile(r"^(?:[#\s]*|.*: )(?:\.venv/bin/)?(rfdropo +[a-z][^`]*)$")
INLINE = re.compile(r"`(rfdropo [a-z][^`]*)`")
PLACEHOLDER = re.compile(r"\b[A-Z]\b")  # of a number


def commands() -> list[tuple[str, str, bool]]:
    """Commands, the files that show them, and whether in running words, which may leave arguments out.

    A backslash joins lines, a shell's variable stands for its value.
    """
    listed = subprocess.run(["git", "ls-files", "*.md", "*.toml"], cwd=ROOT, capture_output=True, text=True, check=True)
    found = []
    for name in listed.stdout.split():
        if name.startswith(("docs/reference/", "tests/")) or name == "CHANGELOG.md":
            continue
        text = re.sub(r"\\\n[#\s]*", " ", (ROOT / name).read_text(encoding="utf-8"))
        values = dict(re.findall(r'^([A-Z]+)="(.*)"$', text, re.MULTILINE))
        for line in text.splitlines():
            whole = LINE.match(line)
            for command in [whole[1]] if whole else INLINE.findall(line):
                for variable, value in values.items():
                    command = command.replace(f"${variable}", value)
                found.append((name, PLACEHOLDER.sub("1", command.replace(" ...", "")), not whole))
    return found


COMMANDS = commands()


@functools.cache
def parsed(command: str) -> tuple[str, dict]:
    """The command's name and its options, as the command line understands them."""
    words, group = shlex.split(command, comments=True)[1:], typer.main.get_command(app)
    name, node, rest = group.resolve_command(group.make_context("rfdropo", [], resilient_parsing=True), words)
    if hasattr(node, "resolve_command"):
        name, node, rest = node.resolve_command(node.make_context(name, [], resilient_parsing=True), rest)
    return node.name or "", node.make_context(name, rest).params


@pytest.mark.parametrize(("document", "command", "words"), COMMANDS, ids=[f"{d}: {c}" for d, c, _ in COMMANDS])
def test_what_a_document_shows_can_be_run(document, command, words):
    try:
        _, options = parsed(command)
    except typer.BadParameter as error:
        if not words or type(error).__name__ != "MissingParameter":
            raise
        return
    experiment = str(options.get("experiment"))
    assert not experiment.startswith(("experiments/", "benchmarks/")) or (ROOT / experiment).is_file()


def test_no_two_documented_runs_share_a_folder():
    """Of calibrations and audits in reports/ and runs/, each with the experiment and groups that it is of."""
    runs: dict[str, set] = {}
    for _, command, words in COMMANDS:
        name, options = parsed(command) if not words else ("", {})
        if name not in ("calibrate", "audit"):
            continue
        stem = Path(options["experiment"]).stem
        title = experiment_name(Path(options["experiment"]))
        folder = options["out"] or Path("runs") / (title if name == "calibrate" else f"{title}_{name}")
        runs.setdefault(str(folder), set()).add((name, stem, tuple(options.get("between") or ())))
    assert {
        folder: found for folder, found in runs.items() if len(found) > 1 and folder.startswith(("reports/", "runs/"))
    } == {}
