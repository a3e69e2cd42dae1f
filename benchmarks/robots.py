"""What a robot of another laboratory gets from the commands of docs/tutorial.md, and what they cost; resumable.

    python benchmarks/robots.py [NAME ...] [--out reports/robots] [--runs runs/robots]

Every run of `RUNS`, or each named one, is typed as it stands there, and its figures become a line of OUT/ledger.jsonl:
errors of the last marker [mm], the best predictor without physics beside them, effective draws, the share of test
coordinates in the 90 % bands, processor seconds, and the yardstick of the same machine. A run whose line is there is
not made again. Data are read from $RFDROPO_DATA. All together take 12 minutes of a processor (yardstick 4).
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rfdropo_bayes.files import append_line, read_lines
from rfdropo_bayes.report.headline import best_baseline

ZEROS_AND_CAMERA = "initial_displacement=0.001 offset_x=0.002 offset_y=0.002 " + " ".join(
    f"camera_rotation_{axis}=0.03" for axis in "xyz"
)
RUNS = {
    "demo": "calibrate experiments/demo.toml",
    "soromox_tentacle": "calibrate experiments/soromox_tentacle.toml",
    "deepc_arm": "calibrate experiments/deepc_arm.toml",
    "deepc_next_day": "adapt RUNS/deepc_arm --recording $RFDROPO_DATA/deepc_arm/arduino_log_2025-08-28_16-44-24.txt "
    "--seconds 60 " + " ".join(f"--set model.per_group.{change}" for change in ZEROS_AND_CAMERA.split()),
    "deepc_audit": "audit experiments/deepc_arm.toml --from RUNS/deepc_arm",
    "crl_tdcr": "calibrate experiments/crl_tdcr.toml --set inference.minutes=20",
    "three_cable_static": "calibrate experiments/three_cable_static.toml --set inference.minutes=20",
}
"""Commands by name, the cheap ones first; RUNS is the folder of the runs before."""


def calibrated(folder: Path) -> dict[str, Any]:
    """Errors of the last marker [mm], bands, effective draws, verdict and cost of a calibration."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    without = best_baseline(summary, "test")
    return {
        "fit_mm": [*summary["rmse"]["fit"].values()][-1],
        "test_mm": [*summary["rmse"]["test"].values()][-1],
        "markers_mm": summary["rmse"]["test"],
        "without": without,
        "bands": {marker: shares["0.9"] for marker, shares in summary["coverage_by_role"]["test"].items()},
        "draws": summary["effective_draws"],
        "verdict": summary["randomisation"]["verdict"],
    }


def adapted(folder: Path) -> dict[str, Any]:
    """Errors [mm] and bands of the rest of an adapted session, from its first row and adapted."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return {"checks": summary["details"]["checks"]}


def audited(folder: Path) -> dict[str, Any]:
    """Verdict, named mechanisms and sentence of an audit."""
    audit = json.loads((folder / "audit.json").read_text(encoding="utf-8"))
    named = [finding["mechanism"] for finding in audit["findings"]]
    return {"verdict": audit["verdict"], "named": named, "sentence": audit["sentence"]}


READ: Mapping[str, Callable[[Path], dict[str, Any]]] = {"calibrate": calibrated, "adapt": adapted, "audit": audited}


def processor_seconds(words: list[str]) -> tuple[float, str]:
    """Processor seconds of a Python command and of its children, and what it printed.

    Raises:
        CalledProcessError: it failed.
    """
    before = os.times()
    printed = subprocess.run([sys.executable, *words], stdout=subprocess.PIPE, text=True, check=True).stdout
    after = os.times()
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return spent, printed


def main() -> None:
    """Type the runs that the ledger does not have yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", default=[*RUNS], help=", ".join(RUNS))
    parser.add_argument("--out", type=Path, default=Path("reports/robots"))
    parser.add_argument("--runs", type=Path, default=Path("runs/robots"))
    given = parser.parse_args()
    if unknown := [name for name in given.names if name not in RUNS]:
        parser.error(f"unknown run {unknown[0]!r}: some of {', '.join(RUNS)}")
    ledger = given.out / "ledger.jsonl"
    ledger.parent.mkdir(parents=True, exist_ok=True)
    known = {line["run"] for line in read_lines(ledger)}
    for name in given.names:
        if name in known:
            continue
        words = shlex.split(os.path.expandvars(RUNS[name].replace("RUNS", str(given.runs))))
        folder = given.runs / name
        yardstick, _ = processor_seconds(["tools/yardstick.py"])
        cpu, _ = processor_seconds(["-m", "rfdropo_bayes", *words, "--out", str(folder), "--overwrite"])
        figures = {"processor_s": round(cpu, 1), "yardstick_s": round(yardstick, 2), **READ[words[0]](folder)}
        append_line(ledger, json.dumps({"run": name, "command": RUNS[name], **figures}))
        print(f"{name}: {cpu:.0f} processor s, yardstick {yardstick:.1f}; {figures}", flush=True)


if __name__ == "__main__":
    main()
