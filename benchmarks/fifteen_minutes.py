"""What do fifteen minutes of reading and typing get? A stranger's recordings, by the README's commands alone.

Writes recordings as a laboratory has them: commands in counts of encoders, positions in millimetres in a frame whose y
axis points up, columns of their own names. They are simulated, of an arm with four cables whose commands arrive 70 ms
late, which no file mentions. Then every command that the README names is typed, from init to predict. Prints words
read, words typed and the time of each command, and fails if the audit does not name the delay, or if the prediction is
off. See docs/tutorial.md.

    python benchmarks/fifteen_minutes.py FOLDER [--look]        (6 minutes of one processor)
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

import rfdropo_bayes as rb

README = Path(__file__).resolve().parents[1] / "README.md"
READING, TYPING = 250.0, 30.0
"""Words in a minute: of a reader, and of somebody who types commands and options."""
DELAY, MODULUS = 0.07, 4.2e5
COUNTS, SPOOL, CLAMP = 4096, 0.012, (35.0, 1420.0, -210.0)  # counts in a turn, [m], [mm]
NOISE = 3e-4  # [m]
COMMANDS = (
    'rfdropo init finger --recording "data/*.csv" --length-mm 250 --radius-mm 12 --segments 1 --mass-g 90 '
    "--counts-per-turn 4096 --spool-radius-mm 12 --gravity +z --defaults",
    "rfdropo check finger/experiment.toml",
    "rfdropo calibrate finger/experiment.toml --set inference.method=laplace --out runs/arm",
    "rfdropo audit finger/experiment.toml --from runs/arm --out runs/audit --set audit.minutes=300",
    "rfdropo calibrate runs/audit/extended.toml --from runs/audit --set inference.method=laplace --out runs/mended",
    "rfdropo predict runs/mended --commands data/trial_03.csv --out runs/next",
)


class Step(NamedTuple):
    """A command that was typed, the words that it printed, and its time of the clock and of the processor [s]."""

    command: str
    printed: int
    wall: float
    cpu: float


def main() -> None:
    """Write the recordings, type the commands, print the table, and assert what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a new or empty folder to work in")
    parser.add_argument("--look", action="store_true", help="only look at what an earlier call left in the folder")
    arguments = parser.parse_args()
    folder, ledger = arguments.folder, arguments.folder / "steps.json"
    if not arguments.look:
        write_recordings(folder / "data")
        ledger.write_text(json.dumps([step._asdict() for step in type_all(folder)], indent=1), encoding="utf-8")
    print(table([Step(**step) for step in json.loads(ledger.read_text(encoding="utf-8"))]))
    see(folder)


def type_all(folder: Path) -> list[Step]:
    """Type every command."""
    steps = []
    for command in COMMANDS:
        steps.append(typed(command, folder))
        print(f"{steps[-1].wall:6.0f} s {steps[-1].cpu:6.0f} s of processor  {command}", flush=True)
    return steps


def write_recordings(folder: Path) -> None:
    """Three recordings of 6 s at 60 Hz, simulated, as CSV files."""
    arm = rb.Robot.outline(name="invented", length=0.25, radius=0.012, markers={"mid": 0.125, "tip": 0.25}, mass=0.09)
    model = rb.Model(arm, priors={"young_modulus": {}}, mechanisms=["command_delay"])
    walk = {"duration": 6.0, "interval": 0.3, "step": 0.004, "low": 0.0, "high": 0.014, "sample_time": 1.0 / 60.0}
    truth = {"young_modulus": MODULUS, "command_delay": DELAY}
    runs = rb.simulate(
        model, {**walk, "recordings": ["1", "2", "3"]}, parameters=truth, noise={"standard_deviation": NOISE}, seed=3
    )
    folder.mkdir(parents=True)
    for number, run in enumerate(runs, start=1):
        row = np.maximum(np.searchsorted(run.command_time, run.time + 1e-9) - 1, 0)
        frame = pd.DataFrame({"Frame": np.arange(len(run.time)), "Time_s": run.time.round(5)})
        for cable in range(4):
            turns = run.command[row, cable] / (2.0 * np.pi * SPOOL)
            frame[f"M{cable + 1}_cmd_counts"] = np.rint(COUNTS * turns).astype(int)
        x, y, z = np.moveaxis(1e3 * run.position, -1, 0)
        for marker, name in enumerate(("mid", "tip")):
            for axis, values, clamp in zip("XYZ", (-y, -z, x), CLAMP, strict=True):
                frame[f"{name}_{axis}_mm"] = (values[:, marker] + clamp).round(2)
        frame.to_csv(folder / f"trial_{number:02d}.csv", index=False)


def typed(command: str, folder: Path) -> Step:
    """Run a command in a folder.

    Raises:
        CalledProcessError: it failed.
    """
    words = [sys.executable, "-m", "rfdropo_bayes", *shlex.split(command)[1:]]
    began, before = time.perf_counter(), os.times()
    done = subprocess.run(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=True)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    (folder / "printed.txt").open("a", encoding="utf-8").write(f"$ {command}\n{done.stdout}\n")
    return Step(command, len(done.stdout.split()), time.perf_counter() - began, cpu)


def table(steps: list[Step]) -> str:
    """Minutes of reading, typing and waiting."""
    read = len(README.read_text(encoding="utf-8").split())
    printed, words = sum(step.printed for step in steps), sum(len(step.command.split()) for step in steps)
    rows = [
        ("the README", f"{read} words", read / READING),
        ("what the commands printed", f"{printed} words", printed / READING),
        ("the commands", f"{words} words", words / TYPING),
    ]
    lines = [f"| {what} | {size} | {minutes:.1f} min |" for what, size, minutes in rows]
    total, cpu = sum(minutes for _, _, minutes in rows), sum(step.cpu for step in steps)
    wall = sum(step.wall for step in steps)
    return "\n".join(
        [
            *lines,
            f"| reading and typing | | {total:.1f} min |",
            f"| waiting | {cpu:.0f} s of processor | {wall / 60.0:.1f} min |",
        ]
    )


def see(folder: Path) -> None:
    """Assert that the delay was named and measured, and that the prediction errs by little more than noise."""
    audit = json.loads((folder / "runs" / "audit" / "audit.json").read_text(encoding="utf-8"))
    (named,) = audit["adopted"]
    row = rb.load(folder / "runs" / "mended").summary.loc[named]
    print(audit["sentence"])
    print(f"{named} {row['mean']:.5f} +- {row['sd']:.5f} s; hidden was a command_delay of {DELAY} s")
    assert named == "command_delay"
    assert abs(row["mean"] - DELAY) < 1e-3
    predicted = pd.read_csv(folder / "runs" / "next" / "prediction.csv")
    recorded = pd.read_csv(folder / "data" / "trial_03.csv")
    x, y, z = (recorded[f"tip_{axis}_mm"] - clamp for axis, clamp in zip("XYZ", CLAMP, strict=True))
    off = [1e3 * predicted[f"tip_{axis}_mean"] - of for axis, of in zip("xyz", (z, -x, -y), strict=True)]
    distance = float(np.sqrt(np.mean(np.sum(np.square(off), axis=0))))
    print(
        f"trial_03, which no fit saw: the tip is off by {distance:.3f} mm; noise alone makes {1e3 * NOISE * 3**0.5:.3f}"
    )
    assert distance < 1.2e3 * NOISE * 3**0.5


if __name__ == "__main__":
    main()
