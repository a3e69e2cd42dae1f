"""Leave recordings out in turn, fit the others, and predict those left out from their commands and first rows.

    python benchmarks/leave_out.py [SETTINGS.toml] [--out DIR]
    python benchmarks/leave_out.py --store FOLDER

The settings name experiments, patterns of recordings that are left out together, such as those of a day, and the
seconds of the first of them that each fit is then adapted to. Recordings are predicted whole, also if the experiment
fits some rows of them; after an adaptation the first one as far as it was not shown. Optimisations start from the
prior, or from the optimum of `start`, the folder of a calibration: a day that is left out has chosen the basin then,
and nothing else. `set` changes entries of the experiment, as ``--set`` does.

Every line of DIR/ledger.jsonl has the figures of a day: how far the last marker is off [mm], before an adaptation (from
the first row, in the same rows) and after it, and the share of the measured coordinates in the 90 % bands: of
all markers, of the last, and of rows whose last marker is inside in all three.
Lines that are there are not computed again, fits that are done are read again, and so an interrupted run goes on. A fit
of the paper's trunk takes 2 to 10 minutes of two shared cores, one of the ASL trunk 7 minutes or more, an adaptation 1.

With --store, FOLDER is that of a calibration. Each of its groups is left out of the recordings that it fitted, as
`rfdropo calibrate` does after a fit, and the error of unseen days goes into its posterior.nc and summary.json.
"""

from __future__ import annotations

import argparse
import json
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import jax
import numpy as np

import rfdropo_bayes as rb
from rfdropo_bayes.data import RecordingEntry
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import append_line, read_lines
from rfdropo_bayes.groups import whole
from rfdropo_bayes.inference.methods import make_config
from rfdropo_bayes.model.assembly import load_data
from rfdropo_bayes.posteriors import RecordingPrediction, by_owner
from rfdropo_bayes.prediction.predictive import predict_fitted, thin
from rfdropo_bayes.prediction.session_error import SESSION_ERROR, left_out_sentence
from rfdropo_bayes.report.coverage import predictive_bands
from rfdropo_bayes.report.run_files import POSTERIOR, SUMMARY
from rfdropo_bayes.report.summary import write_summary
from rfdropo_bayes.tables import changed
from rfdropo_bayes.verbs.adapt import model_error_of
from rfdropo_bayes.verbs.calibrate import calibrate, inference_options
from rfdropo_bayes.verbs.left_out_sessions import DRAWS, Sessions, error_of_unseen_sessions
from rfdropo_bayes.verbs.predict import model_of

SETTINGS = Path(__file__).with_suffix(".toml")

HEAD = (
    "left out",
    "shown [s]",
    "recording",
    "start held [mm]",
    "from the first row [mm]",
    "error [mm]",
    "coordinates in",
    "of the tip",
    "tips in",
)
FIGURES = ("held_mm", "error_mm", "coordinates", "tip_coordinates", "tips")


def whole_recordings(model: rb.Model, pattern: str) -> list[rb.Trajectory]:
    """The recordings that a pattern stands for, all rows of them."""
    data = model.settings.data
    assert data is not None
    entries = data.model_dump(include={"fit", "test"}).values()
    entire = {entry["observations"]: RecordingEntry(**{**entry, "rows": None}) for kind in entries for entry in kind}
    every = load_data(changed(data, where="[data]", fit=list(entire.values()), test=[]), model.folder, "fit")
    return [run for run in every if fnmatchcase(run.name, pattern)]


def left_out(model: rb.Model, pattern: str, out: Path, start: Path | None) -> rb.Calibration:
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
        fit=start,
        out=out,
        overwrite=True,
    )


