"""Every command that the documents name, on the demo, on a robot of one's own in another folder, and on a mesh body."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from rfdropo_bayes.cli.main import app
from rfdropo_bayes.data import Trajectory

REPOSITORY = Path(__file__).resolve().parents[2]
DEMO = REPOSITORY / "experiments" / "demo.toml"
ROWS = 24
QUICK = [
    'inference.method="laplace"',
    "inference.rollouts=120",
    "inference.starts=1",
    "inference.draws=40",
    "audit.bootstraps=199",
    "audit.minutes=2",
    "design.minutes=2",
]
MESH = """
robot = "trunk_sofa_mesh"
[data]
format = "netcdf"
fit = ["run_1.nc"]
test = ["run_2.nc"]
[model.priors]
young_modulus = {{ distribution = "LogNormal", median = 4e6, sigma = 0.3 }}
[noise]
standard_deviation = 5e-4
[simulator]
body = "tetrahedra"
[simulator.tetrahedra]
mesh = "{mesh}"
unit = "mm"
clamp_height = 0.02
"""
MESH_COMMANDS = """
[commands]
duration = 0.6
interval = 0.1
step = 0.005
low = 0.0
high = 0.03
sample_time = 0.05
recordings = ["run_1", "run_2"]
"""


@dataclass(frozen=True)
class Bench:
    """A robot's experiment file, settings that make it quick, where its calibration is, and a recording not fitted."""

    experiment: Path
    overrides: list[str]
    run: Path
    unseen: Path


