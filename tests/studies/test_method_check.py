"""``python -m studies sbc`` on the layered arm."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from rfdropo_bayes.model.model import Model
from studies.method_check import run_check

EXPERIMENT = Path(__file__).resolve().parents[2] / "benchmarks" / "sbc.toml"


@pytest.mark.slow
def test_the_arm_is_calibrated(tmp_path):
    """30 data sets: an adjusted p below 0.01 has a chance of 1 %, the coverage leaves its band with 1 %; fixed seed."""
    found = run_check(Model.read(EXPERIMENT), tmp_path, datasets=30)
    assert found["passed"], found["sentence"]
    noise = {"observation_noise", "lasting_noise", "noise_correlation_time"}
    body = {"young_modulus", "trunk_mass", "rayleigh_stiffness"}
    assert set(found["quantities"]) == {*body, *noise, "log_likelihood"}
    spread = [row["contraction"] for name, row in found["quantities"].items() if name != "log_likelihood"]
    assert min(spread) < 0.3
    assert json.loads((tmp_path / "sbc.json").read_text())["passed"]
    again = run_check(Model.read(EXPERIMENT), tmp_path, datasets=30, resume=True)
    assert again["quantities"] == found["quantities"]


@pytest.mark.slow
def test_simulated_data_fit_their_own_truth():
    """Whitened residuals of a data set at its truth are standard normal: mean square 1 to five standard errors."""
    from studies.method_check import simulate_data_set

    model = Model.read(EXPERIMENT)
    problem = model.problem(model.recordings("fit"))
    truth, replica, failed = simulate_data_set(problem, jax.random.key(0))
    values = {name: np.array([value]) for name, value in truth.items()}
    white = replica.residuals(jax.tree.map(jax.numpy.asarray, values), problem.n_rows)[0]
    assert failed == 0
    assert np.mean(white**2) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / white.size))
    assert replica.fingerprint != problem.fingerprint
    shorter = replica.residuals(jax.tree.map(jax.numpy.asarray, values), 5)[0]
    np.testing.assert_allclose(shorter, white[: len(shorter)], atol=1e-9)
