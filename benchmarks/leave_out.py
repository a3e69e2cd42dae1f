"""Leave recordings out in turn, fit the others, and predict those left out from their commands and first rows.

    python benchmarks/leave_out.py EXPERIMENT PATTERN [PATTERN ...] [--out DIR] [--set ASSIGNMENT ...]

Every pattern stands for recordings that are left out together, such as those of a day. They are predicted whole, also
where the experiment fits some rows of them. The table says how far the last marker is off [mm], and which share of the
measured coordinates lies in the 90 % bands: of all markers, of the last, and of rows whose last marker is inside in all
three. Fits that are done are read again.
"""

from __future__ import annotations

import argparse
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

import rfdropo_bayes as rb
from rfdropo_bayes.bayes.pooling import whole
from rfdropo_bayes.data import RecordingEntry
from rfdropo_bayes.inference.methods import make_config
from rfdropo_bayes.posteriors import RecordingPrediction
from rfdropo_bayes.report.coverage import predictive_bands
from rfdropo_bayes.workflow.assembly import load_data
from rfdropo_bayes.workflow.calibration import calibrate, inference_options
from rfdropo_bayes.workflow.experiment import Experiment, load_experiment
from rfdropo_bayes.workflow.model import Model

HEAD = ("left out", "recording", "start held [mm]", "error [mm]", "coordinates in", "of the tip", "tips in")


def left_out(experiment: Experiment, folder: Path, pattern: str, out: Path) -> list[RecordingPrediction]:
    """Predictions of the recordings that a pattern stands for, by a fit that has not seen them."""
    if (out / "posterior.nc").exists():
        found = rb.load(out)
    else:
        runs = load_data(experiment, folder, "fit")
        entries = experiment.data.model_dump(include={"fit", "test"}).values()
        entire = [RecordingEntry(**{**entry, "rows": None}) for kind in entries for entry in kind]
        data = experiment.data.model_copy(update={"fit": entire, "test": []})
        every = load_data(experiment.model_copy(update={"data": data}), folder, "fit")
        found = calibrate(
            Model.of_experiment(experiment, folder),
            [run for run in runs if not fnmatchcase(whole(run.name), pattern)],
            make_config(experiment.inference.method, inference_options(experiment)),
            test=[run for run in every if fnmatchcase(run.name, pattern)],
            seed=experiment.seed,
            out=out,
            overwrite=True,
        )
    return [prediction for prediction in found.record.recordings if prediction.split == "test"]


def figures(prediction: RecordingPrediction) -> tuple[float, ...]:
    """Errors of the last marker [mm], and shares in the 90 % bands."""
    bands, seen = predictive_bands(prediction.predicted), prediction.mask
    inside = (prediction.observed >= bands.low90) & (prediction.observed <= bands.high90)
    tip = seen[:, -1]
    held = prediction.observed[tip, -1] - prediction.observed[0, -1]
    off = prediction.central[tip, -1] - prediction.observed[tip, -1]
    errors = [1e3 * float(np.sqrt(np.mean(np.sum(each**2, axis=-1)))) for each in (held, off)]
    return (*errors, inside[seen].mean(), inside[tip, -1].mean(), inside[tip, -1].all(axis=-1).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiment", type=Path)
    parser.add_argument("patterns", nargs="+")
    parser.add_argument("--out", type=Path, default=Path("reports/leave_out"))
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    given = parser.parse_args()
    experiment, _ = load_experiment(given.experiment, given.overrides)
    print("| " + " | ".join(HEAD) + " |\n" + "|---" * len(HEAD) + "|", flush=True)
    for pattern in given.patterns:
        out = given.out / pattern.replace("*", "")
        for prediction in left_out(experiment, given.experiment.resolve().parent, pattern, out):
            held, off, *shares = figures(prediction)
            words = " | ".join(f"{100 * share:.0f} %" for share in shares)
            print(f"| {pattern} | {prediction.name} | {held:.1f} | {off:.1f} | {words} |", flush=True)


if __name__ == "__main__":
    main()
