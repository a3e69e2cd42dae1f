"""A verdict of several sentences takes a line for each, on the page, in Jupyter and in the terminal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rfdropo_bayes.cli.terminal_summary import show_audit
from rfdropo_bayes.report.sentences import sentences

REPORTS = Path(__file__).resolve().parents[2] / "reports"
SAID = "Lag of 0.05 s (p < 0.001) explains [simulator] u_own. Look at guide No.3 of arm.toml. The time was up."
PARTS = ["Lag of 0.05 s (p < 0.001) explains [simulator] u_own.", "Look at guide No.3 of arm.toml.", "The time was up."]


def test_full_stops_of_numbers_and_names_end_no_sentence() -> None:
    assert sentences(SAID) == PARTS
    assert sentences("") == [""]


@pytest.mark.parametrize("path", sorted(REPORTS.rglob("audit.json")), ids=lambda path: path.parent.name)
def test_sentences_of_audits_are_whole(path: Path) -> None:
    said = json.loads(path.read_text(encoding="utf-8"))["sentence"]
    found = sentences(said)
    assert " ".join(found) == said
    assert all(each[0].isupper() and each.endswith(".") and each.count("(") == each.count(")") for each in found)


def test_the_terminal_begins_a_line_with_each(capsys: pytest.CaptureFixture[str]) -> None:
    found: dict[str, Any] = {"verdict": "explained", "sentence": SAID, "findings": [], "adopted": [], "cautions": []}
    show_audit({**found, "next_experiment": {"sentence": ""}}, Path("audit"), starts=True)
    assert capsys.readouterr().out.splitlines()[:3] == [f"explained: {PARTS[0]}", *PARTS[1:]]
