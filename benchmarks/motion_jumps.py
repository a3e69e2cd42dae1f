"""Where does the motion of TrunkPush jump as a parameter changes, and do posteriors mislead there?

Each parameter is scanned 1 % to either side of a truth of Table I: 33 values, then 33 values within the interval of the
largest change, until that change is below 1e-6 mm or the interval has been cut eight times. A continuous motion changes
by up to 32 times less in each scan. The first table tells by how much it did; the second, which posteriors mislead
where a change of 0.1 mm is left after four scans. See reports/table1/README.md.

    python benchmarks/motion_jumps.py [--truths N]       (10 minutes on 2 processors)
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from studies.comparison import misleads
from studies.table1 import OWN
from studies.virtual_tasks import TASKS, task_problem

FITS = Path(__file__).parents[1] / "reports" / "table1" / "push" / "fits.jsonl"
TASK, ALONG = "TrunkPush", ("young_modulus", "poisson_ratio", "friction")
WIDTH, POINTS, SCANS, SMALL = 0.01, 33, 8, 1e-9  # [m]
JUMPS, AFTER = (0.1, 1.0), 4  # mm; scans
RATIOS = (10.0, 20.0, 40.0)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truths", type=int, help="only so many")
    arguments = parser.parse_args()
    problem = task_problem(TASK, 40, False, False, 0)
    fits = [json.loads(line) for line in FITS.read_text(encoding="utf-8").splitlines()]
    own = [fit for fit in fits if fit["job"]["row"] in OWN and fit["job"]["truths"] == "off-centre"]
    truths = {fit["job"]["index"]: fit["result"]["truth"] for fit in own}
    places: dict[int, dict[str, list[float]]] = {}
    for index, truth in list(truths.items())[: arguments.truths]:
        places[index] = {name: changes(problem, truth, name) for name in ALONG}
        print(
            index, {name: [f"{1e3 * size:.1e}" for size in found] for name, found in places[index].items()}, flush=True
        )
    print(table_of_ratios([found for along in places.values() for found in along.values()]))
    left = {index: max(found[:AFTER][-1] for found in along.values()) for index, along in places.items()}
    print(table_of_posteriors([fit for fit in own if fit["job"]["index"] in left], left))


def table_of_ratios(places: list[list[float]]) -> str:
    """How many times less the motion changes from scan to scan."""
    names = [f"below {RATIOS[0]:g}", *(f"{a:g} to {b:g}" for a, b in pairwise(RATIOS))]
    lines = [
        f"| scan | places | {' | '.join(names)} times less | largest change [mm] |",
        f"|{'---|' * (3 + len(names))}",
    ]
    for scan in range(1, SCANS):
        ratios = [found[scan - 1] / max(found[scan], 1e-15) for found in places if len(found) > scan]
        if ratios:
            edges = (0.0, *RATIOS)
            counts = [sum(low <= ratio < high for ratio in ratios) for low, high in pairwise(edges)]
            largest = 1e3 * max(found[scan] for found in places if len(found) > scan)
            lines.append(f"| {scan + 1} | {len(ratios)} | {' | '.join(map(str, counts))} | {largest:.1e} |")
    over = sum(found[-1] > SMALL for found in places)
    return "\n".join([*lines, "", f"{over} of {len(places)} places never come to {1e3 * SMALL:g} mm.", ""])


def table_of_posteriors(fits: list[dict[str, Any]], left: Mapping[int, float]) -> str:
    """Posteriors that mislead, and changes that are left."""
    lines = [
        f"| row | posteriors | fits | {' | '.join(f'beyond {size:g} mm' for size in JUMPS)} | median [mm] |",
        f"|{'---|' * (4 + len(JUMPS))}",
    ]
    for row in OWN:
        for misled in (True, False):
            chosen = [f for f in fits if f["job"]["row"] == row and misleads(TASKS[TASK], f["result"]) == misled]
            sizes = 1e3 * np.array([left[fit["job"]["index"]] for fit in chosen])
            counts = " | ".join(str(int(np.sum(sizes > size))) for size in JUMPS)
            middle = f"{np.median(sizes):.2g}" if len(sizes) else "-"
            lines.append(f"| {row} | {'mislead' if misled else 'do not'} | {len(sizes)} | {counts} | {middle} |")
    return "\n".join(lines)


def changes(problem: CalibrationProblem, truth: Mapping[str, float], name: str) -> list[float]:
    """Largest change of a marker's position between neighbours in every scan [m]."""
    low, high = (1.0 - WIDTH) * truth[name], min((1.0 + WIDTH) * truth[name], TASKS[TASK].ranges[name][1])
    found: list[float] = []
    while len(found) < SCANS and (not found or found[-1] > SMALL):
        values = np.linspace(low, high, POINTS)
        fixed = {other: np.full(POINTS, truth[other]) for other in problem.names}
        seen = problem.observe(fixed | {name: values})
        good = np.ravel(seen.status) == 0
        change = np.abs(np.diff(np.asarray(seen.position), axis=0)).max(axis=(1, 2, 3, 4))
        change = np.where(good[1:] & good[:-1], change, 0.0)
        at = int(np.argmax(change))
        low, high = values[at], values[at + 1]
        found.append(float(change.max()))
    return found


if __name__ == "__main__":
    main()
