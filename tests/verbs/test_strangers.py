"""Robots of other laboratories, as `init` writes them, are predicted better than without physics."""

import json
import sys
from pathlib import Path

import pytest

from rfdropo_bayes.cli.main import main
from rfdropo_bayes.report.headline import best_baseline

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["deepc_arm", "soromox_tentacle"])
def test_a_strangers_robot_is_predicted_better_than_without_physics(name, datasets, tmp_path, monkeypatch):
    """Within 2,500 rollouts, with draws enough for intervals."""
    monkeypatch.setenv("RFDROPO_DATA", str(datasets))
    words = ["calibrate", str(EXPERIMENTS / f"{name}.toml"), "--set", "inference.rollouts=2500"]
    words += ["--set", "inference.draws=500", "--out", str(tmp_path / "fit")]
    monkeypatch.setattr(sys, "argv", ["rfdropo", *words])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert not stopped.value.code
    summary = json.loads((tmp_path / "fit" / "summary.json").read_text())
    last = list(summary["rmse"]["test"])[-1]
    title, without = best_baseline(summary, "test", last)
    assert summary["rmse"]["test"][last] < 0.7 * without, title
    assert summary["effective_draws"] >= 100
