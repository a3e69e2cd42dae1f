"""Which part of the ASL trunk's motion repeats, and what the stored model leaves beside it (README.md)."""

import os
from pathlib import Path

import jax
import numpy as np
import pandas as pd

import rfdropo_bayes as rb
from rfdropo_bayes.data.asl_csv import read_asl_csv
from rfdropo_bayes.posteriors import PosteriorRecord
from rfdropo_bayes.prediction.model_error import recorded_model_error
from rfdropo_bayes.prediction.predictive import predict_new
from rfdropo_bayes.report.summary import read_summary

DATA, FOLDER = Path(os.environ["RFDROPO_DATA"]) / "asl_trunk", Path(__file__).parent
TIP, SETTLED, EVERY = 2, 20, 10  # the last disk; rows of a settled pose; rows of 10 ms to one of 0.1 s
WINDOWS = (1, 10, 20)  # rows of 0.1 s


def distance(error: np.ndarray) -> float:
    """Root mean square length of the rows that are known."""
    return float(np.sqrt(np.nanmean(np.sum(error**2, axis=-1))))


def said(name: str, error: np.ndarray) -> None:
    """Print the size of an error [mm], and of its means over one and two seconds."""
    series = pd.DataFrame(error - np.nanmean(error, axis=0))
    for rows in WINDOWS:
        mean = series.rolling(rows, center=True, min_periods=max(rows // 2, 1)).mean().to_numpy()
        print(f"{name}, means over {rows / 10:g} s: {distance(mean):.1f} mm")


def visits() -> None:
    """Ten commands, each held three times: how far the settled tip is from its mean."""
    poses = pd.read_csv(DATA / "observations_adiabatic_global_4.csv.gz").groupby("ID")[["x3", "y3", "z3"]]
    settled = 1e3 * poses.apply(lambda rows: rows.iloc[-SETTLED:].median())
    commands = pd.read_csv(DATA / "control_inputs_adiabatic_global_4.csv.gz").set_index("ID").loc[settled.index]
    visited = [own.to_numpy() for _, own in settled.groupby(list(commands.round(6).to_numpy().T))]
    apart = [np.sqrt(np.sum((own - own.mean(axis=0)) ** 2) / (len(own) - 1)) for own in visited]
    pooled = np.sqrt(np.mean(np.square(apart)))
    print(
        f"visits of one command: deviation {pooled:.1f} mm, {min(apart):.1f} to {max(apart):.1f}; {len(apart)} commands"
    )


def tip(observations: str) -> np.ndarray:
    """The tip under `control_inputs_controlled_1` [mm], every 0.1 s; NaN where the recording has faults."""
    read = read_asl_csv(DATA / f"observations_{observations}.csv.gz", DATA / "control_inputs_controlled_1.csv.gz")
    return np.where(read.position_mask[::EVERY, TIP, None], 1e3 * read.position[::EVERY, TIP], np.nan)


def one_sequence_twice() -> None:
    """150 s of commands, sent without and with 100 g: what is left once the poses are mapped onto each other."""
    without, loaded = tip("controlled_1"), tip("controlled_1_100g")
    known = np.isfinite(without).all(axis=1) & np.isfinite(loaded).all(axis=1)
    design = np.c_[without, np.ones(len(without))]
    affine = np.linalg.lstsq(design[known], loaded[known], rcond=None)[0]
    apart = loaded - design @ affine
    said("one sequence sent twice, both recordings together", apart)
    way = np.gradient(without, axis=0)
    along = np.sum(apart * way, axis=1) / np.linalg.norm(way, axis=1)
    across = np.sqrt((np.nanmean(np.sum(apart**2, axis=1)) - np.nanmean(along**2)) / 2.0)
    print(f"... along the tip's path {np.sqrt(np.nanmean(along**2)):.1f} mm, across it {across:.1f} mm each way")


def left_by_the_model() -> None:
    """What the optimum of the stored posterior leaves of the held-out rows of the sequence."""
    model, record = rb.Model.read(FOLDER / "config.toml"), PosteriorRecord.load(FOLDER / "posterior.nc")
    fitted, tested = model.recordings("fit"), model.recordings("test")[:1]
    optimum = read_summary(FOLDER / "summary.json")["optimum"]
    values = {info.name: np.full(2, optimum[info.name]) for info in record.free}
    problem = model.problem(fitted)
    known = {"fitted": [run.name for run in fitted], "left": recorded_model_error(record), "groups": model.spec.groups}
    (found,) = predict_new(problem.model, tested, values, jax.random.key(0), chunk=problem.chunk, **known).recordings
    error = 1e3 * (found.observed - found.central)[:, TIP]
    said(f"the model, {found.name}", np.where(found.mask[:, TIP, None], error, np.nan))


if __name__ == "__main__":
    visits()
    one_sequence_twice()
    left_by_the_model()
