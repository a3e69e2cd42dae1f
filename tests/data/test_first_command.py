"""The command before the first row: given, recognised from the first rows, carried along."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data import (
    DataSpec,
    Measured,
    Origin,
    SentCommands,
    Trajectory,
    first_row_only,
    load_recordings,
    load_unseen,
    read_asl_csv,
)
from rfdropo_bayes.data.first_command import _decides, begun_alike, begun_from, recognised
from rfdropo_bayes.errors import InputError

CHANNELS, PERIOD = 3, 0.05
GAIN = np.random.default_rng(9).normal(0.0, 1.0, (CHANNELS, 6))


def moved(command: np.ndarray, initial: np.ndarray, stiffness: float = 60.0, damping: float = 10.0) -> np.ndarray:
    """A damped oscillator for each coordinate of two markers, a little nonlinear, in equilibrium at first [m]."""
    step, level = 1e-3, np.repeat(command, round(PERIOD / 1e-3), axis=0) @ GAIN
    level = level + 0.5 * level**2
    start = initial @ GAIN
    state, speed = start + 0.5 * start**2, np.zeros(6)
    rows = [state.copy()]
    for row, target in enumerate(level, start=1):
        speed = speed + step * (stiffness * (target - state) - damping * speed)
        state = state + step * speed
        if row % round(PERIOD / 1e-3) == 0:
            rows.append(state.copy())
    return np.array(rows).reshape(-1, 2, 3)


def recording(command: np.ndarray, initial: np.ndarray, seed: int = 0) -> Trajectory:
    position = np.array([[0.0, 0.1, 0.2], [0.0, 0.2, 0.3]]) + moved(command, initial)
    position += np.random.default_rng(seed).normal(0.0, 0.5e-3, position.shape)
    time = PERIOD * np.arange(len(position))
    names = [f"c{k}" for k in range(CHANNELS)]
    return Trajectory.build(
        Origin(name="made", robot="", format="csv"),
        SentCommands(
            command_time=time[:-1], command=command, command_unit="m", cable_names=names, initial_command=command[0]
        ),
        Measured(time=time, position=position, marker_names=["a", "b"]),
    )


def walk(rows: int, hold: int, rng: np.random.Generator) -> np.ndarray:
    """One channel moves by 10 mm every ``hold`` rows."""
    moves = np.zeros((rows, CHANNELS))
    at = np.arange(0, rows, hold)
    moves[at, rng.integers(0, CHANNELS, len(at))] = 0.01 * rng.choice([-1.0, 1.0], len(at))
    return np.cumsum(moves, axis=0)


@pytest.mark.parametrize("hold", [1, 4, 20])
def test_a_start_is_never_taken_for_the_other(hold):
    """Walks from rest at zero, and walks that go on from their first command; a step that is held; eight of each."""
    decided = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        command = walk(80, hold, rng)
        ahead = command + 0.03 * rng.choice([-1.0, 1.0], CHANNELS)
        from_rest, going_on = recording(command, 0.0 * command[0], seed), recording(ahead, ahead[0], seed)
        assert recognised(going_on).rule in ("first", "undecided")
        decided += recognised(from_rest).rule == "zero"
    # a first step of one walk may be too small, beside what a linear robot misses, to be told: then it is undecided
    assert decided >= 6


def test_a_robot_that_moves_while_the_first_command_is_held_was_not_at_rest_under_it():
    """Positions bend by their square, so that a linear robot misses more than the two starts differ by."""
    told, far = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        command = np.repeat(0.03 * rng.uniform(-1.0, 1.0, (8, CHANNELS)), 20, axis=0)
        for initial in (0.0 * command[0], command[0]):
            made = recording(command, initial, seed)
            bent = made.dataset.copy()
            bent["position"] = bent["position"] + 50.0 * (bent["position"] - bent["position"].mean("time")) ** 2
            told.append(recognised(Trajectory(bent)).rule)
            bent["command"] = bent["command"] + 0.1  # servos that rest far from zero
            far.append(recognised(Trajectory(bent)).rule)
    assert told[::2] == ["zero"] * 8
    assert "zero" not in told[1::2] + far


def test_a_step_that_is_held_is_told_from_a_motion_that_dies_away():
    command = np.tile([[0.03, 0.0, -0.02]], (60, 1))
    assert recognised(recording(command, np.zeros(3))).rule == "zero"
    whole = recording(np.concatenate([np.zeros((10, 3)), command]), np.zeros(3))
    late = whole.slice_rows(14, 60)
    assert recognised(late).why == "assumed: the first rows do not decide"
    assert recognised(late).rule == "undecided"


def test_undecided_recordings_begin_as_the_others_of_their_experiment():
    command = np.tile([[0.03, 0.0, -0.02]], (60, 1))
    late = recording(np.concatenate([np.zeros((10, 3)), command]), np.zeros(3)).slice_rows(14, 60)
    ahead = command + walk(60, 4, np.random.default_rng(0))
    open_end, from_rest, going_on = (
        begun_from(run, None) for run in (late, recording(command, np.zeros(3)), recording(ahead, ahead[0]))
    )
    np.testing.assert_array_equal(open_end.initial_command, command[0])
    assert not begun_alike([open_end, from_rest])[0].initial_command.any()
    assert not begun_alike([open_end], [from_rest])[0].initial_command.any()
    for others in ([going_on], [from_rest, going_on], []):
        np.testing.assert_array_equal(begun_alike([open_end, *others])[0].initial_command, command[0])


def test_asl_pulses_that_begin_with_the_recording(datasets, tmp_path):
    """Rows 500 on: at rest, and the first command is a pulse. Rows 750 on: the pulse has been held for 2.5 s."""
    folder = datasets / "asl_trunk"
    whole = read_asl_csv(
        folder / "observations_motor2_test_allmotors.csv.gz", folder / "control_inputs_controlled_20.csv.gz"
    )
    for first, rule in ((500, "zero"), (750, "first"), (1500, "zero"), (1750, "first")):
        assert recognised(whole.slice_rows(first, first + 1500)).rule == rule


@pytest.fixture
def files(tmp_path):
    """A CSV file of a walk from rest, and the [data] table that reads it."""
    made = recording(walk(60, 4, np.random.default_rng(1)), np.zeros(CHANNELS))
    rows = np.column_stack([made.time[:-1], made.command, made.position[:-1].reshape(len(made.time) - 1, -1)])
    header = "t,u0,u1,u2,ax,ay,az,bx,by,bz"
    np.savetxt(tmp_path / "own.csv", rows, delimiter=",", header=header, comments="")
    columns = {
        "time": "t", "commands": ["u0", "u1", "u2"], "command_unit": "m", "position_unit": "m",
        "positions": [["ax", "ay", "az"], ["bx", "by", "bz"]],
    }  # fmt: skip
    return tmp_path, {"format": "csv", "fit": ["own.csv"], "columns": columns}


def test_a_rule_stands_for_all_files_or_for_one(files):
    folder, table = files
    found = load_recordings(DataSpec.parse(table), folder)[0]
    assert not found.initial_command.any()
    assert found.first_command.startswith("zero (recognised: the first rows differ by")
    first = load_recordings(DataSpec.parse(table | {"initial_command": "first"}), folder)[0]
    np.testing.assert_array_equal(first.initial_command, first.command[0])
    assert first.first_command.endswith("m (initial_command in [data])")
    entry = {"observations": "own.csv", "initial_command": [0.0, 0.01, 0.0]}
    given = load_recordings(DataSpec.parse(table | {"initial_command": "first", "fit": [entry]}), folder)[0]
    np.testing.assert_array_equal(given.initial_command, [0.0, 0.01, 0.0])
    assert given.sha256 != first.sha256
    with pytest.raises(InputError, match="initial_command has 2 values for 3 command channels"):
        load_recordings(DataSpec.parse(table | {"initial_command": [0.0, 0.0]}), folder)


def test_netcdf_carries_it_and_a_piece_knows_its_own(files, tmp_path):
    folder, table = files
    found = load_recordings(DataSpec.parse(table), folder)[0]
    found.save(tmp_path / "kept.nc")
    again = load_recordings(DataSpec.parse({"format": "netcdf", "fit": ["kept.nc"]}), tmp_path)[0]
    assert again.first_command == found.first_command
    zero = load_recordings(
        DataSpec.parse({"format": "netcdf", "fit": ["kept.nc"], "initial_command": "first"}), tmp_path
    )
    np.testing.assert_array_equal(zero[0].initial_command, found.command[0])
    piece = found.slice_rows(20, 40)
    np.testing.assert_array_equal(piece.initial_command, found.command[19])
    assert piece.first_command.endswith("(in force before row 20)")
    assert found.slice_rows(0, 40).first_command == found.first_command


def test_no_later_row_has_a_say_in_a_prediction(files):
    """The start of a recording to predict is not recognised, as that takes later rows; a rule is kept."""
    folder, table = files
    seen = load_unseen(DataSpec.parse(table), folder, "own.csv")
    assert seen.first_command.endswith("(assumed; set data.initial_command if it was another)")
    np.testing.assert_array_equal(seen.initial_command, seen.command[0])
    assert not load_unseen(DataSpec.parse(table | {"initial_command": "zero"}), folder, "own.csv").initial_command.any()


@pytest.mark.parametrize("hold", [1, 5], ids=["every row", "held"])
def test_motors_show_where_they_stand_before_the_first_command(asl_tables, write, tmp_path, hold):
    """Angles of the first row come before the first command, also of a prediction, which sees no later row."""
    observations, commands = asl_tables()
    turned = np.arange(60)[:, None] // hold * hold + np.array([2.0, 3.0, -1.0, 0.5, 0.0, 4.0])
    observations[[f"phi{motor}" for motor in range(1, 7)]] = turned
    write(observations, tmp_path / "o.csv"), write(commands, tmp_path / "c.csv")
    entry = {"observations": "o.csv", "commands": "c.csv"}
    spec = DataSpec.parse({"format": "asl-csv", "fit": [entry]})
    for found in (load_recordings(spec, tmp_path)[0], load_unseen(spec, tmp_path, "c.csv", "o.csv", begun="zero")):
        np.testing.assert_allclose(np.rad2deg(found.initial_command), turned[0])
        assert found.first_command.endswith("rad (the motors' angles in the first row)")
    assert first_row_only(found).motor_angle is None
    given = load_recordings(DataSpec.parse({"format": "asl-csv", "fit": [entry], "initial_command": "zero"}), tmp_path)
    assert not given[0].initial_command.any()


def test_a_motion_that_no_linear_robot_follows_does_not_show_its_start():
    """The first rows favour a start at zero by 2.3 against 3.3 mm, as in servos far from zero; later rows are missed by
    9.8 mm anyway."""
    assert _decides(2.3, 3.3, 0.5)
    assert not _decides(2.3, 3.3, 9.8)
