"""Lists of actions: what they command, and which bring cables where they are to be."""

from __future__ import annotations

import numpy as np

from rfdropo_bayes.data import asl_csv
from rfdropo_bayes.data.actions import CABLES, DISPLACEMENT, actions_of, actions_towards, cumulative_displacement


def test_displacements_are_those_of_their_actions():
    sent = np.random.default_rng(0).integers(0, 2 * CABLES, 50)
    initial = 0.02 * np.arange(CABLES)
    np.testing.assert_array_equal(actions_of(initial + cumulative_displacement(sent), initial), sent)


def test_actions_go_for_the_farthest_cable_and_pass_no_target():
    """Cable 2 is to be pulled by 12 mm, of which actions can do 10; cable 5 to be released by 5 mm, afterwards."""
    target = np.zeros((6, CABLES))
    target[:, 2], target[3:, 5] = 0.012, -0.005
    np.testing.assert_array_equal(actions_towards(target, np.zeros(CABLES)), [2, 2, 13])
    assert not len(actions_towards(np.full((4, CABLES), 0.004), np.zeros(CABLES)))


def test_actions_stay_between_their_targets():
    rng = np.random.default_rng(1)
    target = rng.uniform(-0.02, 0.03, (200, CABLES)).round(4)
    sent = actions_towards(target, np.zeros(CABLES))
    assert 100 < len(sent) <= 200
    level = cumulative_displacement(sent)
    assert np.all(level <= target.max(axis=0) + 1e-12)
    assert np.all(level >= np.minimum(target.min(axis=0), 0.0) - 1e-12)
    assert np.all(np.abs(np.diff(level, axis=0)).sum(axis=1) <= DISPLACEMENT + 1e-12)


def test_a_proposal_is_written_as_the_format_s_commands_are(tmp_path):
    """Degrees, a row every 10 ms: what is read again is what was proposed."""
    import pandas as pd

    time, command = np.array([0.0, 0.025, 0.04]), np.outer([0.1, -0.2, 0.3], np.arange(1.0, 7.0))
    table = pd.DataFrame(asl_csv.command_columns(time, command, 0.06))
    assert list(table) == ["ID", "u1", "u2", "u3", "u4", "u5", "u6"]
    table.to_csv(tmp_path / "next.csv", index=False)
    again = asl_csv.read_asl_start(tmp_path / "next.csv", None)
    np.testing.assert_allclose(again.command, command[[0, 0, 0, 1, 2, 2]], atol=1e-12)
