"""``rfdropo report`` of a folder: a page that is drawn again, or where the results are and what can be done."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from rfdropo_bayes.cli import main
from rfdropo_bayes.model.run_folder import COMMANDS, DONE, FAILED, PAGE, RUN


def folder_of(tmp_path: Path, command: str, *files: str, status: str | None = DONE) -> Path:
    """A folder as a run leaves it; ``status`` None stands for a run of a version without run.json."""
    out = tmp_path / "my run"
    out.mkdir()
    for name in files:
        (out / name).write_text("{}")
    if status is not None:
        (out / RUN).write_text(json.dumps({"command": command, "settings": {}, "status": status}))
    return out


def run(arguments: list[str], monkeypatch, capsys) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["rfdropo", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    shown = capsys.readouterr()
    return int(stopped.value.code or 0), shown.out, shown.err


@pytest.mark.parametrize("command", ["audit", "train"])
def test_a_page_that_its_run_alone_can_draw_is_named(command, tmp_path, monkeypatch, capsys):
    out = folder_of(tmp_path, command, *COMMANDS[command].results)
    before = (out / PAGE).stat().st_mtime_ns
    status, said, _ = run(["report", str(out)], monkeypatch, capsys)
    assert status == 0
    assert said.splitlines()[-1] == f"report: {out / PAGE}"
    assert (out / PAGE).stat().st_mtime_ns == before


def test_a_page_that_is_gone_is_an_error_with_the_command_to_run(tmp_path, monkeypatch, capsys):
    out = folder_of(tmp_path, "audit", "audit.json", "extended.toml", "config.toml")
    status, _, error = run(["report", str(out)], monkeypatch, capsys)
    assert status == 2
    assert f"rfdropo audit '{out / 'config.toml'}' --out" in error


@pytest.mark.parametrize("command", ["predict", "design", "evaluate", "simulate"])
def test_a_run_without_a_page_has_its_results_named(command, tmp_path, monkeypatch, capsys):
    results = COMMANDS[command].results
    out = folder_of(tmp_path, command, *results)
    status, said, _ = run(["report", str(out)], monkeypatch, capsys)
    assert status == 0
    assert "writes no page" in said
    assert all(str(out / name) in said for name in results)
    assert ("rfdropo view" in said) == (command == "predict")


@pytest.mark.parametrize("command", ["audit", "predict", "train"])
def test_a_run_that_has_not_ended_says_how_to_go_on(command, tmp_path, monkeypatch, capsys):
    out = folder_of(tmp_path, command, status=FAILED)
    status, _, error = run(["report", str(out)], monkeypatch, capsys)
    assert status == 2
    assert f"a run of {command} that has not ended" in error
    assert ("--resume" in error) == COMMANDS[command].resumable


def test_a_folder_of_an_earlier_version_is_known_by_its_results(tmp_path, monkeypatch, capsys):
    out = folder_of(tmp_path, "audit", "audit.json", PAGE, status=None)
    assert run(["report", str(out)], monkeypatch, capsys)[0] == 0
    (out / "audit.json").unlink()
    assert "holds no run" in run(["report", str(out)], monkeypatch, capsys)[2]


def test_no_folder(tmp_path, monkeypatch, capsys):
    assert "no such folder" in run(["report", str(tmp_path / "none")], monkeypatch, capsys)[2]
