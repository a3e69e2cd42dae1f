"""``rfdropo check``: what it says of recordings that fit the robot, and of those that do not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from rfdropo_bayes.cli.check_command import ending
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.named_columns import METRES, CsvColumns, axes_matrix
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs import check as check_verb
from rfdropo_bayes.verbs import numerical_error
from rfdropo_bayes.verbs.check import Check, run_check
from rfdropo_bayes.verbs.motion_direction import Direction, Paths, direction_doubt, direction_of
from rfdropo_bayes.verbs.numerical_error import measure_numerical_error, nominal_markers, numerical_error_lines
from rfdropo_bayes.verbs.placement import placement_hints

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo" / "demo_1.nc"
EXPERIMENT = """
robot = "smooth_arm"
[data]
format = "csv"
fit = ["run.csv"]
[data.columns]
time = "t"
commands = [{commands}]
command_unit = "mm"
positions = [["x1", "y1", "z1"], ["x2", "y2", "z2"], ["x3", "y3", "z3"], ["x4", "y4", "z4"]]
position_unit = "mm"
{more}
[model.priors]
{priors} = {{}}
"""
FOUR = '"c1", "c2", "c3", "c4"'


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Pictures are drawn for the test that looks at one: they are nine tenths of what a check costs."""
    if request.function is not test_a_recording_that_fits_is_described_and_drawn:
        monkeypatch.setattr(check_verb, "save_recording", lambda recording, rest, file: file.touch())


@cache
def demo() -> Trajectory:
    """The recording that all tests change."""
    return Trajectory.load(DEMO)