def rfdropo(*words: object, overrides: list[str] | None = None) -> str:
    """Output of a command that must succeed."""
    options = [part for override in overrides or [] for part in ("--set", override)]
    result = CliRunner().invoke(app, [*map(str, words), *options], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def demo(folder: Path) -> Bench:
    path = folder / "demo.toml"
    path.write_text(re.sub(r"\[inference\].*", "", DEMO.read_text(), flags=re.DOTALL))
    data = [
        f'data.{role}=[{{observations="{DEMO.parent}/demo/demo_{k}.nc", rows=[0, {ROWS}]}}]'
        for role, k in (("fit", 1), ("test", 3))
    ]
    return Bench(path, [*QUICK, *data, "simulator.refine=1"], folder / "run", DEMO.parent / "demo" / "demo_3.nc")


def own(folder: Path) -> Bench:
    """Two segments, six motors in radians, markers named otherwise, semicolons and decimal commas."""
    rng = np.random.default_rng(0)
    time = 0.05 * np.arange(ROWS)
    motors = {f"motor{k + 1} [rad]": np.repeat(rng.uniform(0.0, 0.6, ROWS // 4), 4) for k in range(6)}
    heights = {"elbow": 120.0, "wrist": 240.0}

    def write(name: str, position: np.ndarray) -> None:
        columns = {"time [s]": time} | motors
        for k, marker in enumerate(heights):
            columns |= {f"{marker} {axis} [mm]": position[:, k, i] for i, axis in enumerate("xyz")}
        pd.DataFrame(columns).to_csv(folder / name, index=False, sep=";", decimal=",")

    rest = np.array([[[0.0, 0.0, height] for height in heights.values()]])
    for k in (1, 2):
        write(f"run_{k}.csv", rest + np.linspace(0.0, 1.0, ROWS)[:, None, None])
    markers = ",".join(f"{name}={height:g}" for name, height in heights.items())
    rfdropo(
        *("init", folder / "eel", "--recording", folder / "run_*.csv", "--shape", "cylinder", "--length-mm", 240),
        *("--radius-mm", 12, "--segments", 2, "--cables", 3, "--spool-radius-mm", 8, "--mass-g", 110),
        *("--gravity", "+z", "--markers", markers, "--defaults"),
    )
    experiment = folder / "eel" / "experiment.toml"
    # What stands in the place of the robot: its own simulator, recorded with half a millimetre of noise.
    rfdropo("simulate", experiment, "--out", folder / "truth", overrides=["young_modulus=0.8e6"])
    for k in (1, 2):
        moved = Trajectory.load(next((folder / "truth").glob(f"*run_{k}.nc"))).position
        write(f"run_{k}.csv", 1e3 * moved + 0.5 * rng.standard_normal(moved.shape))
    return Bench(experiment, QUICK, folder / "run", folder / "run_2.csv")


def mesh(folder: Path, bar: Path) -> Bench:
    """A bar of few tetrahedra, whose recordings it makes itself."""
    text = MESH.format(mesh=bar)
    made = folder / "made.toml"
    made.write_text(re.sub(r"\[data\].*?(?=\[model)", "", text, flags=re.DOTALL) + MESH_COMMANDS)
    rfdropo("simulate", made, "--out", folder, overrides=["young_modulus=3.6e6"])
    path = folder / "mesh.toml"
    path.write_text(text)
    return Bench(path, QUICK, folder / "run", folder / "run_2.nc")


@pytest.fixture(
    scope="module", params=[pytest.param(name, marks=pytest.mark.xdist_group(name)) for name in ("demo", "own", "mesh")]
)
def bench(request, tmp_path_factory, bar_mesh) -> Bench:
    folder = tmp_path_factory.mktemp(request.param)
    made = {"demo": demo, "own": own, "mesh": lambda f: mesh(f, bar_mesh)}[request.param](folder)
    rfdropo("calibrate", made.experiment, "--out", made.run, overrides=made.overrides)
    return made


def test_every_command_is_in_the_matrix() -> None:
    """Those of a calibration; lists, training and motors have tests of their own."""
    source = Path(__file__).read_text()
    elsewhere = {"robots", "mechanisms", "formats", "methods", "reference"}
    elsewhere |= {"train", "evaluate", "drives", "deploy", "doctor", "home"}
    names = {command.name or command.callback.__name__ for command in app.registered_commands}
    assert {name for name in names - elsewhere if f'"{name}"' not in source} == set()


@pytest.mark.slow
def test_check_says_what_was_read(bench, tmp_path) -> None:
    said = rfdropo("check", bench.experiment, "--out", tmp_path / "check.png", overrides=bench.overrides)
    assert "marker" in said


@pytest.mark.slow
def test_calibrate_writes_a_report(bench) -> None:
    summary = json.loads((bench.run / "summary.json").read_text())
    assert summary["status"] == "done"
    assert np.isfinite([row["mean"] for row in summary["parameters"].values()]).all()
    assert (bench.run / "report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_simulate_writes_what_view_draws(bench, tmp_path) -> None:
    rfdropo("simulate", bench.experiment, "--out", tmp_path / "sim", overrides=bench.overrides)
    made = sorted((tmp_path / "sim").glob("*.nc"))
    assert made
    rfdropo("view", made[0], "--out", tmp_path / "motion.png")
    assert (tmp_path / "motion.png").stat().st_size > 5_000


@pytest.mark.slow
def test_a_run_folder_simulates_by_itself(bench, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    rfdropo("simulate", bench.run / "config.toml", "--out", tmp_path / "again")
    assert list((tmp_path / "again").glob("*.nc"))


@pytest.mark.slow
def test_report_draws_the_same_page_again(bench) -> None:
    before = (bench.run / "report.html").stat().st_size
    rfdropo("report", bench.run)
    assert (bench.run / "report.html").stat().st_size == pytest.approx(before, rel=0.05)


@pytest.mark.slow
def test_predict_says_where_new_commands_lead(bench, tmp_path) -> None:
    rfdropo(
        *("predict", bench.experiment, "--from", bench.run, "--commands", bench.unseen, "--out", tmp_path / "next"),
        overrides=bench.overrides,
    )
    assert list((tmp_path / "next").glob("*.csv"))


@pytest.mark.slow
def test_adapt_finds_what_a_day_changes_and_predicts_on(bench, tmp_path) -> None:
    day = [*bench.overrides, "model.per_group.young_modulus=1e5"]
    rfdropo(
        *("adapt", bench.run, "--recording", bench.unseen, "--group", "today", "--out", tmp_path / "today"),
        overrides=day,
    )
    summary = json.loads((tmp_path / "today" / "summary.json").read_text())
    assert summary["status"] == "done"
    assert np.isfinite(summary["parameters"]["young_modulus_deviation@today"]["mean"])
    rfdropo("predict", tmp_path / "today", "--commands", bench.unseen, "--group", "today", "--out", tmp_path / "next")
    assert list((tmp_path / "next").glob("*.csv"))


@pytest.mark.slow
def test_export_writes_phi(bench, tmp_path) -> None:
    rfdropo("export", bench.run, "--phi", "--out", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} >= {"phi.csv", "phi.json", "phi_draws.csv"}


@pytest.mark.slow
def test_audit_ends_with_a_verdict(bench, tmp_path) -> None:
    rfdropo("audit", bench.experiment, "--out", tmp_path / "audit", overrides=bench.overrides)
    found = json.loads((tmp_path / "audit" / "audit.json").read_text())
    assert found["verdict"]
    assert found["sentence"]
    assert (tmp_path / "audit" / "report.html").exists()


@pytest.mark.slow
def test_design_proposes_commands(bench, tmp_path) -> None:
    rfdropo("design", bench.experiment, "--out", tmp_path / "design", overrides=bench.overrides)
    assert json.loads((tmp_path / "design" / "design.json").read_text())["sentence"]
    assert len(pd.read_csv(tmp_path / "design" / "next_commands.csv"))


@pytest.mark.slow
@pytest.mark.parametrize("bench", ["demo"], indirect=True)
def test_two_groups_of_recordings_are_compared(bench, tmp_path) -> None:
    pieces = ", ".join(f'{{observations="{DEMO.parent}/demo/demo_{k}.nc", rows=[0, {ROWS}]}}' for k in (1, 2))
    groups = ['model.groups.before=["demo_1*"]', 'model.groups.after=["demo_2*"]']
    rfdropo(
        *("audit", bench.experiment, "--between", "before", "after", "--out", tmp_path / "days"),
        overrides=[*bench.overrides, f"data.fit=[{pieces}]", *groups],
    )
    found = json.loads((tmp_path / "days" / "audit.json").read_text())
    assert found["between"]["groups"] == {name: [f"demo_{k}[0:{ROWS}]"] for name, k in (("before", 1), ("after", 2))}
    assert (tmp_path / "days" / "report.html").exists()
