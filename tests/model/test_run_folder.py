"""Folders of runs: finished ones stay, interrupted ones go on with the same settings, and all can be run again."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.errors import InputError, Interrupted
from rfdropo_bayes.files import append_line, read_lines, whole, write_text
from rfdropo_bayes.inference.progress import Checkpoint
from rfdropo_bayes.model.experiment import load_experiment
from rfdropo_bayes.model.experiment_file import look_through, read_tables, self_contained
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import COMMANDS, check_folder, run_folder
from rfdropo_bayes.robots import Robot

REPOSITORY = Path(__file__).resolve().parents[2]
DEMO = REPOSITORY / "experiments" / "demo.toml"
SETTINGS = {"tables": {"robot": "smooth_arm", "inference": {"rollouts": 100}}, "data": {"demo_1": "abc"}}


def finish(out: Path, command: str = "calibrate", **options) -> None:
    with run_folder(out, command, **{**SETTINGS, **options}) as folder:
        (folder / COMMANDS[command].results[0]).write_text("{}")
        (folder / "log.jsonl").write_text("a line\n")


def press_control_c(folder: Path, checkpoint: str) -> None:
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / checkpoint).write_bytes(b"")
    raise KeyboardInterrupt


def interrupt(out: Path, command: str = "calibrate", checkpoint: str = "smc_0.npz", **options) -> None:
    with pytest.raises(Interrupted) as stopped, run_folder(out, command, **{**SETTINGS, **options}) as folder:
        press_control_c(folder, checkpoint)
    assert stopped.value.going_on == "--resume"
    assert stopped.value.folder == str(out)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_finished_run_is_replaced_only_when_asked(command, tmp_path):
    finish(tmp_path, command)
    assert json.loads((tmp_path / "run.json").read_text())["status"] == "done"
    for other in COMMANDS:
        with pytest.raises(InputError, match=f"holds a finished run of {command}.*--overwrite"):
            finish(tmp_path, other)
    assert (tmp_path / "log.jsonl").read_text() == "a line\n"
    finish(tmp_path, command, overwrite=True)
    assert (tmp_path / "log.jsonl").read_text() == "a line\n"


HOLDER = """
import sys, time
from pathlib import Path
from rfdropo_bayes.model.run_folder import run_folder
with run_folder(Path(sys.argv[1]), sys.argv[2]):
    print("running", flush=True)
    time.sleep(600)
