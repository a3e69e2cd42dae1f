"""What the documents name runs from end to end, report included: every method on the bundled demo."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from rfdropo_bayes.cli.main import app
from rfdropo_bayes.inference.methods import METHODS
from rfdropo_bayes.posteriors import PosteriorRecord

REPOSITORY = Path(__file__).resolve().parents[2]
DEMO = REPOSITORY / "experiments" / "demo.toml"
SHORT = [
    f'data.fit=[{{observations="{DEMO.parent}/demo/demo_1.nc", rows=[0, 12]}}]',
    f'data.test=[{{observations="{DEMO.parent}/demo/demo_3.nc", rows=[0, 12]}}]',
    "simulator.refine=1",
]

# The smallest settings that each method accepts and that bring it to its end.
SETTINGS = {
    "rfdropo": ["inference.rollouts=200", "inference.rollouts_per_candidate=4"],
    "smc": ["inference.rollouts=600", "inference.particles=50", "inference.blocks=2"],
    "laplace": ["inference.rollouts=300", "inference.starts=1", "inference.draws=40"],
}


def demo_without_method(folder: Path) -> Path:
    """The demo's experiment file up to its method, whose options are no other method's."""
    path = folder / "demo.toml"
    path.write_text(DEMO.read_text().partition("[inference]")[0])
    return path


def run(*arguments: object, overrides: list[str]) -> int:
    """Exit status of a command, called as a shell would."""
    words = [str(a) for a in arguments] + [word for override in overrides for word in ("--set", override)]
    return CliRunner().invoke(app, words, catch_exceptions=False).exit_code


def test_the_matrix_and_the_documents_name_every_method():
    rows = (REPOSITORY / "docs" / "inference.md").read_text().partition("**")[0].splitlines()
    documented = {name for row in rows if row.startswith("| `") for name in re.findall(r"`(\w+)`", row.split("|")[1])}
    documented.discard("inference")
    assert set(SETTINGS) == set(METHODS) == documented - {"method"}


@pytest.mark.slow
@pytest.mark.parametrize("method", SETTINGS)
def test_every_method_writes_a_posterior_and_its_report(method, tmp_path):
    experiment, out = demo_without_method(tmp_path), tmp_path / "run"
    overrides = [*SHORT, f'inference.method="{method}"', *SETTINGS[method]]
    assert run("calibrate", experiment, "--out", out, overrides=overrides) == 0
    assert (out / "report.html").read_text().startswith("<!DOCTYPE html>")
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["status"], summary["method"]) == ("done", method)
    record = PosteriorRecord.load(out / "posterior.nc")
    assert {"young_modulus", "trunk_mass", "rayleigh_stiffness"} <= set(record.posterior)
    assert all(np.isfinite(record.flat(info.name)).all() for info in record.parameters)
    assert {r.split for r in record.recordings} == {"fit", "test"}
    assert all(np.isfinite(r.predicted).all() for r in record.recordings)
