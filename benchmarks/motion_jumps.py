"""Where does the motion of TrunkPush jump as a parameter changes, and do posteriors mislead there?

Each parameter is scanned 1 % to either side of a truth of Table I: 33 values, then 33 values within the interval of the
largest change, four times in all. In a continuous motion the change that is left is that over a millionth of the first
interval. A change beyond 0.1 mm is a jump. See reports/table1/README.md.

    python benchmarks/motion_jumps.py        (4 minutes on 2 processors)
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rfdropo_bayes.bayes.calibration import CalibrationProblem
from rfdropo_bayes.studies.comparison import misleads
from rfdropo_bayes.studies.table1 import OWN
from rfdropo_bayes.studies.tasks import TASKS, task_problem

FITS = Path(__file__).parents[1] / "reports" / "table1" / "push" / "fits.jsonl"
TASK, ALONG = "TrunkPush", ("young_modulus", "poisson_ratio", "friction")
WIDTH, POINTS, SCANS = 0.01, 33, 4
JUMPS = (0.1, 1.0)  # mm


def main() -> None:
    """Print the table."""
    problem = task_problem(TASK, 40, False, False, 0)
    fits = [json.loads(line) for line in FITS.read_text(encoding="utf-8").splitlines()]
    own = [fit for fit in fits if fit["job"]["row"] in OWN and fit["job"]["truths"] == "off-centre"]
    truths = {fit["job"]["index"]: fit["result"]["truth"] for fit in own}
    left = {index: max(change_left(problem, truth, name) for name in ALONG) for index, truth in truths.items()}
    print(f"| row | posteriors | fits | {' | '.join(f'beyond {size:g} mm' for size in JUMPS)} | median [mm] |")
    print(f"|{'---|' * (4 + len(JUMPS))}")
    for row in OWN:
        for misled in (True, False):
            chosen = [f for f in own if f["job"]["row"] == row and misleads(TASKS[TASK], f["result"]) == misled]
            sizes = 1e3 * np.array([left[fit["job"]["index"]] for fit in chosen])
            counts = " | ".join(str(int(np.sum(sizes > size))) for size in JUMPS)
            words = "mislead" if misled else "do not"
            print(f"| {row} | {words} | {len(sizes)} | {counts} | {np.median(sizes):.2g} |")


def change_left(problem: CalibrationProblem, truth: Mapping[str, float], name: str) -> float:
    """Change of a marker's position over the last interval [m]."""
    low, high = (1.0 - WIDTH) * truth[name], min((1.0 + WIDTH) * truth[name], TASKS[TASK].ranges[name][1])
    change = np.zeros(POINTS - 1)
    for _ in range(SCANS):
        values = np.linspace(low, high, POINTS)
        fixed = {other: np.full(POINTS, truth[other]) for other in problem.names}
        seen = problem.observe(fixed | {name: values})
        good = np.ravel(seen.status) == 0
        change = np.abs(np.diff(np.asarray(seen.position), axis=0)).max(axis=(1, 2, 3, 4))
        change = np.where(good[1:] & good[:-1], change, 0.0)
        at = int(np.argmax(change))
        low, high = values[at], values[at + 1]
    return float(change.max())


if __name__ == "__main__":
    main()