def store(folder: Path) -> str:
    """Write the error of unseen days into the folder of a calibration, and return it in words.

    Raises:
        InputError: no calibration there, other recordings than it was fitted to, or a model without groups.
    """
    fit = rb.load(folder)
    model, record = model_of(fit), fit.record
    runs = model.recordings("fit")
    if unknown := [run.name for run in runs if run.sha256 not in record.attrs["data_sha256"]]:
        raise InputError(f"was not fitted to {unknown[0]} as it is now", where=str(folder), remedy="calibrate again")
    key = jax.random.key(model.settings.seed)
    draws = {info.name: record.posterior[info.name] for info in record.free}
    problem = model.problem(runs).holding({info.name: value for info, value in record.fixed})
    predictions = predict_fitted(problem, thin(draws, DRAWS), key)
    optimum = fit.content["optimum"]
    start = by_owner(record.free, {name: np.full(2, optimum[name]) for name in draws})
    error = error_of_unseen_sessions(Sessions(model, runs, start, predictions, model_error_of(record)), key)
    if error is None:
        raise InputError("nothing of the model differs between days", where=str(folder), remedy="name [model.groups]")
    sentence = left_out_sentence(error)
    replace(record, attrs={**record.attrs, SESSION_ERROR: error.as_dict()}).save(folder / POSTERIOR)
    write_summary({**fit.content, "unseen_sessions": {**error.as_dict(), "sentence": sentence}}, folder / SUMMARY)
    return sentence


def tested(found: rb.Calibration) -> list[RecordingPrediction]:
    """Predictions of recordings that were not fitted."""
    return [prediction for prediction in found.record.recordings if prediction.split == "test"]


def figures(prediction: RecordingPrediction) -> dict[str, float]:
    """Errors of the last marker [mm], and shares in the 90 % bands."""
    bands, seen = predictive_bands(prediction.predicted), prediction.mask
    inside = (prediction.observed >= bands.low90) & (prediction.observed <= bands.high90)
    tip = seen[:, -1]
    held = prediction.observed[tip, -1] - prediction.observed[tip, -1][0]
    off = prediction.central[tip, -1] - prediction.observed[tip, -1]
    errors = [1e3 * float(np.sqrt(np.mean(np.sum(each**2, axis=-1)))) for each in (held, off)]
    shares = [inside[seen].mean(), inside[tip, -1].mean(), inside[tip, -1].all(axis=-1).mean()]
    return dict(zip(FIGURES, [*errors, *map(float, shares)], strict=True))


def cases(study: dict[str, Any], out: Path, known: set[tuple[str, str, float]]) -> Iterator[dict[str, Any]]:
    """Lines of the ledger that are not known, each as soon as it is there; 0 seconds shown are the first row alone."""
    experiment = Path(study["experiment"])
    model, start = rb.Model.read(experiment, study.get("set")), Path(study["start"]) if "start" in study else None
    for pattern in study["left_out"]:
        waiting = [seconds for seconds in (0.0, *study["adapt"]) if (experiment.stem, pattern, seconds) not in known]
        if not waiting:
            continue
        found = left_out(model, pattern, out / experiment.stem / pattern.replace("*", ""), start)
        first, *others = whole_recordings(model, pattern)
        for seconds in waiting:
            fit = found
            if seconds:
                fit = rb.adapt(found, first, seconds=seconds, test=others, group="the day left out")
            rows = {prediction.name: figures(prediction) for prediction in tested(fit)}
            for name, check in fit.content["details"].get("checks", {}).items():
                rows[name]["before_mm"] = check["from_first_row"]["error_mm"]
            yield {"experiment": experiment.stem, "left_out": pattern, "seconds": seconds, "recordings": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("settings", type=Path, nargs="?", default=SETTINGS)
    parser.add_argument("--out", type=Path, default=Path("reports/leave_out"))
    parser.add_argument("--store", type=Path, metavar="FOLDER")
    given = parser.parse_args()
    if given.store:
        print(store(given.store))
        return
    ledger = given.out / "ledger.jsonl"
    lines = read_lines(ledger)
    known = {(line["experiment"], line["left_out"], line["seconds"]) for line in lines}
    given.out.mkdir(parents=True, exist_ok=True)
    for study in tomllib.loads(given.settings.read_text())["study"]:
        for line in cases(study, given.out, known):
            append_line(ledger, json.dumps(line))
            lines.append(line)
    print("| " + " | ".join(HEAD) + " |\n" + "|---" * len(HEAD) + "|")
    for line in lines:
        for name, row in line["recordings"].items():
            percent = " | ".join(f"{100 * row[key]:.0f} %" for key in FIGURES[2:])
            before = f"{row['before_mm']:.1f}" if "before_mm" in row else ""
            errors = f"{row['held_mm']:.1f} | {before} | {row['error_mm']:.1f}"
            print(f"| {line['left_out']} | {line['seconds']:g} | {name} | {errors} | {percent} |")


if __name__ == "__main__":
    main()
