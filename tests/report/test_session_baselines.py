"""What copies of earlier days say of a new one, on made-up paths."""

from __future__ import annotations

import numpy as np

from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory, command_openings
from rfdropo_bayes.report.baselines import session_baselines
from rfdropo_bayes.report.scores import MeasuredPath, measured_paths

ROWS, SHOWN, STEP = 40, 10, 0.25
RNG = np.random.default_rng(0)
COMMAND = RNG.normal(0.0, 0.01, (ROWS, 2))
PATH = np.cumsum(RNG.normal(0.0, 0.004, (ROWS, 1, 3)), axis=0)
SCALE, SHIFT = 0.5, np.array([0.02, 0.0, -0.01])


def recorded(name, position, command=COMMAND, mask=None):
    time = STEP * np.arange(ROWS)
    return Trajectory.build(
        Origin(name=name, robot="toy", format="csv"),
        SentCommands(command_time=time, command=command, command_unit="m", cable_names=("a", "b")),
        Measured(time=time, position=position, marker_names=("tip",), position_mask=mask),
    )


def of_a_day(command=COMMAND):
    """Errors of each predictor on the rest of a day that is an earlier one scaled and shifted."""
    earlier, day = recorded("june", PATH), recorded("july", SCALE * PATH + SHIFT, command)
    late = np.arange(ROWS)[:, None] > SHOWN
    shown, rest = day.slice_rows(0, SHOWN), recorded("july", day.position, command, late)
    openings = {earlier.name: command_openings(earlier)}
    return day, late[:, 0], session_baselines(shown, [rest], measured_paths([earlier]), openings)


def test_a_day_that_is_an_earlier_one_scaled_is_predicted_by_the_scaled_copy():
    day, late, found = of_a_day()
    errors = {name: row.test.over_time["tip"] for name, row in found.items()}
    away = np.linalg.norm(day.position[late, 0] - day.position[0, 0], axis=-1)
    apart = np.linalg.norm(day.position[late, 0] - PATH[late, 0], axis=-1)
    np.testing.assert_allclose(errors["first_row"], 1e3 * np.sqrt(np.mean(away**2)))
    np.testing.assert_allclose(errors["copied"], 1e3 * np.sqrt(np.mean(apart**2)))
    assert errors["scaled_copy"] < 1e-9


def test_recordings_of_other_commands_are_not_copied():
    *_, found = of_a_day(COMMAND[::-1])
    assert found["first_row"].test is not None
    assert found["copied"].test is None
    assert "no other fitted recording has the same commands" in found["scaled_copy"].reason


def test_a_marker_that_was_lost_in_an_earlier_day_is_not_copied():
    day = recorded("july", PATH)
    lost = MeasuredPath("june", day.time, PATH, np.zeros((ROWS, 1), bool), ("tip",))
    found = session_baselines(day, [day], [lost], {"june": command_openings(day)})
    assert "tip was lost" in found["copied"].reason
