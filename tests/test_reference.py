"""docs/reference is what the code says, and complete."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from pydantic import BaseModel

from rfdropo_bayes.deployment.settings import Deployment
from rfdropo_bayes.inference.methods import METHODS
from rfdropo_bayes.mechanisms.registry import REGISTRY
from rfdropo_bayes.model.experiment import Experiment
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.sections import SHAPES, SectionedBody
from tests.scripts import script

REPOSITORY = Path(__file__).resolve().parents[1]
reference = script("tools/reference.py")

PAGES = reference.pages()
ROOTS = (Experiment, Robot, Deployment, SectionedBody, *SHAPES)
TABLES = {schema for root in ROOTS for _, schema in reference.tables_of(root, "")}


@pytest.mark.parametrize("name", sorted(PAGES))
def test_a_page_is_what_the_code_says(name):
    written = (REPOSITORY / "docs" / "reference" / name).read_text(encoding="utf-8")
    assert written == PAGES[name], "run python tools/reference.py"


@pytest.mark.parametrize("schema", sorted(TABLES, key=lambda table: table.__name__), ids=lambda table: table.__name__)
def test_every_key_says_what_it_means(schema: type[BaseModel]):
    silent = [name for name in schema.model_fields if not reference.meaning_of(schema, name)]
    assert not silent, f"{schema.__name__}: {silent} have no description"


@pytest.mark.parametrize("name", sorted(METHODS))
def test_every_option_of_a_method_is_told(name):
    config = METHODS[name].config
    fields = {field.name for field in dataclasses.fields(config)}
    assert set(reference.attributes_of(config)) == fields
    assert all(f"| `{field}` |" in PAGES["methods.md"] for field in fields)


def test_every_mechanism_and_parameter_is_there():
    for name in REGISTRY:
        facts, parameters = reference.mechanism_facts(name)
        assert f"### {name}\n" in PAGES["mechanisms.md"]
        assert facts["cause"] in PAGES["mechanisms.md"]
        for row in parameters:
            assert f"| `{row['parameter']}` | {row['unit']} |" in PAGES["mechanisms.md"]


def test_every_command_and_option_says_what_it_does():
    root = reference.typer.main.get_command(reference.app)
    for name, command in reference.walk(root, "rfdropo"):
        assert command.help, name
        silent = [p.name for p in command.params if not p.help and "--help" not in p.opts]
        assert not silent, f"{name}: {silent}"
