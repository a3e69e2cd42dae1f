"""Which faults the tests see: each fault of `tools/mutants.toml` is put into a copy of the tree; its tests run there.

A fault that survives is a test that is missing. Before tests are made cheaper, and after, the same faults must be
killed; `reports/checks/mutants.csv` says which were, and at which commit.

    python tools/mutants.py                  all of them (half an hour)
    python tools/mutants.py --only 3 17      some, by number
    python tools/mutants.py --json FILE      the table as JSON, too
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).resolve().parents[1]
FAULTS = Path(__file__).with_suffix(".toml")
PYTEST = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not slow and not notebook"]
FAILED, PASSED = 1, 0  # exit statuses of pytest


class Fault(NamedTuple):
    """An edit of one file of the package that its tests must see."""

    kind: str
    file: str
    old: str
    new: str
    tests: list[str]


class Answer(NamedTuple):
    """What the tests said of a fault, and the processor seconds that they took."""

    number: int
    killed: bool
    seconds: float
    fault: Fault


def read_faults() -> list[Fault]:
    """The faults; exits with a message where one does not fit the code any more."""
    faults = [Fault(**table) for table in tomllib.loads(FAULTS.read_text(encoding="utf-8"))["fault"]]
    stale = [
        f"{number}: {fault.file} has the old text {count} times, not once: {fault.old}"
        for number, fault in enumerate(faults, 1)
        if (count := (REPOSITORY / "rfdropo_bayes" / fault.file).read_text(encoding="utf-8").count(fault.old)) != 1
    ]
    missing = [
        f"{number}: there is no {test}"
        for number, fault in enumerate(faults, 1)
        for test in fault.tests
        if not (REPOSITORY / test.partition("::")[0]).exists()
    ]
    if stale or missing:
        sys.exit("\n".join(["faults that do not fit the code:", *stale, *missing]))
    return faults


def copy_tree(to: Path) -> None:
    """Copy what git knows or would add, as it is now."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=REPOSITORY,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    for name in filter(None, listed.split("\0")):
        if (REPOSITORY / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(REPOSITORY / name, to / name)


def judged(number: int, fault: Fault, tree: Path) -> Answer:
    """Put a fault into the tree, run its tests, and take it out again."""
    path = tree / "rfdropo_bayes" / fault.file
    right = path.read_text(encoding="utf-8")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    try:
        path.write_text(right.replace(fault.old, fault.new), encoding="utf-8")
        # Python takes a compiled module of the same size and second for the present one.
        os.utime(path, (number, number))
        run = subprocess.run(
            [*PYTEST, *fault.tests],
            cwd=tree,
            env=os.environ | {"PYTHONPATH": str(tree), "RFDROPO_DATA": data_folder(), "PYTHONDONTWRITEBYTECODE": ""},
            capture_output=True,
            text=True,
        )
    finally:
        path.write_text(right, encoding="utf-8")
    if run.returncode not in (FAILED, PASSED):
        sys.exit(f"fault {number}: pytest ended with status {run.returncode}\n{run.stdout}{run.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Answer(number, run.returncode == FAILED, seconds, fault)


def data_folder() -> str:
    """Where the measured data are, for a tree that lies elsewhere."""
    return os.environ.get("RFDROPO_DATA", str(REPOSITORY.parent / "shared" / "datasets"))


def main() -> None:
    """Print a line for each fault; exit with status 1 if one survives."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="numbers of faults")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table as JSON")
    given = parser.parse_args()
    faults = dict(enumerate(read_faults(), 1))
    answers = []
    with tempfile.TemporaryDirectory() as folder:
        copy_tree(Path(folder))
        for number in given.only or faults:
            found = judged(number, faults[number], Path(folder))
            answers.append(found)
            said = "killed  " if found.killed else "SURVIVED"
            print(f"{number:3} {said} {found.seconds:5.0f} s  {found.fault.file}: {found.fault.kind}", flush=True)
    survived = [found.number for found in answers if not found.killed]
    print(
        f"{len(answers) - len(survived)} of {len(answers)} faults killed"
        + (f"; survived: {survived}" if survived else "")
    )
    if given.json:
        rows = [{**found._asdict(), "fault": found.fault._asdict()} for found in answers]
        given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    sys.exit(bool(survived))


if __name__ == "__main__":
    main()
