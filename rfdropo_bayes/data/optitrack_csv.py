"""OptiTrack recordings of the physical trunk, driven open loop by discrete actions.

Timing. The recording loop notes the time, reads the last motion-capture frame, and only then sends the next action: row
k has the pose at ``time[k]``, and action k is sent right after ``time[k]``. Command row k, the cumulative nominal
displacement after action k, is therefore in force from ``time[k]``; row k + 1 shows its effect after about 0.1 s.
Action 0 is an exception. Reading the first frame took until row 1 was due (rows 0 and 1 hold the same frame, taken at
row 1). So action 0 was sent within one frame before ``time[1]``, and action 1 right after ``time[1]``. Nothing was sent
while rows repeat the initial action. The motors' response is not recorded: delays, ramps and limits are parameters of
the model.

The cube's pose is not masked: a jump of the cube alone does not make the trunk's markers wrong.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import actions
from rfdropo_bayes.data.csv_table import CsvTable
from rfdropo_bayes.data.faults import fill_missing, find_faults
from rfdropo_bayes.data.recorded import Measured, Origin, SentCommands
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError

FORMAT = "optitrack-csv"
FRAME_PERIOD = 1.0 / 120.0  # [s]
MARKERS = 4
_COLUMNS = [f"{axis}{marker}" for marker in range(1, MARKERS + 1) for axis in "xyz"]
_CUBE = ["x5", "y5", "z5", "rot_x5", "rot_y5", "rot_z5", "rot_w5"]
_MILLIMETRE = 1e-3


def read_optitrack_csv(path: Path, *, mask_missing: bool = False) -> Trajectory:
    """One recording: markers m1 (base) ... m4 (tip) on the centre line, eight cables, and the cube's pose.

    The file's frame is the robot's base frame already.

    Args:
        path: the file.
        mask_missing: leave lost markers and cubes out instead of rejecting the file.

    Raises:
        InputError: on a damaged file (see ``CsvTable``), a wrong action, or rows missing in the middle.
    """
    table = CsvTable(path, ["timestamp", *_COLUMNS, "action"])
    acted = actions.read_actions(table.numbers(["action"])[:, 0], str(path))
    time = table.numbers(["timestamp"])[:, 0]
    time = time - time[0]
    position = _MILLIMETRE * table.points(_COLUMNS, allow_missing=mask_missing)
    names = [f"m{marker}" for marker in range(1, MARKERS + 1)]
    faults = find_faults(time, position, where=str(path), names=names)
    _check_gaps(time, str(path))
    return Trajectory.build(
        Origin(
            name=path.stem,
            robot="trunk_physical",
            format=FORMAT,
            provenance=f"{path.name}: OptiTrack",
            settings=actions.SETTINGS | faults.settings,
        ),
        SentCommands(
            command_time=_sending_times(time, position),
            command=actions.cumulative_displacement(acted),
            command_unit="m",
            cable_names=actions.CABLE_NAMES,
        ),
        Measured(
            time=time,
            position=fill_missing(time, position),
            marker_names=names,
            position_mask=faults.mask,
            object_pose=table.pose(_CUBE, _MILLIMETRE, allow_missing=mask_missing),
        ),
    )


def _sending_times(time: Float[np.ndarray, " rows"], position: Float[np.ndarray, "rows 4 3"]) -> np.ndarray:
    sent = time[:-1].copy()
    if len(sent) > 1 and np.array_equal(position[0], position[1], equal_nan=True):
        sent[0] = max(sent[0], sent[1] - FRAME_PERIOD)
    return sent


def _check_gaps(time: Float[np.ndarray, " rows"], where: str) -> None:
    """Rows lost in the middle would silently shift every later command; the first gap is long in every recording."""
    gaps = np.diff(time)
    typical = float(np.median(gaps))
    if np.any(gaps[1:] > 1.8 * typical):
        row = int(np.argmax(gaps[1:] > 1.8 * typical)) + 2
        raise InputError(
            f"{gaps[row - 1]:.3g} s pass before this row, {typical:.3g} s before the others: rows are missing",
            where=f"{where}, row {row}, column 'timestamp'",
            remedy="fetch it again, or use rows = [first, last] on a whole recording to leave rows out",
        )