@cache
def demo_table() -> pd.DataFrame:
    """The demo in millimetres, as a CSV file has it."""
    columns = {"t": demo().time}
    for k, point in enumerate(np.moveaxis(demo().position, 1, 0), start=1):
        columns |= {f"{axis}{k}": 1e3 * point[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"c{k}": 1e3 * values for k, values in enumerate(demo().command_at(demo().time).T, start=1)}
    return pd.DataFrame(columns)


def written(
    tmp_path: Path, commands: str = FOUR, more: str = "", priors: str = "young_modulus", time: np.ndarray | None = None
) -> Path:
    """An experiment with a recording of the demo that was written as CSV, with other times where they are given."""
    table = demo_table() if time is None else demo_table().assign(t=time)
    table.to_csv(tmp_path / "run.csv", index=False)
    path = tmp_path / "own.toml"
    path.write_text(EXPERIMENT.format(commands=commands, more=more, priors=priors))
    return path


def checked(tmp_path: Path, **changes) -> Check:
    """What check says of what was `written`."""
    return run_check(written(tmp_path, **changes), tmp_path / "pictures")


def demo_spec(integrator: str) -> ModelSpec:
    return ModelSpec(Robot.load("smooth_arm"), simulator=SimulatorTable(integrator=integrator))


def text_of(found: Check) -> str:
    return "\n".join(text for _, text in found.lines)


def test_a_recording_that_fits_is_described_and_drawn(tmp_path):
    found = checked(tmp_path)
    assert not found.problems
    for words in (
        "61 rows over 3 s, one every 50 ms",
        "markers m1, m2, m3, m4: as the robot's",
        "no position is masked",
        "4 commands in m: c1, c2, c3, c4; from 0 to 0.0125",
        "the robot calls them up, left, down, right",
        "young_modulus [Pa] ~ LogNormal(median 2e+06, sigma 0.5)",
    ):
        assert words in text_of(found)
    (picture,) = found.files
    assert np.asarray(Image.open(picture).convert("RGB")).std() > 10.0


def test_a_recording_without_the_limits_of_others_has_a_note(tmp_path):
    drives = '[[model.drives]]\nrecordings = "april_*"\nhigh = 0.1\nbeyond = "lost"\n'
    found = checked(tmp_path, more=drives)
    assert not found.problems
    said = "the travel of up, left, down, right is stated for other recordings and not for run:"
    assert [note for note in found.notes if note.startswith(said)]


def test_markers_of_other_names_are_a_problem_that_says_what_to_write(tmp_path):
    found = checked(tmp_path, more='markers = ["base", "low", "high", "tip"]')
    assert any("base, low, high, tip" in p and "m1, m2, m3, m4" in p for p in found.problems)
    assert any("[data.columns] markers" in p for p in found.problems)
    assert len(found.problems) == 1


def test_another_number_of_commands_is_a_problem(tmp_path):
    found = checked(tmp_path, commands='"c1", "c2", "c3"')
    assert any("3 channels" in p and "4 channels of commands (up, left, down, right)" in p for p in found.problems)
    assert len(found.problems) == 1


def test_everything_that_is_wrong_is_said_at_once(tmp_path):
    found = checked(tmp_path, commands='"c1", "c2", "c3", "c9"', priors="youngs_modulus")
    assert any("c9" in p for p in found.problems)
    mistyped = checked(tmp_path, priors="youngs_modulus")
    assert any("did you mean 'young_modulus'" in p for p in mistyped.problems)


def moved(change) -> list[str]:
    """Hints for a recording of the demo whose positions were changed."""
    dataset = demo().dataset.copy(deep=True)
    dataset["position"] = dataset["position"].copy(data=change(demo().position))
    return placement_hints(Robot.load("smooth_arm"), Trajectory(dataset))


def test_a_recording_in_place_needs_no_hint():
    assert moved(lambda position: position) == []


def test_a_moved_origin_is_named():
    (hint,) = moved(lambda position: position + np.array([0.3, 0.0, -0.2]))
    assert "a shift by (-2" in hint or "a shift by (-3" in hint
    assert "give offset_x, offset_y and offset_z priors as wide" in hint


MILLIMETRES = {"sample_time": 0.05, "commands": ["c"], "command_unit": "m", "positions": [["x", "y", "z"]]}


@pytest.mark.parametrize(("unit", "axes"), [("mm", ("x", "y", "z")), ("cm", ("z", "x", "y"))])
def test_the_line_that_moves_the_origin_leaves_nothing_to_correct(unit, axes):
    """Read with one origin, the hint's takes its place, whatever turn the axes make."""
    robot = Robot.load("smooth_arm")
    columns = CsvColumns(**MILLIMETRES, position_unit=unit, axes=axes, origin=(7.0, 0.0, 0.0))
    base = np.array([0.3, -0.1, 0.4])
    in_file = demo().position @ axes_matrix(axes) + base

    def read(table: CsvColumns) -> list[str]:
        dataset = demo().dataset.copy(deep=True)
        shifted = in_file - METRES[unit] * np.array(table.origin)
        dataset["position"] = dataset["position"].copy(data=shifted @ axes_matrix(table.axes).T)
        return placement_hints(robot, Trajectory(dataset), table)

    (hint,) = read(columns)
    found = [float(value) for value in hint.split("origin = [")[1].split("]")[0].split(",")]
    assert METRES[unit] * np.array(found) == pytest.approx(base, abs=0.02)
    assert read(columns.model_copy(update={"origin": tuple(found)})) == []


def test_a_first_row_with_one_marker_says_so():
    dataset = demo().dataset.copy(deep=True)
    dataset["position"] = dataset["position"].copy(data=demo().position + 0.3)
    mask = demo().position_mask.copy()
    mask[0, 1:] = False
    dataset["position_mask"] = dataset["position_mask"].copy(data=mask)
    (hint,) = placement_hints(Robot.load("smooth_arm"), Trajectory(dataset))
    assert "only m1 is seen in it" in hint


@cache
def demo_motion() -> Paths:
    """The demo beside its nominal model."""
    return Paths(nominal_markers(demo_spec("sdirk2"), demo(), 20.0), demo().position, demo().position_mask)


def turned(matrix: np.ndarray) -> Direction:
    """The direction of a recording of the demo whose positions were turned or mirrored."""
    motion = demo_motion()
    return direction_of([motion._replace(measured=motion.measured @ matrix.T)])


def test_a_recording_in_its_frame_moves_as_commanded():
    found = turned(np.eye(3))
    assert abs(np.degrees(found.turn)) < 6.0
    assert found.agreement > 0.9
    assert direction_doubt(found, ("x", "y", "z")) is None


@pytest.mark.parametrize("axes", [("y", "-x", "z"), ("-x", "-y", "z")])
def test_a_frame_turned_about_the_body_is_named_with_the_axes_that_mend_it(axes):
    """The file has the base's motion in a frame of its own; the named axes read it right."""
    found = turned(axes_matrix(axes))
    doubt = direction_doubt(found, ("x", "y", "z"))
    assert doubt is not None
    named = tuple(word.strip(' "') for word in doubt.split("axes = [")[1].split("]")[0].split(","))
    assert axes_matrix(named) @ axes_matrix(axes) == pytest.approx(np.eye(3))
    assert ("commands of the other sign" in doubt) == (axes[0] == "-x")


def test_a_turn_between_quarters_names_the_cables_and_a_mirror_is_told_apart():
    angle = np.radians(60.0)
    c, s = np.cos(angle), np.sin(angle)
    found = turned(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
    doubt = direction_doubt(found, ("x", "y", "z"))
    assert doubt is not None
    assert "axes =" not in doubt
    assert abs(float(doubt.split("add ")[1].split()[0]) - 60.0) < 6.0
    mirror = turned(np.diag([-1.0, 1.0, 1.0]))
    doubt = direction_doubt(mirror, None)
    assert doubt is not None
    assert "as in a mirror" in doubt


@pytest.mark.parametrize("axes", [("-x", "y", "z"), ("x", "-y", "z"), ("y", "x", "z"), ("-y", "-x", "z")])
def test_a_left_handed_frame_is_named_with_the_axes_that_mend_it(axes):
    doubt = direction_doubt(turned(axes_matrix(axes)), ("x", "y", "z"))
    assert doubt is not None
    assert "as in a mirror" in doubt
    named = tuple(word.strip(' "') for word in doubt.split("axes = [")[1].split("]")[0].split(","))
    assert axes_matrix(named) @ axes_matrix(axes) == pytest.approx(np.eye(3))


@pytest.mark.parametrize("axes", [(2, 0, 1), (1, 2, 0)])
def test_turned_axes_are_named(axes):
    """An arm that is straight along z shows where z went, not how far it turned about itself."""
    (hint,) = moved(lambda position: position[..., list(axes)])
    named = hint.split("axes = ")[1].split("]")[0]
    assert named.split(", ")[2].strip('"') == "xyz"[axes.index(2)]


def test_axes_are_named_as_the_file_needs_them():
    """Of a recording that was read with wrong axes, the hint's axes take their place and leave none to correct."""
    robot, axes = Robot.load("smooth_arm"), ("y", "z", "x")
    dataset = demo().dataset.copy(deep=True)
    file = demo().position @ axes_matrix(("x", "z", "-y"))  # what reads right with these axes
    dataset["position"] = dataset["position"].copy(data=file @ axes_matrix(axes).T)
    columns = CsvColumns(**MILLIMETRES, position_unit="m", axes=axes)
    (hint,) = placement_hints(robot, Trajectory(dataset), columns)
    named = tuple(word.strip(' "') for word in hint.split("axes = [")[1].split("]")[0].split(","))
    assert named[2] == "-y"
    assert "do not show its turn about z" in hint
    dataset["position"] = dataset["position"].copy(data=file @ axes_matrix(named).T)
    assert placement_hints(robot, Trajectory(dataset), columns.model_copy(update={"axes": named})) == []


def test_recordings_alike_share_a_note(tmp_path):
    path = written(tmp_path)
    (tmp_path / "again.csv").write_bytes((tmp_path / "run.csv").read_bytes())
    text = path.read_text().replace('fit = ["run.csv"]', 'fit = ["run.csv", "again.csv"]')
    path.write_text(text.replace('position_unit = "mm"', 'position_unit = "mm"\naxes = ["x", "z", "-y"]'))
    found = run_check(path, tmp_path / "pictures")
    assert sum("off the undeformed robot" in note for note in found.doubts) == 1
    assert any(note.startswith("run, again: the first row is ") for note in found.doubts)


@pytest.mark.parametrize(
    ("factor", "doubtful"), [pytest.param(1.0, False, marks=pytest.mark.slow), (10.0, False), (100.0, True)]
)
def test_pulls_longer_than_the_body_are_doubtful_and_those_beyond_a_limit_a_note(tmp_path, factor, doubtful):
    """Commands in another unit than the file says; a line for each recording, whatever its cables."""
    path, run = written(tmp_path), demo_table().copy()
    names = [name for name in run if name.startswith("c")]
    run[names] *= factor * 8.0 / np.abs(run[names].to_numpy()).max()  # mm
    run.to_csv(tmp_path / "run.csv", index=False)
    found = run_check(path, tmp_path / "pictures")
    doubts = [line for line in found.doubts if "pulls that no body of" in line]
    assert bool(doubts) == doubtful
    assert not doubts or "look at command_unit" in doubts[0]
    assert sum("drives are held at the limits" in line for line in found.notes) == int(factor == 10.0)


def listed(tmp_path: Path, *copies: str, fit: str, test: str = "[]", more: str = "") -> Check:
    """What check says of copies of one recording, some of them under the names of folders."""
    path = written(tmp_path, more=more)
    for copy in copies:
        (tmp_path / copy).parent.mkdir(exist_ok=True)
        (tmp_path / copy).write_bytes((tmp_path / "run.csv").read_bytes())
    path.write_text(path.read_text().replace('fit = ["run.csv"]', f"fit = {fit}\ntest = {test}"))
    return run_check(path, tmp_path / "pictures")


def test_files_of_one_name_in_several_folders_are_told_apart_whatever_their_role(tmp_path):
    found = listed(tmp_path, "a/run.csv", "b/run.csv", fit='["a/run.csv", "run.csv"]', test='["b/run.csv"]')
    assert not found.problems
    labels = [label for label, _ in found.lines if label.startswith(("fit:", "test:"))]
    assert labels == ["fit: a/run", f"fit: {tmp_path.name}/run", "test: b/run"]
    assert len(set(found.files)) == 3


def test_a_file_that_is_listed_twice_is_one_problem(tmp_path):
    found = listed(tmp_path, fit='["run.csv", "run.*"]')
    (problem,) = found.problems
    assert "is listed twice; list each recording once" in problem


def test_an_experiment_without_a_test_recording_is_told_so(tmp_path):
    assert any(note.startswith("no recording is kept for a test") for note in checked(tmp_path).notes)
    found = listed(tmp_path, fit='["run.csv"]', test='["no_such.csv"]')
    assert not any(note.startswith("no recording is kept for a test") for note in found.notes)


def test_a_copy_of_a_recording_is_doubtful_and_the_last_line_says_so(tmp_path):
    found = listed(tmp_path, "copy.csv", fit='["run.csv"]', test='["copy.csv"]')
    assert not found.problems
    (doubt,) = found.doubts
    assert doubt.startswith("run, copy are the same to the last digit")
    assert ending(found).endswith("look first at the line above that is marked DOUBTFUL")
    assert ending(checked(tmp_path)) == "nothing keeps this experiment from running"


def rewritten(tmp_path: Path, old: str, new: str, change: Callable[[pd.DataFrame], object] | None = None) -> Check:
    """What check says after the experiment, and perhaps the table of its recording, were changed by hand."""
    path, file = written(tmp_path), tmp_path / "run.csv"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    if change is not None:
        table = pd.read_csv(file)
        change(table)
        table.to_csv(file, index=False)
    return run_check(path, tmp_path / "pictures")


def test_a_robot_that_moves_though_no_command_changes_is_doubtful(tmp_path):
    def same(table: pd.DataFrame) -> None:
        table.loc[:, ["c1", "c2", "c3", "c4"]] = 2.0

    def come_to_rest(table: pd.DataFrame) -> None:
        same(table)
        places = [f"{axis}{k}" for axis in "xyz" for k in (1, 2, 3, 4)]
        table.loc[len(table) // 2 :, places] = table.loc[len(table) // 2, places].to_numpy()

    (doubt,) = [d for d in rewritten(tmp_path, "c1", "c1", same).doubts if "no command changes" in d]
    assert doubt.startswith("run: no command changes")
    assert doubt.endswith("look at the columns of the commands")
    assert not any("no command changes" in d for d in rewritten(tmp_path, "c1", "c1", come_to_rest).doubts)
    assert not any("no command changes" in d for d in checked(tmp_path).doubts)


@pytest.mark.parametrize(("names", "doubtful"), [(("m1", "m2", "m3", "m5"), True), (("m1", "m2", "m3", "m4"), False)])
def test_a_marker_under_another_name_than_the_robots_is_doubtful(tmp_path, names, doubtful):
    listed_names = ", ".join(f'"{name}"' for name in names)
    found = rewritten(tmp_path, 'position_unit = "mm"', f'position_unit = "mm"\nmarkers = [{listed_names}]')
    doubts = [d for d in found.doubts if "run: m5 of the recording is no marker of the robot, and m4 of the robot" in d]
    assert bool(doubts) == doubtful
    assert not found.problems


def test_a_robot_file_that_is_not_there_is_compared_with_those_beside_it(tmp_path):
    (tmp_path / "arm.toml").write_text('name = "arm"')
    with pytest.raises(InputError, match=r"amr\.toml: no such robot file; did you mean 'arm\.toml'\? correct the path"):
        rewritten(tmp_path, 'robot = "smooth_arm"', 'robot = "amr.toml"')


def test_a_group_that_names_no_recording_is_doubtful(tmp_path):
    path = written(tmp_path)
    path.write_text(path.read_text() + '[model.groups]\nmonday = ["run", "runn_*"]\n')
    found = run_check(path, tmp_path / "pictures")
    assert [doubt for doubt in found.doubts if "monday: 'runn_*' matches no recording" in doubt] == found.doubts


@pytest.mark.parametrize(
    ("table", "doubtful"),
    [
        ("[model.fixed]\ntrunk_mass = 0.09\n", False),
        ("[model.fixed]\ntrunk_mass = 6.0\n", True),
        ('trunk_mass = { distribution = "LogNormal", median = 6.0, sigma = 0.1 }\n', True),
        ('trunk_mass = { distribution = "LogNormal", median = 6.0, sigma = 3.0 }\n', False),
    ],
)
def test_a_mass_that_no_soft_robot_has_is_doubtful_wherever_it_is_given(tmp_path, table, doubtful):
    """Within the bounds of the robot's file, and heavier than any metal."""
    path = written(tmp_path)
    path.write_text(path.read_text() + table)
    found = run_check(path, tmp_path / "pictures")
    assert not found.problems
    assert [doubt.startswith("trunk_mass is") and "kg/m3" in doubt for doubt in found.doubts] == [True] * doubtful


@pytest.mark.parametrize("key", ["candidates", "exclude"])
def test_a_mechanism_that_an_audit_would_not_find_is_a_problem(tmp_path, key):
    path = written(tmp_path)
    path.write_text(path.read_text() + f'[audit]\n{key} = ["backlsh"]\n')
    (problem,) = run_check(path, tmp_path / "pictures").problems
    assert "backlsh" in problem
    assert "did you mean 'backlash'" in problem


def test_two_markers_of_the_same_columns_are_refused(tmp_path):
    path = written(tmp_path)
    path.write_text(path.read_text().replace('["x4", "y4", "z4"]', '["x3", "y3", "z3"]'))
    with pytest.raises(InputError, match="markers 3 and 4 of positions have the same columns"):
        run_check(path, tmp_path / "pictures")


def test_markers_in_another_order_are_named():
    (hint,) = moved(lambda position: position[:, ::-1])
    assert "m1, m2, m3, m4 look like m4, m3, m2, m1" in hint


def test_a_wrong_unit_stretches_the_robot():
    hints = moved(lambda position: 10.0 * position)
    assert any("apart in the first row" in hint and "position_unit" in hint for hint in hints)


ROWS = np.arange(61)
STAMPS = 1_530_018_381_010_286_378 + 50_000_000 * ROWS  # [ns]


def test_times_in_another_unit_are_a_problem_that_names_it_before_anything_is_simulated(tmp_path):
    found = checked(tmp_path, time=STAMPS)
    (problem,) = found.problems
    assert problem.startswith("run: 61 rows over 3e+09 s would be ")
    assert '"ns" taken for "s", with rows 50 ms apart: correct time_unit under [data.columns]' in problem
    assert any(note.startswith("run: rows are 5e+07 s apart") for note in found.doubts)


def test_nanoseconds_are_read_to_the_last(tmp_path):
    found = checked(tmp_path, more='time_unit = "ns"', time=STAMPS)
    assert not found.problems
    assert "61 rows over 3 s, one every 50 ms" in text_of(found)


def test_stamps_coarser_than_rows_are_a_problem_that_names_sample_time(tmp_path):
    (problem,) = checked(tmp_path, time=0.25 * (ROWS // 5)).problems
    assert "run.csv, row 1: time does not increase (48 times)" in problem
    assert "give sample_time = 0.05" in problem


def test_stamps_of_arrival_and_a_clock_that_jumps_are_doubtful(tmp_path):
    arrival = checked(tmp_path, time=0.3 * (ROWS // 6) + 3e-6 * (ROWS % 6))
    assert any("stamps of arrival" in note and "give sample_time = 0.05" in note for note in arrival.doubts)
    assert "61 rows over 3 s, one every 50 ms" in text_of(arrival)
    assert "no position is masked" in text_of(arrival)
    assert not arrival.problems
    jump = checked(tmp_path, time=0.05 * ROWS + 600.0 * (ROWS > 29))
    assert any("run: the clock jumps by 600 s before row 30" in note for note in jump.doubts)


def test_another_kind_of_motion_that_cannot_be_simulated_is_left_out(monkeypatch):
    """It is only compared; a failure of the experiment's own motion is a problem."""

    def failing(spec, recording, longest, never="quasi-static"):
        if spec.simulator.motion == never:
            raise InputError("the simulation ended: diverged", where="[simulator]")
        return np.zeros((len(recording.time), 1, 3))

    monkeypatch.setattr(numerical_error, "nominal_markers", failing)
    assert measure_numerical_error(demo_spec("euler"), demo()).rest is None
    monkeypatch.setattr(numerical_error, "nominal_markers", partial(failing, never="dynamic"))
    with pytest.raises(InputError, match="diverged"):
        measure_numerical_error(demo_spec("euler"), demo())


def test_the_numerical_error_of_step_and_mesh_is_said(monkeypatch):
    """On the demo's own commands a quarter of Euler's step moves the markers by far more than one of SDIRK2's; the
    elements are within 1 % of the way, and the body is too fast to be at rest in every row."""
    found = {name: measure_numerical_error(demo_spec(name), demo()) for name in ("euler", "sdirk2")}
    assert found["sdirk2"].time_step < 0.2 * found["euler"].time_step
    assert 0.0 < found["sdirk2"].elements < 0.01 * found["sdirk2"].way
    assert not found["sdirk2"].rest.enough
    monkeypatch.setattr(numerical_error, "measure_numerical_error", lambda spec, recording: found["euler"])
    lines = numerical_error_lines(demo_spec("euler"), demo())
    sudden = replace(demo_spec("euler"), robot=demo_spec("euler").robot.without_command_timing())
    assert [words for _, words in numerical_error_lines(sudden, demo())][1].endswith("ramp_s in the robot file")
    assert lines[0][0] == "numerics"
    assert "a quarter of the time step (10 ms, euler)" in lines[0][1]
    assert lines[1][1].startswith("twice the elements:")
    assert "of the way" in lines[1][1]
    assert 'motion = "dynamic" is right' in lines[2][1]
