"""``rfdropo simulate``: SOFA's recordings on SOFA's mesh, and everything else on a small mesh of its own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.cli import main
from rfdropo_bayes.data import DATA_VARIABLE, Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment import load_experiment
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.verbs.simulate import simulate_all

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
SAME = 0.00025
"""[mm] SOFA's recordings are means of four cables, each sum rounded to 0.001 mm: errors below this mean equality."""

BAR = """
robot = "trunk_sofa_mesh"
seed = 3
[simulator]
body = "tetrahedra"
[simulator.tetrahedra]
mesh = "{mesh}"
unit = "mm"
clamp_height = 0.02
frames = "edges"
masses = "equal"
drives = "sofa"
drive_rate = 0.001
[model.priors]
young_modulus = {{}}
"""
ROD = """
robot = "smooth_arm"
seed = 3
[model.priors]
young_modulus = {}
"""
COMMANDS = """
[commands]
duration = 0.5
interval = 0.05
step = 0.005
low = -0.05
high = 0.05
sample_time = 0.05
recordings = ["walk"]
"""


def simulate(experiment: Path, out: Path, monkeypatch, capsys, *overrides: str) -> dict:
    """The content of the simulation.json that the command writes."""
    options = [part for assignment in overrides for part in ("--set", assignment)]
    monkeypatch.setattr(sys, "argv", ["rfdropo", "simulate", str(experiment), "--out", str(out), *options])
    with pytest.raises(SystemExit) as stopped:
        main()
    captured = capsys.readouterr()
    assert not stopped.value.code, captured.err
    return json.loads((out / "simulation.json").read_text())


@pytest.fixture
def sofa(datasets, monkeypatch) -> Path:
    folder = datasets / "sofa_trunk"
    if not (folder / "trunk.vtk").is_file():
        pytest.skip(f"SOFA's mesh not found at {folder}")
    monkeypatch.setenv(DATA_VARIABLE, str(datasets))
    return folder


@pytest.mark.slow
def test_sofa_reaching_is_followed_to_the_last_digit(sofa, tmp_path, monkeypatch, capsys):
    report = simulate(EXPERIMENTS / "sofa_reach.toml", tmp_path, monkeypatch, capsys)
    error = report["recordings"]["reach_1"]["error_mm"]
    assert error == report["error_mm"]
    assert error["max"] < SAME
    assert report["simulator"]["nodes"] == 709
    assert json.loads((tmp_path / "simulation.json").read_text()) == report
    written, recorded = pd.read_csv(tmp_path / "trajectory.csv"), pd.read_csv(sofa / "reach_1.csv")
    columns = [f"{axis}{point}" for point in range(21) for axis in "xyz"]
    assert len(written) == 101
    np.testing.assert_allclose(written[columns], recorded[columns], atol=2 * SAME)
    assert Trajectory.load(tmp_path / "trajectory.nc").synthetic


@pytest.mark.slow
def test_sofa_pushing_is_followed_before_contact(sofa, tmp_path, monkeypatch, capsys):
    recordings = "['sofa_trunk/push_2.csv', {observations='sofa_trunk/push_1.csv', rows=[0, 10]}]"
    settings = f"data.fit={recordings}", "simulator.push=false"
    report = simulate(EXPERIMENTS / "sofa_push.toml", tmp_path, monkeypatch, capsys, *settings)
    assert len(report["recordings"]) == 2
    assert report["error_mm"]["max"] < SAME


@pytest.mark.slow
def test_sofas_cube_is_pushed_along(sofa, tmp_path, monkeypatch, capsys):
    """In push_2 trunk and cube never meet. In push_1 they do, on a surface mesh that is not at hand."""
    report = simulate(EXPERIMENTS / "sofa_push.toml", tmp_path, monkeypatch, capsys)
    apart, pushed = report["recordings"]["push_2"], report["recordings"]["push_1"]
    assert apart["status"] == pushed["status"] == "ok"
    assert apart["error_mm"]["max"] < SAME
    written, recorded = pd.read_csv(tmp_path / "push_1.csv"), pd.read_csv(sofa / "push_1.csv")
    columns = [f"{axis}{point}" for point in range(21) for axis in "xyz"]
    np.testing.assert_allclose(written[columns][:11], recorded[columns][:11], atol=2 * SAME)
    assert pushed["error_mm"]["mean"] < 1.0


@pytest.mark.slow
@pytest.mark.xfail(
    reason="0.028 mm: the plate gives way by 0.019 mm under a cube at rest, see BETA in docs/architecture.md",
    strict=True,
    raises=AssertionError,
)
def test_sofas_cube_rests_where_sofas_does(sofa, tmp_path, monkeypatch, capsys):
    report = simulate(
        EXPERIMENTS / "sofa_push.toml", tmp_path, monkeypatch, capsys, "data.fit=['sofa_trunk/push_2.csv']"
    )
    error = report["recordings"]["push_2"]["object_error"]["position_mm"]
    assert error["max"] < 0.02  # SOFA's cube creeps by 0.014 mm
    written = pd.read_csv(tmp_path / "trajectory.csv")
    np.testing.assert_allclose(written["cube_y"][2], -82.819, atol=1e-3)