"""


@pytest.mark.parametrize("options", [{}, {"resume": True}, {"overwrite": True}])
def test_a_folder_in_which_another_program_is_running_is_refused_until_that_has_ended(tmp_path, options):
    """Killed without warning, the other program leaves no lock behind."""
    other = subprocess.Popen([sys.executable, "-c", HOLDER, tmp_path, "calibrate"], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == "running\n"
        with pytest.raises(InputError, match=r"another program is running in this folder; wait until it has ended"):
            finish(tmp_path, **options)
    finally:
        other.kill()
        other.communicate()
    finish(tmp_path, overwrite=True)


def test_results_without_a_record_are_not_replaced_either(tmp_path):
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(InputError, match="holds a finished run"):
        check_folder(tmp_path, "calibrate")


def test_an_interrupted_run_goes_on_or_is_given_up_but_not_forgotten(tmp_path):
    interrupt(tmp_path)
    assert json.loads((tmp_path / "run.json").read_text())["status"] == "interrupted"
    with pytest.raises(InputError, match="interrupted run of calibrate; go on with --resume"):
        finish(tmp_path)
    with pytest.raises(InputError, match="which audit cannot resume"):
        finish(tmp_path, "audit", resume=True)
    finish(tmp_path, resume=True)
    assert (tmp_path / "checkpoints" / "smc_0.npz").exists()
    finish(tmp_path, overwrite=True)
    assert not (tmp_path / "checkpoints").exists()


def test_a_training_that_was_killed_is_not_started_anew_by_accident(tmp_path):
    interrupt(tmp_path, "train", "model.zip")
    with pytest.raises(InputError, match="interrupted run of train; go on with --resume"):
        check_folder(tmp_path, "train")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"tables": {"robot": "smooth_arm", "inference": {"rollouts": 200}}},
            "inference.rollouts was 100 and is now 200",
        ),
        ({"tables": {"robot": "smooth_arm"}}, "inference.rollouts was 100 and is now not set"),
        ({"data": {"demo_1": "abd"}}, "data.demo_1 was abc and is now abd"),
        ({"options": {"seed": 3}}, "options.seed was not set and is now 3"),
    ],
)
def test_a_run_does_not_go_on_with_other_settings(change, message, tmp_path):
    interrupt(tmp_path)
    with pytest.raises(InputError, match=message):
        finish(tmp_path, resume=True, **change)


def test_a_resume_that_is_refused_leaves_the_robot_that_the_run_began_with(tmp_path):
    (tmp_path / "arm.toml").write_text("time_step_s = 0.01")
    record = {"tables": {"robot": "arm.toml"}, "folder": tmp_path}
    interrupt(tmp_path / "run", **record)
    (tmp_path / "arm.toml").write_text("time_step_s = 0.02")
    with pytest.raises(InputError, match="other settings: robot was"):
        finish(tmp_path / "run", resume=True, **record)
    assert (tmp_path / "run" / "robot.toml").read_text() == "time_step_s = 0.01"
    finish(tmp_path / "run", resume=True, tables={"robot": "robot.toml"}, folder=tmp_path / "run")


def test_a_run_goes_on_where_its_folder_was_moved_with_its_recordings(tmp_path, monkeypatch):
    """The recordings' hashes say that they are the same; others of their names are not."""
    monkeypatch.delenv("RFDROPO_DATA", raising=False)
    path = own_experiment(tmp_path / "here")
    interrupt(path.parent / "run", tables=read_tables(path), folder=path.parent, data={"one": "abc"})
    path.parent.rename(tmp_path / "there")
    path = tmp_path / "there" / path.name
    moved = {"tables": read_tables(path), "folder": path.parent}
    with pytest.raises(InputError, match=r"data\.fit was"):
        finish(path.parent / "run", resume=True, **moved, data={"one": "abd"})
    finish(path.parent / "run", resume=True, **moved, data={"one": "abc"})


