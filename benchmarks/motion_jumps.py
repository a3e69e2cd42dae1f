"""Does the motion of a trunk that slides over a cube's edge change continuously with its parameters?

For every parameter the largest change of a marker between neighbours of a scan, then of a scan of that interval, and so
on: in a continuous motion it shrinks as the intervals do, by 32 from one to the next. See reports/table1/README.md.

    python benchmarks/motion_jumps.py
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from rfdropo_bayes.workflow.tasks import NOISE, task_problem

# Near truth 60 of Table I, whose cube is too heavy to move.
PLACE = {
    "young_modulus": 4.7532e6,
    "trunk_mass": 0.13266,
    "poisson_ratio": 0.41861,
    "cube_mass": 0.5038,
    "friction": 0.9208,
}
WIDTH, POINTS, SCANS = 0.006, 33, 4


def main() -> None:
    """Print the table."""
    problem = task_problem("TrunkPush", 40, False, False, 0)
    fixed = {name: {**PLACE, **NOISE}[name] for name in problem.names}
    print(f"| parameter | {' | '.join(f'scan {k + 1} [mm]' for k in range(SCANS))} |")
    print(f"|{'---|' * (SCANS + 1)}")
    for name, place in PLACE.items():
        low, high = (1.0 - WIDTH) * place, (1.0 + WIDTH) * place
        largest = []
        for _ in range(SCANS):
            values = np.linspace(low, high, POINTS)
            batch = {other: np.full(POINTS, value) for other, value in fixed.items()} | {name: values}
            motion = np.asarray(problem.observe(batch).position)
            changes = np.abs(np.diff(motion, axis=0)).max(axis=(1, 2, 3, 4))
            at = int(np.argmax(changes))
            largest.append(1e3 * float(changes[at]))
            low, high = values[at], values[at + 1]
        print(f"| {name} | {' | '.join(f'{change:.2g}' for change in largest)} |")


if __name__ == "__main__":
    main()