@pytest.mark.slow
@pytest.mark.xfail(
    reason="5.11 mm in the mean, 13.65 mm at the end: the trunk's notches are filled, see docs/architecture.md",
    strict=True,
    raises=AssertionError,
)
def test_sofas_cube_ends_where_sofas_does(sofa, tmp_path, monkeypatch, capsys):
    """SOFA's cube sinks into the notches of the trunk, which the chain of spheres fills."""
    report = simulate(
        EXPERIMENTS / "sofa_push.toml", tmp_path, monkeypatch, capsys, "data.fit=['sofa_trunk/push_1.csv']"
    )
    recorded = pd.read_csv(sofa / "push_1.csv")
    pushed = report["recordings"]["push_1"]
    assert pushed["object_error"]["position_mm"]["mean"] < 5.0
    travelled = np.hypot(*(recorded[f"cube_{axis}"].iloc[-1] - recorded[f"cube_{axis}"][0] for axis in "xz"))
    assert pushed["object_error"]["position_mm"]["last"] < 0.1 * travelled


@pytest.mark.slow
def test_another_recording_by_override_in_single_precision(sofa, tmp_path, monkeypatch, capsys):
    other = tmp_path / "other.csv"
    other.write_bytes((sofa / "push_2.csv").read_bytes())
    overrides = f"data.fit=[{str(other)!r}]", "simulator.precision=float32"
    report = simulate(EXPERIMENTS / "sofa_reach.toml", tmp_path / "out", monkeypatch, capsys, *overrides)
    assert list(report["recordings"]) == ["other"]
    # Rounding decides when a slack cable tightens: some tenths of a millimetre in single rows (double: 0.0002 mm).
    assert report["error_mm"]["max"] < 0.5
    assert report["error_mm"]["mean"] < 0.05


@pytest.mark.slow
def test_one_switch_makes_a_rod_of_it(sofa, tmp_path, monkeypatch, capsys):
    report = simulate(EXPERIMENTS / "sofa_reach.toml", tmp_path, monkeypatch, capsys, "simulator.body=rod")
    assert report["simulator"]["body"] == "rod"


@pytest.fixture
def bar(bar_mesh, tmp_path) -> Path:
    path = tmp_path / "bar.toml"
    path.write_text(BAR.format(mesh=bar_mesh))
    return path


def write(path: Path, *parts: str) -> Path:
    path.write_text("".join(parts))
    return path


@pytest.mark.parametrize("body", ["rod", pytest.param("mesh", marks=pytest.mark.slow)])
def test_a_simulated_recording_is_found_again(body, bar, tmp_path, monkeypatch, capsys):
    if body == "mesh":
        text, commands = bar.read_text(), COMMANDS
    else:
        text, commands = ROD, COMMANDS.replace("low = -0.05\nhigh = 0.05", "low = 0.0\nhigh = 0.01")
    made = write(tmp_path / "made.toml", text, commands)
    assert simulate(made, tmp_path / "made", monkeypatch, capsys)["error_mm"] is None
    data = f'[data]\nformat = "netcdf"\nfit = ["{tmp_path}/made/trajectory.nc"]\n'
    again = write(tmp_path / "again.toml", text, data)
    assert simulate(again, tmp_path / "again", monkeypatch, capsys)["error_mm"]["max"] < 1e-6
    softer = simulate(again, tmp_path / "softer", monkeypatch, capsys, "young_modulus=1e6")
    assert softer["parameters"] == {"young_modulus": 1e6}  # set on the command line
    assert softer["error_mm"]["max"] > 1.0


@pytest.mark.slow
def test_the_mesh_is_looked_for_beside_the_experiment(bar, bar_mesh, tmp_path, monkeypatch):
    monkeypatch.delenv(DATA_VARIABLE, raising=False)
    text = bar.read_text().replace(str(bar_mesh), "mine.vtk") + COMMANDS
    model = Model.read(write(tmp_path / "mine.toml", text))
    with pytest.raises(InputError, match=r"mine\.vtk: no such file"):
        simulate_all(model, tmp_path / "out")
    (tmp_path / "mine.vtk").write_bytes(bar_mesh.read_bytes())
    assert simulate_all(model, tmp_path / "out")["recordings"]["walk"]["status"] == "ok"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("masses =", "mases =", "unknown key 'simulator.tetrahedra.mases'.*did you mean 'masses'"),
        ('"edges"', '"edge"', "simulator.tetrahedra.frames"),
        ("drive_rate = 0.001", "drive_rate = 0.0", "simulator.tetrahedra.drive_rate"),
        ('unit = "mm"\n', "", "'simulator.tetrahedra.unit' is missing"),
        ('body = "tetrahedra"', 'body = "tetra"', "simulator.body"),
    ],
)
def test_wrong_options_are_named(bar, tmp_path, old, new, message):
    text = bar.read_text()
    assert old in text
    with pytest.raises(InputError, match=message):
        load_experiment(write(tmp_path / "wrong.toml", text.replace(old, new)))


def test_a_mesh_body_needs_its_table(tmp_path):
    text = 'robot = "trunk_sofa_mesh"\n[simulator]\nbody = "tetrahedra"\n'
    with pytest.raises(InputError, match=r"add a table \[simulator.tetrahedra\]"):
        load_experiment(write(tmp_path / "bare.toml", text))
