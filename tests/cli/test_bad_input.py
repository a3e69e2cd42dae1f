"""Bad input ends with status 2 and one line that says what is wrong, where and what to do."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from rfdropo_bayes.cli import main

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo"

EXPERIMENT = """
robot = "smooth_arm"
[data]
format = "netcdf"
fit = ["{demo}/demo_1.nc"]
[model.priors]
young_modulus = {{}}
[inference]
method = "smc"
rollouts = 50
"""


def run(arguments: list[str], monkeypatch, capsys) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["rfdropo", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    return int(stopped.value.code or 0), capsys.readouterr().err


def experiment(tmp_path: Path, *changes: tuple[str, str]) -> str:
    text = EXPERIMENT.format(demo=DEMO)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "experiment.toml"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"smooth_arm"', '"smooth_harm"', "unknown robot 'smooth_harm'"),
        ("[model.priors]", '[model]\nmechanisms = ["paylod"]\n[model.priors]', "did you mean 'payload'"),
        ("young_modulus", "youngs_modulus", "did you mean 'young_modulus'"),
        ("young_modulus", "payload_mass", "add 'payload' to [model] mechanisms, or remove it"),
        ("young_modulus", "tension_noise", "set [model] tension = true, or remove it"),
        ("{}", '{ distribution = "Uniform", low = 1.0, high = 2.0 }', "outside the bounds"),
        ("{}", '{ distribution = "Normall", loc = 1.0, scale = 2.0 }', "did you mean 'Normal'"),
        (
            "young_modulus = {}",
            "young_modulus = {}\n[model.fixed]\ntrunk_mass = -0.1",
            "trunk_mass = -0.1 kg is outside",
        ),
        ("young_modulus = {}", "young_modulus = {}\n[model.fixed]\nyoung_modulus = 3e6", "a prior and a fixed value"),
        (
            "young_modulus = {}",
            "offset = {}\n[model.fixed]\noffset_x = 0.001",
            "'offset_x' has a prior and a fixed value",
        ),
        ("young_modulus = {}", "young_modulus = {}\n[model.fixed]\noffset = 3.0", "offset_x = 3 m is outside"),
        ('"smc"', '"mcmc"', "unknown method 'mcmc'"),
        ("rollouts = 50", "rolouts = 50", "'rolouts'"),
        ("demo_1.nc", "demo_9.nc", "no such file"),
        ("fit =", "fits =", "did you mean 'fit'"),
        ('"netcdf"', '"netcfd"', "netcdf"),
        ("robot =", "robot", "not valid TOML"),
        ("rollouts = 50", "rollouts = -1", "rollouts"),
    ],
)
def test_a_wrong_experiment_file(tmp_path, monkeypatch, capsys, old, new, message):
    path = experiment(tmp_path, (old, new))
    status, error = run(["calibrate", path, "--out", str(tmp_path / "out")], monkeypatch, capsys)
    assert status == 2
    assert message in error
    assert error.count("\n") == 1
    assert "Traceback" not in error


def test_a_corrupt_recording(tmp_path, monkeypatch, capsys):
    broken = tmp_path / "broken.nc"
    broken.write_bytes((DEMO / "demo_1.nc").read_bytes()[:5000])
    path = experiment(tmp_path, (f"{DEMO}/demo_1.nc", str(broken)))
    status, error = run(["calibrate", path, "--out", str(tmp_path / "out")], monkeypatch, capsys)
    assert status == 2
    assert "broken.nc" in error
    assert error.count("\n") == 1


def test_an_output_folder_that_cannot_be_made(tmp_path, monkeypatch, capsys):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    status, error = run(["calibrate", experiment(tmp_path), "--out", str(blocked / "out")], monkeypatch, capsys)
    assert status == 2
    assert "output folder" in error
    assert error.count("\n") == 1


def test_what_the_disk_refuses_is_one_line_whichever_command_writes(tmp_path, monkeypatch, capsys):
    """A folder stands where the picture would go: no right of any user changes that."""
    (tmp_path / "taken.png").mkdir()
    arguments = ["view", str(DEMO / "demo_1.nc"), "--robot", "smooth_arm", "--out", str(tmp_path / "taken.png")]
    status, error = run(arguments, monkeypatch, capsys)
    assert status == 2
    assert "taken.png: cannot be written" in error
    assert error.count("\n") == 1


def test_a_missing_experiment_file(tmp_path, monkeypatch, capsys):
    status, error = run(["simulate", str(tmp_path / "none.toml")], monkeypatch, capsys)
    assert status == 2
    assert "cannot read the experiment file" in error


def test_a_report_of_nothing(tmp_path, monkeypatch, capsys):
    status, error = run(["report", str(tmp_path)], monkeypatch, capsys)
    assert status == 2
    assert error.count("\n") == 1


def test_an_unknown_command_or_option(monkeypatch, capsys):
    for arguments in (["calibrat"], ["calibrate", "x.toml", "--outt", "y"]):
        status, error = run(arguments, monkeypatch, capsys)
        assert status == 2
        assert error.count("\n") == 1
