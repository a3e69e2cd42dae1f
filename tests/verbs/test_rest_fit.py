"""A fit at rest finds what made the rows, and says of what remains where it comes from."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.model.model_spec import ModelSpec, SimulatorTable
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.arrangement import as_written
from rfdropo_bayes.verbs.at_rest import blocks_of, resting
from rfdropo_bayes.verbs.rest_fit import (
    OWN,
    Estimate,
    RestFit,
    estimate_words,
    first_answer,
    least_squares,
    rest_lines,
    rest_notes,
)


def test_least_squares_weigh_measurements_against_priors():
    slope = np.random.default_rng(0).normal(size=(2, 50))
    measured = 0.4 * slope[0]

    def predict(sets: np.ndarray) -> np.ndarray:
        return sets @ np.stack([slope[0], np.zeros(50)])

    measured[3] = np.nan
    z, covariance = least_squares(predict, measured, 2)
    assert z == pytest.approx([0.4, 0.0], abs=1e-3)
    assert covariance[0, 0] < 1e-3
    assert covariance[1, 1] == pytest.approx(1.0)


@cache
def answered() -> RestFit:
    """A robot whose cables have zeros and whose frame is beside the base, as its model does not know."""
    normal = {"distribution": "Normal", "loc": 0.0, "scale": 0.002}
    robot = Robot.outline(name="arm", length=0.1, radius=0.008, cables=3, markers={"tip": 0.1})
    priors = {"initial_displacement": normal, "offset": normal}
    spec = ModelSpec(robot, priors=priors, simulator=SimulatorTable(motion="quasi-static"))
    random = np.random.default_rng(2)
    command = random.normal(size=(90, 3)) * 0.003
    command -= command.mean(axis=1, keepdims=True)
    truth = {"initial_displacement_cable_1": np.array([-0.001]), "offset_x": np.array([0.002])}
    made = resting(spec).markers(command, truth)[0]
    run = Trajectory.from_arrays(
        time=np.arange(90.0),
        position=made + 2e-5 * random.normal(size=made.shape),
        command=command,
        markers=["tip"],
        channels=list(robot.channel_names),
    )
    return first_answer(spec, [run], [], as_written(3, 1))


def test_zeros_and_frame_are_found_and_beat_predictors_without_physics():
    fit = answered()
    found = {each.name: each for each in fit.estimates}
    assert found["offset_x"].value == pytest.approx(0.002, abs=2e-4)
    apart = found["initial_displacement_cable_1"].value - found["initial_displacement_cable_2"].value
    assert apart == pytest.approx(-0.001, abs=2e-4)
    assert fit.unseen[OWN] < 1e-4
    assert fit.unseen[OWN] < min(value for name, value in fit.unseen.items() if name != OWN)
    assert fit.before > 1e-3
    lines = [text for _, text in rest_lines(fit)]
    assert "without physics: cubic FIR" in lines[0]
    assert any("offset x 2" in text for text in lines)
    assert rest_notes(fit) == []


def test_what_is_left_is_told_from_its_form():
    fit = answered()
    drifting = fit.residual + 1e-3 * (fit.rows.time / fit.rows.time[-1])[:, None, None]
    assert any("drifts by" in note for note in rest_notes(fit._replace(residual=drifting)))
    rubbing = fit.residual + 1e-3 * fit.ways[:, 1, None, None]
    assert any("commands 2 that rose" in note for note in rest_notes(fit._replace(residual=rubbing)))
    few = fit._replace(rows=fit.rows.of(np.arange(16)), ways=fit.ways[:16], recording=fit.recording[:16])
    noise = 1e-4 * np.random.default_rng(0).normal(size=(16, *fit.residual.shape[1:]))
    assert not any("that rose" in note for note in rest_notes(few._replace(residual=noise)))
    # A command that rose is a high one in most rows: a slope over it is no friction.
    sloping = fit.residual + 1e-3 * (fit.rows.command[:, 1] / np.ptp(fit.rows.command[:, 1]))[:, None, None]
    assert not any("that rose" in note for note in rest_notes(fit._replace(residual=sloping)))
    worse = fit._replace(unseen={**fit.unseen, OWN: 1.0})
    assert any("without any physics" in note for note in rest_notes(worse._replace(tested=True)))
    assert rest_notes(worse) == []  # regressions on their own rows are no measure


def test_parameters_are_shown_in_units_of_the_bench():
    assert estimate_words(Estimate("offset_x", "m", 0.002, 0.0, 1e-4, False, 0.1)) == "offset x 2 +- 0.1 mm"
    assert estimate_words(Estimate("turn", "rad", np.pi / 2, 0.0, 0.1, False, 0.1)) == "turn 90 +- 5.7 deg"
    assert estimate_words(Estimate("mass", "kg", 0.5, 1.0, 0.1, True, 0.1)) == "mass 0.5 kg (to 10 %)"


def test_stretches_of_rows_keep_their_poses_and_commands():
    random = np.random.default_rng(3)
    command, position = random.normal(size=(600, 2)) * 0.01, random.normal(size=(600, 1, 3)) * 0.01
    run = Trajectory.from_arrays(
        time=0.5 * np.arange(600.0), position=position, command=command, markers=["tip"], channels=["a", "b"]
    )
    fewer = blocks_of(run)
    assert len(fewer.time) == 120
    assert np.diff(fewer.time).max() <= 1.0
    at = [int(np.flatnonzero((run.position == row).all(axis=(1, 2)))[0]) for row in fewer.position]
    assert at[-1] == 599
    assert fewer.command_at(fewer.time) == pytest.approx(run.command_at(run.time[at] - 1e-3))
    assert blocks_of(fewer) is fewer


def test_stretches_of_rows_under_few_commands_of_a_clock_of_their_own():
    random = np.random.default_rng(4)
    run = Trajectory.from_arrays(
        time=0.5 * np.arange(600.0),
        position=random.normal(size=(600, 1, 3)) * 0.01,
        command=random.normal(size=(10, 2)) * 0.01,
        command_time=30.0 * np.arange(10.0),
        markers=["tip"],
        channels=["a", "b"],
    )
    fewer = blocks_of(run)
    at = [int(np.flatnonzero((run.position == row).all(axis=(1, 2)))[0]) for row in fewer.position]
    assert fewer.command_at(fewer.time) == pytest.approx(run.command_at(run.time[at] - 1e-3))
