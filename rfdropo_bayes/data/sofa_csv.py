"""Episodes of the SOFA trunk (the paper's simulator) as CSV.

Timing. Row 0 is the initial state; row k + 1 is the state after action k, 5 simulation steps of 0.01 s later. So the
observations are 0.05 s apart, and action k is commanded at the time of row k: command row k, the cumulative
displacement after action k, is in force from ``time[k]`` until ``time[k + 1]``. Before the first action the command is
zero.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rfdropo_bayes.data import actions
from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.recorded import Measured, Origin, SentCommands
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError

FORMAT = "sofa-csv"
STEP = 0.01  # [s]
STEPS_PER_ACTION = 5
POINTS = 21
_COLUMNS = [f"{axis}{point}" for point in range(POINTS) for axis in "xyz"]
_CUBE = [f"cube_{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
_GOAL = ["goal_x", "goal_y", "goal_z"]
_MILLIMETRE = 1e-3


def read_sofa_csv(path: Path) -> Trajectory:
    """One episode: 21 centre-line points p00 (base) ... p20 (tip), eight cables, and the cube if there is one.

    Raises:
        InputError: on a damaged file (see ``CsvTable``), a wrong action, or an episode that was cut short.
    """
    table = CsvTable(path, ["action", *_COLUMNS])
    acted = actions.read_actions(table.numbers(["action"])[:, 0], str(path))
    _check_whole(table)
    time = STEP * STEPS_PER_ACTION * np.arange(len(table))
    settings = actions.SETTINGS | {"simulation_step": STEP, "steps_per_action": STEPS_PER_ACTION}
    if all(name in table for name in _GOAL):
        settings["goal"] = (_MILLIMETRE * table.numbers(_GOAL)[0]).tolist()
    return Trajectory.build(
        Origin(
            name=path.stem,
            robot="trunk_sofa",
            format=FORMAT,
            synthetic=True,
            provenance=f"{path.name}: SOFA simulation",
            settings=settings,
        ),
        SentCommands(
            command_time=time[:-1],
            command=actions.cumulative_displacement(acted),
            command_unit="m",
            cable_names=actions.CABLE_NAMES,
        ),
        Measured(
            time=time,
            position=_MILLIMETRE * table.points(_COLUMNS),
            marker_names=[f"p{point:02d}" for point in range(POINTS)],
            object_pose=table.pose(_CUBE, _MILLIMETRE),
        ),
    )


def _check_whole(table: CsvTable) -> None:
    if "terminal" not in table:
        return
    terminal = table.frame["terminal"].astype(str).str.strip().str.lower().isin(["true", "1", "1.0"]).to_numpy()
    if not terminal[-1]:
        raise InputError(
            "the episode does not end (its last row is not terminal): rows are missing",
            where=f"{table.path}, row {len(table) - 1}",
            remedy="fetch it again, or set terminal to True there if the episode was meant to stop",
        )
