"""Simulators of others by name: the example of the document, a process, PyElastica's rod and soromox's arm."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, solve_bvp, trapezoid
from scipy.optimize import minimize

import rfdropo_bayes as rb
from rfdropo_bayes.model.experiment_file import read_tables, self_contained
from rfdropo_bayes.simulators.adapters import adapted

REPOSITORY = Path(__file__).resolve().parents[2]
DOCUMENT = (REPOSITORY / "docs" / "your_simulator.md").read_text()
LINES = 40
WALK = {"duration": 1.0, "interval": 0.2, "step": 0.01, "low": -0.03, "high": 0.03, "sample_time": 0.02}
PROGRAM = """
import json, sys
for line in sys.stdin:
    asked = json.loads(line)
    k = asked["parameters"]["stiffness"]
    print(json.dumps({"position": [[[k * row[0], 0.0, 0.1]] for row in asked["command"]]}), flush=True)
"""


def block(language: str, containing: str) -> str:
    """A block of code of the document."""
    found = [code for code in re.findall(rf"```{language}\n(.*?)```", DOCUMENT, re.DOTALL) if containing in code]
    assert len(found) == 1
    return found[0]


def test_the_example_of_the_document_is_a_simulator_of_forty_lines(tmp_path):
    code = block("python", "rb.BlackBox")
    assert code.count("\n") <= LINES
    (tmp_path / "engine.py").write_text(code)
    (tmp_path / "experiment.toml").write_text(block("toml", "engine.py"))
    model = rb.Model.read(tmp_path / "experiment.toml")
    assert model.parameters.loc["stiffness", "prior"] is not None
    assert {spec.name: spec.nominal for spec in model.simulator.parameters}["stiffness"] == 30.0
    (run,) = rb.simulate(model, {**WALK, "recordings": ["a"]})
    assert np.ptp(run.position[:, 0, 0]) > 0.005
    (tmp_path / "run").mkdir()
    placed = self_contained(read_tables(tmp_path / "experiment.toml"), tmp_path, tmp_path / "run")
    assert (placed["robot"], (tmp_path / "run" / "engine.py").read_text()) == ("engine.py:arm", code)
    assert model.tables()["adapter"] == {"stiffness": 30.0}


def test_a_process_is_named_by_an_experiment(tmp_path):
    (tmp_path / "simulate.py").write_text(PROGRAM)
    text = block("toml", "black_box:BlackBox").replace(
        '["./simulate", "--quiet"]', f'["{sys.executable}", "{tmp_path / "simulate.py"}"]'
    )
    (tmp_path / "experiment.toml").write_text(text)
    model = rb.Model.read(tmp_path / "experiment.toml")
    (run,) = rb.simulate(model, {**WALK, "recordings": ["a"]}, parameters={"stiffness": 3.0})
    level = run.command[np.searchsorted(run.command_time, run.time[1:] - 1e-9) - 1, 0]
    np.testing.assert_allclose(run.position[1:, 0, 0], 3.0 * level, atol=1e-12)


@pytest.mark.slow
def test_a_rod_of_pyelastica_hangs_as_an_elastica_does():
    pytest.importorskip("elastica")
    box = adapted("pyelastica_rod.py:rod", REPOSITORY / "examples", {})
    modulus, density, force, length, radius = 1e6, 1100.0, 0.05, 0.3, 0.01
    values = {"young_modulus": modulus, "density": density, "damping": 8.0}
    place = box.function(values, np.full((301, 1), force))
    stiffness, weight = modulus * np.pi * radius**4 / 4.0, 9.81 * density * np.pi * radius**2

    def slopes(s, y):  # angle from the vertical and its derivative; the tip is free
        angle, bend, _ = y
        pull = weight * (length - s)
        return np.stack([bend, (pull * np.sin(angle) - force * np.cos(angle)) / stiffness, np.sin(angle)])

    ends = lambda at, end: np.array([at[0], at[2], end[1]])  # noqa: E731
    s = np.linspace(0.0, length, 30)
    exact = solve_bvp(slopes, ends, s, np.zeros((3, 30))).sol(length)[2]
    assert place[-1, 0, 0] == pytest.approx(exact, rel=0.03)


def bent_tip(values, tension, pieces):
    """[m] How far the tip of `soromox_arm.py` is beside the vertical: the least energy of pieces of constant bend."""
    length, plate, radius = 0.3, 0.01, 0.01
    stiffness = values["young_modulus"] * np.pi * radius**4 / 4.0
    weight = 9.81 * values["density"] * np.pi * radius**2
    s = np.linspace(0.0, length, 3001)

    def angles(turns):
        return np.interp(s, np.linspace(0.0, length, pieces + 1), np.append(0.0, np.cumsum(turns)))

    def energy(turns):
        angle = angles(turns)
        depth = cumulative_trapezoid(np.cos(angle), s, initial=0.0)
        end = depth[-1] + 0.5 * plate * np.cos(angle[-1])
        fallen = weight * trapezoid(depth, s) + 9.81 * values["tip_mass"] * end
        pulled = tension * values["offset_a"] * angle[-1]  # a tendon beside the axis shortens by offset times turn
        return 0.5 * stiffness * np.sum(turns**2) * pieces / length - fallen - pulled

    found = angles(minimize(energy, np.zeros(pieces), options={"gtol": 1e-9}).x)
    return trapezoid(np.sin(found), s) + plate * np.sin(found[-1])


@pytest.mark.slow
def test_an_arm_of_soromox_comes_to_rest_where_its_energy_is_least():
    pytest.importorskip("soromox", reason="soromox is not installed: pip install soromox")
    box = adapted("soromox_arm.py:arm", REPOSITORY / "examples", {})
    values = {name: spec.nominal for name, spec in box.parameters.items()} | {"damping": 2.5e4, "tip_mass": 0.01}
    command = np.concatenate([np.zeros((1, 1, 3)), np.tile([1.0, 0.0, 0.0], (1, 1000, 1))], axis=1)
    place = np.asarray(box.function({name: np.array([value]) for name, value in values.items()}, command))[0]
    assert place.dtype == float
    np.testing.assert_allclose(place[0, :, 2], [-0.1, -0.2, -0.31], atol=1e-9)  # it hangs
    assert place[-1, 2, 1] == pytest.approx(bent_tip(values, 1.0, pieces=2), rel=1e-4)
    np.testing.assert_allclose(place[-1, :, 0], 0.0, atol=1e-6)  # in the plane of the tendon
