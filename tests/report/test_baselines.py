"""The predictors without a simulator: closed forms on made-up data, known figures on measured data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rfdropo_bayes.data import DataSpec, Measured, Origin, SentCommands, Trajectory, command_openings, load_recordings
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.report import BaselineErrors, baseline_errors
from rfdropo_bayes.report.baselines import Predictor, held_pose, mean_pose, repeated_mean, with_fitted_commands
from rfdropo_bayes.report.fir import fit_fir
from rfdropo_bayes.report.scores import measured_paths


def test_held_poses(run: Any) -> None:
    first = run.fit[1]
    np.testing.assert_array_equal(held_pose(first)(first)[37], first.position[0])
    pose = mean_pose([first])(run.test[0])
    usable = first.position_mask[:, 1]
    np.testing.assert_allclose(pose[5, 1], first.position[usable, 1].mean(axis=0))


def linear(toy: SimpleNamespace, name: str, rows: int, rng: np.random.Generator) -> Trajectory:
    """Positions that are exactly a weighted sum of the commands 0, 0.2 and 0.5 s ago, and a pose."""
    time = toy.STEP * np.arange(rows)
    command = rng.normal(0.0, 0.01, (rows, 2))
    history = np.stack([np.concatenate([np.zeros((lag, 2)), command[: rows - lag]]) for lag in (0, 2, 5)])
    weights = np.random.default_rng(9).normal(size=(3, 2, 2, 3))
    position = np.einsum("ltc,lcma->tma", history, weights) + np.array([0.0, 0.0, 0.1])
    return Trajectory.build(
        Origin(name=name, robot="toy", format="csv"),
        SentCommands(command_time=time, command=command, command_unit="m", cable_names=("a", "b")),
        Measured(time=time, position=position, marker_names=toy.MARKERS),
    )


def test_the_regression_finds_a_finite_impulse_response(toy: SimpleNamespace) -> None:
    """Most rows: commands beyond those of the training are cut to their range, and a few rows see one."""
    rng = np.random.default_rng(3)
    fit, test = [linear(toy, "a", 200, rng), linear(toy, "b", 150, rng)], linear(toy, "c", 100, rng)
    fir = fit_fir(fit, [[0], [1]], degree=1)
    assert fir.lags[-1] > 0.49
    error = np.linalg.norm(fir.predict(test) - test.position, axis=-1)
    assert np.median(error) < 1e-5
    assert np.median(np.linalg.norm(test.position - test.position.mean(axis=0), axis=-1)) > 1e-2


def test_cubic_terms_help_where_the_response_is_cubic(toy: SimpleNamespace) -> None:
    rng = np.random.default_rng(5)
    fit = [toy.recording(f"fit_{i}", toy.commands(rng, 200, hold=False), rng) for i in range(3)]
    test = [toy.recording("test", toy.commands(rng, 200, hold=False), rng)]
    errors = baseline_errors(fit, test)
    assert headline(errors["fir_cubic"]) < 0.75 * headline(errors["fir_linear"])
    assert headline(errors["fir_linear"]) < 0.5 * headline(errors["mean_pose"])


def test_a_masked_row_teaches_nothing(run: Any) -> None:
    """Nonsense in masked rows changes no prediction."""
    source = run.fit[1]
    spoiled = source.dataset.copy(deep=True)
    spoiled["position"].values[~source.position_mask] = 0.3
    one, other = (fit_fir([t, run.fit[0]], [[0], [1]], degree=1) for t in (source, Trajectory(spoiled)))
    np.testing.assert_allclose(one.predict(run.test[0]), other.predict(run.test[0]), rtol=1e-9)


def repeated(fit: Sequence[Trajectory]) -> Predictor:
    return repeated_mean(measured_paths(fit), {t.name: command_openings(t) for t in fit})


def test_the_mean_of_repeats_is_that_of_the_same_commands_alone(run: Any) -> None:
    """Its last pose is held where the repeats end; a recording of other commands has none."""
    a, c = run.fit[0], run.fit[2]
    b = a.with_attributes(name="again")
    short = a.slice_rows(0, 20)
    other = Trajectory(c.dataset.assign(command=c.dataset["command"] + 0.01)).with_attributes(name="other")
    predicted = repeated([short, other])(b)
    usable = short.position_mask[:, 1]
    np.testing.assert_allclose(predicted[:21][usable, 1], a.position[:21][usable, 1], atol=1e-12)
    last = short.position[usable, 1][-1]
    np.testing.assert_allclose(predicted[21:, 1], np.broadcast_to(last, b.position[21:, 1].shape), atol=1e-12)
    with pytest.raises(InputError, match="no other fitted recording has the same commands"):
        repeated([a, b])(other)
    slow = Trajectory(a.dataset.assign_coords(command_time=2.0 * a.dataset["command_time"]))
    slow = slow.with_attributes(name="slow")
    with pytest.raises(InputError, match="no other fitted recording has the same commands"):  # at the same speed
        repeated([a, b])(slow)
    assert with_fitted_commands([short], [b, other, slow]) == [b.name]


def test_repeats_of_the_paper_s_trunk_are_predicted_by_their_mean(datasets: Path) -> None:
    """Who has seen the other repeats of an experiment is 2.7 mm off; left-out repeats are shown beside it."""
    every = load_recordings(DataSpec(format="optitrack-csv", fit=["sim2real_trunk/*.csv"]), datasets)
    left_out = ("171618", "184917", "104902")
    fit = [t for t in every if not t.name.endswith(left_out)]
    test = [t for t in every if t.name.endswith(left_out)]
    assert (len(fit), len(test)) == (8, 3)
    errors = baseline_errors(fit, test)
    assert headline(errors["repeated_mean"]) == pytest.approx(2.67, abs=0.05)


def headline(errors: BaselineErrors) -> float:
    assert errors.test is not None
    assert errors.test.headline is not None
    return errors.test.headline


def test_known_figures_of_the_trunk_that_pushes_a_cube(datasets: Path) -> None:
    """The initial pose held: 78 mm over time."""
    spec = DataSpec(format="optitrack-csv", fit=["sim2real_trunk/AKLWI_*.csv"], test=["sim2real_trunk/AKLWI2_*.csv"])
    fit, test = load_recordings(spec, datasets), load_recordings(spec, datasets, "test")
    errors = baseline_errors(fit, test)
    assert headline(errors["initial_pose"]) == pytest.approx(77.8, rel=0.02)
    held = errors["initial_pose"].test
    assert held is not None
    assert {row.rows_moving for row in held.recordings.values()} == {28}
    assert held.moving is not None
    assert held.moving < 50.0
    assert held.final == pytest.approx(88.3, abs=1.0)


def test_known_figures_of_the_hanging_trunk(datasets: Path) -> None:
    """Seconds 100-150 after a fit on seconds 0-20 or 0-100: constant pose 65.4 mm, cubic regression 18.8 mm or less."""
    recording = {
        "observations": "asl_trunk/observations_controlled_1.csv.gz",
        "commands": "asl_trunk/control_inputs_controlled_1.csv.gz",
    }
    whole = load_recordings(DataSpec(format="asl-csv", fit=[recording]), datasets)[0]
    test = [whole.slice_rows(10000, 15000).resample(0.05)]
    short = baseline_errors([whole.slice_rows(0, 2000).resample(0.05)], test)
    assert headline(short["mean_pose"]) == pytest.approx(65.4, abs=0.3)
    assert headline(short["fir_linear"]) < 24.0
    long = baseline_errors([whole.slice_rows(0, 9999).resample(0.05)], test)
    assert headline(long["fir_cubic"]) < 18.8


def test_recordings_without_some_markers_are_scored_by_those_that_all_have(run: Any) -> None:
    """Whatever the order of the markers: a calibration must not end when its baselines are counted."""
    names = run.fit[0].marker_names
    plain = baseline_errors(run.fit, run.test, markers=names[:1])
    turned = [Trajectory(t.dataset.sel(marker=list(names[::-1]))) for t in run.fit]
    fewer = [Trajectory(t.dataset.sel(marker=[names[0]])) for t in run.test]
    found = baseline_errors([turned[0], *run.fit[1:]], fewer, markers=names)
    assert plain["mean_pose"].test is not None
    for name, errors in plain.items():
        assert errors.test == found[name].test, name
    assert baseline_errors(run.fit, fewer, markers=names[1:]) == {}
