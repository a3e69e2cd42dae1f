"""Lists of actions, and commands as formats have them."""

from __future__ import annotations

import numpy as np

from rfdropo_bayes.data import asl_csv
from rfdropo_bayes.data.actions import CABLES, DISPLACEMENT, cumulative_displacement


def test_an_action_moves_its_cable_by_one_displacement():
    moved = cumulative_displacement(np.array([-1, 2, 2, 13]))
    wanted = np.zeros((4, CABLES))
    wanted[1:, 2], wanted[2:, 2], wanted[3, 5] = DISPLACEMENT, 2.0 * DISPLACEMENT, -DISPLACEMENT
    np.testing.assert_array_equal(moved, wanted)


def test_a_proposal_is_written_as_the_format_s_commands_are(tmp_path):
    """Degrees, a row every 10 ms: what is read again is what was proposed."""
    import pandas as pd

    time, command = np.array([0.0, 0.025, 0.04]), np.outer([0.1, -0.2, 0.3], np.arange(1.0, 7.0))
    table = pd.DataFrame(asl_csv.command_columns(time, command, 0.06))
    assert list(table) == ["ID", "u1", "u2", "u3", "u4", "u5", "u6"]
    table.to_csv(tmp_path / "next.csv", index=False)
    again = asl_csv.read_asl_start(tmp_path / "next.csv", None)
    np.testing.assert_allclose(again.command, command[[0, 0, 0, 1, 2, 2]], atol=1e-12)