def test_a_robot_of_a_program_is_kept_where_another_file_of_its_name_lies_about(tmp_path, monkeypatch):
    """What is run from a folder with the robot's file, changed in Python, is read back as it was run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.toml").write_text((REPOSITORY / "models" / "robots" / "smooth_arm.toml").read_text())
    model = Model(Robot.load("robot.toml").with_changes(time_step_s=0.02), priors={"young_modulus": {}})
    finish(tmp_path / "run", tables=model.tables(), folder=model.folder, texts=model.texts())
    assert Model.read(tmp_path / "run" / "config.toml").robot.time_step_s == 0.02


def test_a_run_that_failed_early_may_be_repeated(tmp_path):
    with pytest.raises(InputError, match="diverged"), run_folder(tmp_path, "simulate", **SETTINGS):
        raise InputError("diverged")
    finish(tmp_path, "simulate")


def own_experiment(folder: Path) -> Path:
    """An experiment with its own robot, recording and mechanism beside it."""
    (folder / "data").mkdir(parents=True)
    (folder / "arm.toml").write_text((REPOSITORY / "models/robots/smooth_arm.toml").read_text())
    (folder / "data" / "one.nc").write_bytes((REPOSITORY / "experiments/demo/demo_1.nc").read_bytes())
    (folder / "mine.py").write_text("class Mine:\n    pass\n")
    path = folder / "own.toml"
    path.write_text(
        'robot = "arm.toml"\n[data]\nformat = "netcdf"\nfit = ["data/*.nc"]\n'
        '[model]\nmechanisms = ["mine.py:Mine", "payload"]\n'
    )
    return path


def test_the_folder_of_a_run_holds_what_it_needs(tmp_path, monkeypatch):
    monkeypatch.delenv("RFDROPO_DATA", raising=False)
    path, out = own_experiment(tmp_path / "project"), tmp_path / "elsewhere" / "run"
    _, tables = load_experiment(path)
    finish(out, tables=tables, folder=path.parent)
    experiment, again = load_experiment(out / "config.toml")
    assert experiment.robot == "robot.toml"
    assert experiment.model.mechanisms == ["mine.py:Mine", "payload"]
    monkeypatch.chdir("/")
    look_through(out / "config.toml")
    assert (out / "robot.toml").read_text() == (path.parent / "arm.toml").read_text()
    assert (out / "mine.py").exists()
    assert self_contained(again, out, out) == again  # running the copy changes nothing
    finish(out, tables=again, folder=out, overwrite=True)


def test_code_of_one_name_in_two_folders_stays_two(tmp_path, monkeypatch):
    monkeypatch.delenv("RFDROPO_DATA", raising=False)
    path, out = own_experiment(tmp_path / "project"), tmp_path / "run"
    sources = ["mine.py:Mine", "lab/mine.py:Mine", "../mine.py:Mine"]
    for number, source in enumerate(sources):
        file = path.parent / source.partition(":")[0]
        file.parent.mkdir(exist_ok=True)
        file.write_text(f"class Mine:\n    number = {number}\n")
    path.write_text(path.read_text().replace('"mine.py:Mine"', ", ".join(f'"{source}"' for source in sources)))
    finish(out, tables=load_experiment(path)[1], folder=path.parent)
    copies = [name.partition(":")[0] for name in load_experiment(out / "config.toml")[0].model.mechanisms[:3]]
    assert [f"number = {number}" in (out / name).read_text() for number, name in enumerate(copies)] == [True] * 3
    again = load_experiment(out / "config.toml")[1]
    assert self_contained(again, out, out) == again


def test_files_that_are_named_and_missing_are_found_out_at_once(tmp_path, monkeypatch):
    monkeypatch.delenv("RFDROPO_DATA", raising=False)
    path = own_experiment(tmp_path)
    look_through(path)
    with pytest.raises(InputError, match=r"two\.nc: no such file"):
        look_through(path, ['data.test=["data/two.nc"]'])
    with pytest.raises(InputError, match=r"leg\.toml: no such robot file"):
        look_through(path, ["robot=leg.toml"])


REFUSED = [
    ["calibrate", "none.toml"],
    ["audit", "none.toml"],
    ["design", "none.toml"],
    ["simulate", "none.toml"],
    ["predict", str(DEMO), "--from", "none", "--commands", "x.nc", "--out", "next"],
    ["calibrate", str(DEMO), "--set", 'data.fit=["none.nc"]'],
    ["audit", str(DEMO), "--from", "none"],
    ["report", "none"],
    ["export", "none", "--phi"],
]
TRIED = """
import json, sys
from rfdropo_bayes.cli import main
for arguments in json.loads(sys.argv[1]):
    sys.argv = ["rfdropo", *arguments]
    try:
        main()
    except SystemExit as done:
        heavy = {"jax", "pandas", "xarray", "scipy"} & set(sys.modules)
        print(json.dumps([done.code, sorted(heavy)]))
