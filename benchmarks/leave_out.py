"""Leave recordings out in turn, fit the others, and predict those left out from their commands and first rows.

    python benchmarks/leave_out.py EXPERIMENT PATTERN [PATTERN ...] [--adapt SECONDS] [--out DIR] [--set ASSIGNMENT ...]

Every pattern stands for recordings that are left out together, such as those of a day. They are predicted whole, also
where the experiment fits some rows of them. The table says how far the last marker is off [mm], and which share of the
measured coordinates lies in the 90 % bands: of all markers, of the last, and of rows whose last marker is inside in all
three. With --adapt each fit is then adapted to the first seconds of the first recording that was left out; further rows
of the table are of the rest of it, and of the others. Fits that are done are read again.
"""

from __future__ import annotations

import argparse
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

import rfdropo_bayes as rb
from rfdropo_bayes.data import RecordingEntry
from rfdropo_bayes.groups import whole
from rfdropo_bayes.inference.methods import make_config
from rfdropo_bayes.model.assembly import load_data
from rfdropo_bayes.posteriors import RecordingPrediction
from rfdropo_bayes.report.coverage import predictive_bands
from rfdropo_bayes.tables import changed
from rfdropo_bayes.verbs.calibrate import calibrate, inference_options

HEAD = ("left out", "recording", "start held [mm]", "error [mm]", "coordinates in", "of the tip", "tips in")


def whole_recordings(model: rb.Model, pattern: str) -> list[rb.Trajectory]:
    """The recordings that a pattern stands for, all rows of them."""
    data = model.settings.data
    assert data is not None
    entries = data.model_dump(include={"fit", "test"}).values()
    entire = {entry["observations"]: RecordingEntry(**{**entry, "rows": None}) for kind in entries for entry in kind}
    every = load_data(changed(data, where="[data]", fit=list(entire.values()), test=[]), model.folder, "fit")
    return [run for run in every if fnmatchcase(run.name, pattern)]


def left_out(model: rb.Model, pattern: str, out: Path) -> rb.Calibration:
    """A fit that has not seen the recordings that a pattern stands for, and predicts them."""
    if (out / "posterior.nc").exists():
        return rb.load(out)
    table = model.settings.inference
    return calibrate(
        model,
        [run for run in model.recordings("fit") if not fnmatchcase(whole(run.name), pattern)],
        make_config(table.method, inference_options(table)),
        test=whole_recordings(model, pattern),
        seed=model.settings.seed,
        out=out,
        overwrite=True,
    )


def tested(found: rb.Calibration) -> list[RecordingPrediction]:
    """Predictions of recordings that were not fitted."""
    return [prediction for prediction in found.record.recordings if prediction.split == "test"]


def figures(prediction: RecordingPrediction) -> tuple[float, ...]:
    """Errors of the last marker [mm], and shares in the 90 % bands."""
    bands, seen = predictive_bands(prediction.predicted), prediction.mask
    inside = (prediction.observed >= bands.low90) & (prediction.observed <= bands.high90)
    tip = seen[:, -1]
    held = prediction.observed[tip, -1] - prediction.observed[tip, -1][0]
    off = prediction.central[tip, -1] - prediction.observed[tip, -1]
    errors = [1e3 * float(np.sqrt(np.mean(np.sum(each**2, axis=-1)))) for each in (held, off)]
    return (*errors, inside[seen].mean(), inside[tip, -1].mean(), inside[tip, -1].all(axis=-1).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiment", type=Path)
    parser.add_argument("patterns", nargs="+")
    parser.add_argument("--adapt", type=float, help="seconds of the first recording left out that are then looked at")
    parser.add_argument("--out", type=Path, default=Path("reports/leave_out"))
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    given = parser.parse_args()
    model = rb.Model.read(given.experiment, given.overrides)
    print("| " + " | ".join(HEAD) + " |\n" + "|---" * len(HEAD) + "|", flush=True)
    for pattern in given.patterns:
        out = given.out / pattern.replace("*", "")
        found = left_out(model, pattern, out)
        rows = [(pattern, prediction) for prediction in tested(found)]
        if given.adapt is not None:
            first, *others = whole_recordings(model, pattern)
            adapted = rb.adapt(found, first, seconds=given.adapt, test=others, group="the day left out")
            rows += [(f"{pattern}, adapted", prediction) for prediction in tested(adapted)]
        for words, prediction in rows:
            held, off, *shares = figures(prediction)
            percent = " | ".join(f"{100 * share:.0f} %" for share in shares)
            print(f"| {words} | {prediction.name} | {held:.1f} | {off:.1f} | {percent} |", flush=True)


if __name__ == "__main__":
    main()
