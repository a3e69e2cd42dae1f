"""Paths on the command line count from the current folder, then from the experiment file; default folders differ."""

from __future__ import annotations

from pathlib import Path

from rfdropo_bayes.cli.options import experiment_name
from rfdropo_bayes.cli.prediction_commands import _from_here


def test_a_file_here_is_meant_before_one_beside_the_experiment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert _from_here("run.csv") == "run.csv"
    (tmp_path / "run.csv").write_text("t\n")
    assert _from_here("run.csv") == str(tmp_path / "run.csv")


def test_the_experiments_of_two_folders_have_folders_of_their_own(tmp_path, monkeypatch):
    """All that `rfdropo init` writes are named experiment.toml, and all that an audit extends extended.toml."""
    for name in ("experiment.toml", "extended.toml", "config.toml"):
        assert experiment_name(Path("arm") / name) != experiment_name(Path("leg") / name)
    assert experiment_name(Path("arm/experiment.toml")) == "arm"
    assert experiment_name(Path("experiments/push.toml")) == "push"
    monkeypatch.chdir(tmp_path)
    assert experiment_name(Path("experiment.toml")) == tmp_path.name
