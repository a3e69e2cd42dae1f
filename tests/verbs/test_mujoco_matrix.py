"""A MuJoCo model that somebody else made, Gymnasium's Reacher, from init to an exported model, as its user types it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import rfdropo_bayes as rb
from rfdropo_bayes.cli.main import app
from rfdropo_bayes.errors import InputError

mujoco = pytest.importorskip("mujoco")
gymnasium = pytest.importorskip("gymnasium")

REACHER = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "reacher.xml"
DAMPING, FRICTION = 0.7, 0.5  # factor on that of the file; and dry friction [N m], of which the file has none
NOISE = 2e-4  # [m]
QUICK = ["inference.method=laplace", "inference.rollouts=400", "inference.starts=1", "inference.draws=100"]


def rfdropo(*words: object, overrides: tuple[str, ...] | list[str] = ()) -> str:
    """Output of a command that must succeed."""
    options = [part for override in overrides for part in ("--set", override)]
    result = CliRunner().invoke(app, [*map(str, words), *options], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def recorded(folder: Path, friction: float) -> None:
    """Three recordings of an arm whose damping, and perhaps friction, is not that of its file: MuJoCo's own steps."""
    shutil.copyfile(REACHER, folder / "reacher.xml")
    model = mujoco.MjModel.from_xml_path(str(folder / "reacher.xml"))
    model.dof_damping[:2] *= DAMPING
    model.dof_frictionloss[:2] = friction
    rng = np.random.default_rng(0)
    for run in range(3):
        data, rows = mujoco.MjData(model), []
        level = np.repeat(rng.uniform(-0.05, 0.05, (15, 2)), 10, axis=0)
        for row in range(len(level)):
            mujoco.mj_forward(model, data)
            seen = [data.body(name).xpos + NOISE * rng.standard_normal(3) for name in ("body1", "fingertip")]
            if row % 2 == 0:
                rows.append([data.time, *level[row], *(1e3 * np.concatenate(seen))])
            data.ctrl[:] = level[row]
            mujoco.mj_step(model, data)
        markers = [f"{name} {axis} [mm]" for name in ("elbow", "fingertip") for axis in "xyz"]
        table = pd.DataFrame(rows, columns=["time [s]", "motor1", "motor2", *markers])
        table.to_csv(folder / f"run_{run}.csv", index=False)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_init_finds_the_elements_and_says_what_it_assumed(place):
    recorded(place, 0.0)
    told = rfdropo("init", "reacher.xml", "--recording", "run_*.csv")
    assert "assumed: marker elbow is the body body1" in told
    model = rb.Model.read(place / "reacher" / "experiment.toml")
    assert model.robot.function.channels == {"motor1": 0, "motor2": 1}
    inferred = model.parameters[[prior is not None for prior in model.parameters["prior"]]]
    assert {"body_mass", "joint_damping"} <= set(inferred.index)
    assert "joint_frictionloss_joint0" not in inferred.index  # what an audit asks for
    told = rfdropo("check", "reacher/experiment.toml", "--quick")
    assert "mujoco" in told
    assert "joint_frictionloss" in told
    with pytest.raises(InputError, match="is there already"):
        rfdropo("init", "reacher.xml")


def test_a_repeat_of_fitted_commands_is_not_kept_for_the_test(place):
    recorded(place, 0.0)
    again = pd.read_csv(place / "run_0.csv")
    again.iloc[:, 3:] += 0.2 * np.random.default_rng(1).standard_normal(again.iloc[:, 3:].shape)
    again.to_csv(place / "run_3.csv", index=False)
    rfdropo("init", "reacher.xml", "--recording", "run_*.csv")
    runs, test = rb.Model.read(place / "reacher" / "experiment.toml").runs(None)
    assert ([run.name for run in runs], [run.name for run in test]) == (["run_0", "run_1", "run_3"], ["run_2"])


def test_without_a_recording_or_a_site_all_bodies_that_move_are_markers(place):
    shutil.copyfile(REACHER.parent / "inverted_pendulum.xml", place / "pendulum.xml")
    assert "markers are all bodies that move, cart, pole" in rfdropo("init", "pendulum.xml")
    assert rb.Model.read(place / "pendulum" / "experiment.toml").robot.marker_names == ("cart", "pole")


