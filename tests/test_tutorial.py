"""The tutorial's commands, typed in its order on its recordings, give its figures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rfdropo_bayes.cli.main import app
from tests.test_documents import REPOSITORY, commands_in

RECORDED = {"arduino_log.txt": "08-27_20-02-45", "next_day.txt": "08-28_16-44-24"}
VERBS = ["init", "check", "calibrate", "predict", "adapt"]  # an audit takes five minutes more


@pytest.mark.slow
def test_the_tutorial_gives_its_figures(datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four processor minutes. Limits are a fifth above the errors that the page prints."""
    for name, stamp in RECORDED.items():
        shutil.copy(datasets / "deepc_arm" / f"arduino_log_2025-{stamp}.txt", tmp_path / name)
    monkeypatch.chdir(tmp_path)
    typed = commands_in((REPOSITORY / "docs" / "tutorial.md").read_text(encoding="utf-8"), "rfdropo")[: len(VERBS)]
    assert [words[0] for words in typed] == VERBS
    for words in typed:
        assert CliRunner().invoke(app, words, catch_exceptions=False).exit_code == 0, words
    fitted = json.loads(Path("runs/deepc_arm/summary.json").read_text(encoding="utf-8"))
    assert fitted["rmse"]["test"]["tip"] < 1.2 * 0.94
    assert fitted["parameters"]["camera_rotation_z"]["mean"] == pytest.approx(-0.293, abs=0.03)
    today = json.loads(Path("runs/today/summary.json").read_text(encoding="utf-8"))
    assert today["rmse"]["test"]["tip"] < 1.2 * 1.22
    moved = today["parameters"]["initial_displacement_cable_3_deviation@next_day.txt"]
    assert moved["q05"] > 1e-3
