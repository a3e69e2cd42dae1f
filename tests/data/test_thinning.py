"""Recordings of many rows are looked at, and offered, at the rate that their motion needs."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.thinning import MANY, looked_at, needed_interval, thinning_note


def swinging(hertz: float, rows: int = MANY + 1000, step: float = 1e-3, noise: float = 1e-5) -> Trajectory:
    time = step * np.arange(rows)
    place = np.zeros((rows, 1, 3)) + np.random.default_rng(0).normal(0.0, noise, (rows, 1, 3))
    place[:, 0, 0] += 0.02 * np.sin(2.0 * np.pi * hertz * time)
    sent = np.repeat(np.arange(rows // 100 + 1), 100)[:rows, None] % 7 * 1e-3
    return Trajectory.from_arrays(time=time, position=place, command=sent, markers=["tip"], channels=["c"])


@pytest.mark.parametrize("hertz", [0.5, 3.0])
def test_a_motion_needs_some_fifteen_rows_a_turn(hertz):
    run = swinging(hertz)
    needed = needed_interval(run)
    assert 5.0 < 1.0 / (hertz * needed) < 60.0
    few = looked_at(run)
    assert len(few.time) < len(run.time) * 1e-3 / needed + 2
    assert len(few.command_time) < len(run.time) / 99
    np.testing.assert_array_equal(few.command_at(run.time), run.command_at(run.time))
    grid = np.interp(run.time, few.time, few.position[:, 0, 0])
    np.testing.assert_allclose(grid[: len(few.time)], run.position[: len(few.time), 0, 0], atol=4e-4)
    assert f"its motion needs one every {1e3 * needed:.3g} ms: resample = {needed:.3g}" in thinning_note(run)


def test_few_rows_stay_as_they_are():
    run = swinging(3.0, rows=500, step=0.05)
    assert looked_at(run) is run
    assert thinning_note(run) is None


def test_a_slow_motion_needs_the_slowest_rate_and_a_fast_motion_every_row():
    assert needed_interval(swinging(0.02, rows=3000)) >= 0.05
    assert needed_interval(swinging(180.0, rows=3000)) == pytest.approx(1e-3)