"""


def test_nothing_heavy_is_imported_before_inputs_are_looked_at(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    program = [sys.executable, "-c", TRIED, json.dumps(REFUSED)]
    done = subprocess.run(program, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert [json.loads(line) for line in done.stdout.splitlines()] == [[2, []]] * len(REFUSED), done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == len(REFUSED)
    assert all("none" in line for line in lines)


WRITERS = {
    "text": lambda path: write_text(path, "x" * 100_000),
    "line": lambda path: append_line(path, "x" * 100_000),
    "checkpoint": lambda path: Checkpoint(path, "").save({"x": np.arange(100_000)}, {}),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_full_disk_is_one_line_and_leaves_no_half_file(kind, tmp_path):
    """The limit on the size of files stands for the end of the disk: the system refuses the rest of what is written."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(InputError, match="make room on the disk") as raised:
            WRITERS[kind](tmp_path / "file")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "\n" not in str(raised.value)
    assert [path.name for path in tmp_path.iterdir()] == (["file"] if kind == "line" else [])


@pytest.mark.parametrize(("cut", "kept"), [(3, [0, 1]), (1, [0, 1, 2])])
def test_a_ledger_whose_last_line_a_kill_has_cut_is_gone_on_with(cut, kept, tmp_path):
    path = tmp_path / "ledger.jsonl"
    for index in range(3):
        append_line(path, json.dumps({"index": index}))
    os.truncate(path, path.stat().st_size - cut)  # of one byte: the newline alone is missing
    for index in range(3, 6):
        append_line(path, json.dumps({"index": index}))
    assert [line["index"] for line in read_lines(path)] == [*kept, 3, 4, 5]


def test_a_file_is_replaced_whole_or_stays(tmp_path):
    path = tmp_path / "file"
    write_text(path, "before")

    def fail(partial: Path) -> None:
        partial.write_text("half")
        raise RuntimeError

    with pytest.raises(RuntimeError), whole(path) as partial:
        fail(partial)
    assert path.read_text() == "before"
    assert [found.name for found in tmp_path.iterdir()] == ["file"]


SHORT = ['data.fit=[{observations="demo/demo_1.nc", rows=[0, 40]}]', "data.test=[]", "inference.method=smc"]


@pytest.mark.slow
def test_an_interrupted_calibration_says_how_to_go_on_and_does(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    out = tmp_path / "run"
    settings = [
        word
        for override in [*SHORT, "inference.particles=50", "inference.rollouts=1500"]
        for word in ("--set", override)
    ]
    words = [sys.executable, "-m", "rfdropo_bayes", "calibrate", str(DEMO), "--out", str(out), *settings]
    running = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not (out / "log.jsonl").exists():
        assert running.poll() is None, "the run ended before it could be interrupted"
        time.sleep(0.05)
    running.send_signal(2)
    _, said = running.communicate(timeout=120)
    assert running.returncode == 3
    assert "Traceback" not in said
    last = said.splitlines()[-1]
    assert str(out) in last
    assert last.endswith("--resume")
    changed = subprocess.run([*words, "--resume", "--set", "seed=5"], env=environment, capture_output=True, text=True)
    assert changed.returncode == 2
    assert "seed was 1 and is now 5" in changed.stderr
    done = subprocess.run([*words, "--resume"], env=environment, capture_output=True, text=True)
    assert done.returncode == 0
    assert json.loads((out / "run.json").read_text())["status"] == "done"
    again = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert again.returncode == 2
    assert "--overwrite" in again.stderr
    simulated = subprocess.run(
        [sys.executable, "-m", "rfdropo_bayes", "simulate", str(out / "config.toml"), "--out", str(tmp_path / "next")],
        env=environment,
        cwd="/",
        capture_output=True,
    )
    assert simulated.returncode == 0


def test_an_audit_whose_minutes_were_up_goes_on_with_more_of_them(tmp_path):
    tables = {"robot": "smooth_arm", "audit": {"minutes": 1.0}}
    finish(tmp_path, "audit", tables=tables)
    finish(tmp_path, "audit", tables=tables | {"audit": {"minutes": 9.0}}, resume=True)
    with pytest.raises(InputError, match=r"other settings: audit\.bootstraps"):
        finish(tmp_path, "audit", tables=tables | {"audit": {"minutes": 9.0, "bootstraps": 299}}, resume=True)
