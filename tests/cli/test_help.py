"""What ``--help`` says: every command in one whole sentence, every option in words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import typer

from rfdropo_bayes.cli.main import app


def commands(node: Any = None, name: str = "rfdropo") -> Iterator[tuple[str, Any]]:
    """Every command and group of commands, by what is typed."""
    node = typer.main.get_command(app) if node is None else node
    yield name, node
    for word, below in getattr(node, "commands", {}).items():
        yield from commands(below, f"{name} {word}")


COMMANDS = dict(commands())


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "rfdropo"])
def test_the_list_of_commands_has_a_whole_sentence_of_each(name):
    assert COMMANDS[name].get_short_help_str(60).endswith(".")
    assert not COMMANDS[name].get_short_help_str(60).endswith("...")


def test_the_list_of_commands_begins_with_the_way_from_a_recording_to_a_prediction():
    """A newcomer reads the list from the top: init and check before calibrate, audit and predict."""
    names = list(typer.main.get_command(app).commands)
    steps = [names.index(name) for name in ("init", "check", "calibrate", "audit", "predict", "train", "deploy")]
    assert steps == sorted(steps)
    assert names[0] == "init"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_described_and_none_shows_a_type_of_python(name):
    node = COMMANDS[name]
    context = node.make_context(name, [], resilient_parsing=True)
    for parameter in node.get_params(context):
        shown = parameter.get_help_record(context)
        assert shown is not None, parameter.name
        assert "list[" not in shown[0] or not shown[0].startswith("--")
        assert "--no-" not in shown[0] or parameter.name == "pairs"
        assert shown[1].strip() not in ("", "[required]")


def test_an_option_of_time_names_its_unit():
    (found,) = (each for each in COMMANDS["rfdropo adapt"].params if each.name == "seconds")
    assert "seconds" in found.help
