"""Error figures against hand-made paths, and the rule that splits a motion from the hold after it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.prediction.predictive import with_repeats_marked
from rfdropo_bayes.report import MeasuredPath, score
from rfdropo_bayes.report.scores import measured_paths, settled_rows


def path(position: np.ndarray, name: str = "r", mask: np.ndarray | None = None, group: int = -1) -> MeasuredPath:
    rows, markers = position.shape[:2]
    mask = np.ones((rows, markers), dtype=bool) if mask is None else mask
    return MeasuredPath(name, 0.1 * np.arange(rows), position, mask, tuple(f"m{i}" for i in range(markers)), group)


def test_a_constant_offset_is_its_length_in_millimetres() -> None:
    position = np.random.default_rng(0).normal(0.0, 0.05, (30, 2, 3))
    figures = score({"r": position + np.array([0.003, 0.0, 0.004])}, [path(position)])
    assert figures is not None
    assert figures.over_time == {"m0": pytest.approx(5.0), "m1": pytest.approx(5.0)}
    assert figures.headline == pytest.approx(5.0)
    assert figures.moving is None
    assert score({}, []) is None


def test_masked_rows_do_not_count_and_recordings_are_pooled_by_rows() -> None:
    still = np.zeros((30, 1, 3))
    mask = np.ones((30, 1), dtype=bool)
    mask[:10] = False
    wrong = still.copy()
    wrong[:10] += 1.0  # only where masked
    wrong[10:, 0, 0] = 0.001
    figures = score({"a": wrong, "b": still}, [path(still, "a", mask), path(still[:30], "b")])
    assert figures is not None
    assert figures.over_time["m0"] == pytest.approx(np.sqrt(20 / 50))
    assert figures.recordings["a"].over_time == pytest.approx(1.0)
    nothing = score({"a": wrong}, [path(still, "a", np.zeros((30, 1), dtype=bool))])
    assert nothing is not None
    assert nothing.over_time["m0"] is None


def test_predictions_of_another_shape_are_refused() -> None:
    with pytest.raises(InputError, match="r: prediction and recording"):
        score({"r": np.zeros((3, 1, 3))}, [path(np.zeros((4, 1, 3)))])


def ramp_and_hold(moving: int, held: int) -> np.ndarray:
    x = np.concatenate([np.linspace(0.0, 0.1, moving, endpoint=False), np.full(held, 0.1)])
    return np.stack([x, 0 * x, 0 * x], axis=-1)[:, None]


def test_the_hold_begins_where_the_pose_stays_within_the_tolerance() -> None:
    """A ramp of 100 mm in 50 rows comes within 5 mm of its end 2 rows before it gets there."""
    assert settled_rows([path(ramp_and_hold(50, 50))]) == [48]
    assert settled_rows([path(ramp_and_hold(90, 10))]) == [None]  # too short to be called a hold
    assert settled_rows([path(np.zeros((40, 1, 3)))]) == [None]  # nothing moves
    assert settled_rows([path(np.random.default_rng(0).normal(0.0, 0.05, (100, 1, 3)))]) == [None]


def test_repeats_are_cut_at_one_row() -> None:
    early, late = ramp_and_hold(40, 60), ramp_and_hold(60, 40)
    alone = settled_rows([path(early, "a"), path(late, "b")])
    together = settled_rows([path(early, "a", group=0), path(late, "b", group=0)])
    assert alone[0] != alone[1]
    assert together[0] == together[1]


def test_the_two_parts_are_scored_apart() -> None:
    measured = ramp_and_hold(50, 50)
    predicted = measured.copy()
    predicted[:48, 0, 1] += 0.002
    predicted[48:, 0, 1] += 0.007
    figures = score({"r": predicted}, [path(measured)])
    assert figures is not None
    assert figures.moving == pytest.approx(2.0)
    assert figures.final == pytest.approx(7.0)
    assert figures.recordings["r"].rows_moving == 48
    assert figures.headline == pytest.approx(np.sqrt((48 * 2.0**2 + 52 * 7.0**2) / 100))


def test_predictions_of_repeats_are_cut_where_the_recordings_are(run) -> None:
    """Among the recordings of their role: what was fitted and what was not are scored apart."""
    trajectories = [*run.fit, *run.test]
    unmarked = [replace(prediction, repeat_group=-1) for prediction in run.record.recordings]
    marked = with_repeats_marked(unmarked, trajectories)
    assert [prediction.repeat_group for prediction in marked] == [-1, -1, -1, 0, 0]
    again = [replace(run.fit[0], dataset=run.test[0].dataset), *run.fit[1:], *run.test]
    assert [prediction.repeat_group for prediction in with_repeats_marked(unmarked, again)] == [-1, -1, -1, 0, 0]
    rows = settled_rows([MeasuredPath.of_prediction(prediction) for prediction in marked[3:]])
    assert rows == settled_rows(measured_paths(run.test))
    assert rows[0] == rows[1]
