"""Paths on the command line count from the current folder, then from the experiment file."""

from __future__ import annotations

from rfdropo_bayes.cli.prediction_commands import _from_here


def test_a_file_here_is_meant_before_one_beside_the_experiment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert _from_here("run.csv") == "run.csv"
    (tmp_path / "run.csv").write_text("t\n")
    assert _from_here("run.csv") == str(tmp_path / "run.csv")