@pytest.mark.slow
def test_a_model_of_others_is_calibrated_drawn_predicted_and_written_back(place):
    recorded(place, 0.0)
    experiment = Path("reacher") / "experiment.toml"
    rfdropo("init", "reacher.xml", "--recording", "run_*.csv")
    told = rfdropo("check", experiment)
    assert "body_mass: hardly changes the motion" in told  # armatures of 1 kg m2 move bodies of 36 g
    rfdropo("view", experiment, "--out", "run.png")
    rfdropo("simulate", experiment, "--out", "simulation")
    rfdropo("calibrate", experiment, "--out", "fit", overrides=QUICK)
    row = json.loads(Path("fit/summary.json").read_text())["parameters"]["joint_damping"]
    assert abs(row["mean"] - DAMPING) < 0.02
    rfdropo("predict", experiment, "--from", "fit", "--commands", "run_2.csv", "--out", "next")
    goal, small = ("--goal", "0.1,0.1,0.01"), {"steps": 512, "environments": 4, "evaluation_episodes": 4}
    sizes = [f"training.{name}={value}" for name, value in {**small, "evaluate_every": 512}.items()]
    rfdropo("train", "--from", "fit", "--task", "reach", *goal, "--out", "policy", overrides=sizes)
    assert json.loads(Path("policy/summary.json").read_text())["randomisation"] == "posterior"
    rfdropo("export", "fit", "--phi", "--model", "--out", "calibrated")
    written = mujoco.MjModel.from_xml_path("calibrated/calibrated.xml")
    np.testing.assert_allclose(written.dof_damping[:2], row["mean"], rtol=1e-6)
    again = rb.MuJoCo("calibrated/calibrated.xml", markers={"tip": "fingertip"})
    model = rb.Model.read(Path("fit/config.toml"))
    means = {
        name: float(row["mean"]) for name, row in json.loads(Path("fit/summary.json").read_text())["parameters"].items()
    }
    runs = model.recordings("test")
    fitted = {name: value for name, value in means.items() if name in model.robot.parameters}
    (moved,) = rb.simulate(model, runs, parameters=fitted)
    channels = again.function.channels
    assert list(channels.values()) == [0, 1]
    other = rb.Model(rb.MuJoCo("calibrated/calibrated.xml", markers={"elbow": "body1", "fingertip": "fingertip"}))
    (same,) = rb.simulate(other, runs)
    np.testing.assert_allclose(same.position, moved.position, atol=1e-9)


@pytest.mark.slow
def test_an_audit_names_friction_that_the_file_does_not_have(place):
    recorded(place, FRICTION)
    rfdropo("init", "reacher.xml", "--recording", "run_*.csv")
    limits = ["audit.bootstraps=199", "audit.minutes=5"]
    rfdropo("audit", Path("reacher") / "experiment.toml", "--out", "audit", overrides=limits)
    content = json.loads(Path("audit/audit.json").read_text())
    found = [finding for finding in content["findings"] if "joint_frictionloss" in finding["equivalence_class"]]
    assert found, content["sentence"]
    for name in ("joint_frictionloss_joint0", "joint_frictionloss_joint1"):
        row = found[0]["parameters"][name]
        assert row["q05"] - 0.05 < FRICTION < row["q95"] + 0.05


def test_what_names_no_simulator_is_told_so(place):
    (place / "own.py").write_text("number = 3\ndef broken(stiffness):\n    return stiffness\n")
    for robot, adapter, said in (
        ("none.xml", {}, "no such model"),
        ("own.py:nothing", {}, "cannot import the simulator"),
        ("own.py:number", {}, "takes no arguments"),
        ("own.py:broken", {"stiffnes": 1.0}, "unexpected keyword"),
        ("own.py:broken", {"stiffness": 1.0}, "gives float, no BlackBox"),
        ("smooth_arm", {"markers": []}, "has no adapter"),
    ):
        tables = "\n".join(f"{key} = {json.dumps(value)}" for key, value in adapter.items())
        Path("experiment.toml").write_text(f'robot = "{robot}"\n' + (f"[adapter]\n{tables}\n" if adapter else ""))
        with pytest.raises(InputError, match=said):
            rb.Model.read(Path("experiment.toml"))
