"""``rfdropo export``: the distribution to randomise over as tables, or a calibrated model."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import output_folder, whole, write_json
from rfdropo_bayes.model.assembly import physical_values
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import CONFIG
from rfdropo_bayes.posteriors import PosteriorRecord
from rfdropo_bayes.report.run_files import POSTERIOR, SUMMARY
from rfdropo_bayes.report.summary import read_summary
from rfdropo_bayes.simulators.black_box import BlackBox

TABLE, TABLE_JSON, DRAWS = "phi.csv", "phi.json", "phi_draws.csv"
MOST_DRAWS = 2000
SCHEMA_VERSION = 1
LENGTH_POWER = {"m": 1, "N": 1, "Pa": -1, "J": 2, "W": 2}


def millimetre_factor(unit: str) -> float:
    """Factor from an SI unit to a system of mm, kg and s, as SOFA scenes often use.

    Pa/kg is (kg/(m s2))/kg: 1e-3. Angles, times and pure numbers stay.
    """
    power = 0
    for index, part in enumerate(unit.split("/")):
        for symbol, exponent in re.findall(r"([A-Za-z]+)(-?\d*)", part):
            if symbol in LENGTH_POWER:
                power += (1 if index == 0 else -1) * LENGTH_POWER[symbol] * int(exponent or 1)
    return 1000.0**power


def export_phi(folder: Path, out: Path | None = None, *, overwrite: bool = False) -> list[Path]:
    """Write phi of a run: a table (CSV and JSON) with units, and joint draws.

    RF-DROPO's phi is written as found: independent normals before truncation, with their limits. For other methods the
    table has mean, deviation and central 99 % of each parameter. Correlations are in the JSON file and in the draws:
    use the draws if parameters are correlated.

    Returns:
        the files written, to ``out``, or to the run's folder.

    Raises:
        InputError: no finished run in ``folder``, or ``out`` cannot be written.
    """
    summary = read_summary(folder / SUMMARY)
    record = PosteriorRecord.load(folder / POSTERIOR)
    out = output_folder(out or folder)
    _check_absent([out / TABLE, out / TABLE_JSON, out / DRAWS], overwrite)
    names = [info.name for info in record.free]
    stack = np.stack([record.flat(name) for name in names])
    rows = _rows(record, summary)
    drawn = stack[:, np.linspace(0, stack.shape[1] - 1, min(MOST_DRAWS, stack.shape[1])).round().astype(int)]
    content = {
        "schema_version": SCHEMA_VERSION,
        "method": summary["method"],
        "distribution": "independent truncated normals" if summary.get("phi") else "moments of the posterior draws",
        "randomisation": summary.get("randomisation"),
        "data_sha256": summary["data_sha256"],
        "seed": summary["seed"],
        "parameters": {row["parameter"]: {k: v for k, v in row.items() if k != "parameter"} for row in rows},
        "correlation": _correlation(names, stack),
        "draws": {"file": DRAWS, "number": drawn.shape[1], "units": "SI"},
    }
    paths = [out / TABLE, out / TABLE_JSON, out / DRAWS]
    with whole(paths[0]) as partial:
        pd.DataFrame(rows).to_csv(partial, index=False)
    write_json(paths[1], content, finite=True)
    with whole(paths[2]) as partial:
        pd.DataFrame(drawn.T, columns=names).to_csv(partial, index=False)
    return paths


def export_model(folder: Path, out: Path | None = None, *, overwrite: bool = False) -> Path:
    """Write the model of a simulator of another kind with posterior means in it, and 90 % ranges in its head.

    Effects of actuation and sensing mechanisms are not in such a file.

    Returns:
        the file written, ``calibrated`` with the suffix of such files, to ``out``, or to the run's folder.

    Raises:
        InputError: no finished run in ``folder``, or a simulator that cannot write its model.
    """
    model = Model.read(folder / CONFIG)
    write = getattr(getattr(model.robot, "function", None), "written", None)
    if write is None:
        raise InputError(f"{model.name} cannot write its model", where=str(folder), remedy="use --phi")
    record = PosteriorRecord.load(folder / POSTERIOR)
    known = {spec.name: spec for spec in model.robot.specs} if isinstance(model.robot, BlackBox) else {}
    draws = {info.name: record.flat(info.name) for info in record.free if info.name in known}
    values = {name: float(own.mean()) for name, own in draws.items()}
    fixed = physical_values(model.spec, model.simulator) | {info.name: value for info, value in record.fixed}
    values |= {name: value for name, value in fixed.items() if name in known}
    lines = ["Calibrated by rfdropo_bayes: posterior means; in brackets the 90 % range to randomise over."]
    for name, value in values.items():
        low, high = np.quantile(draws[name], [0.05, 0.95]) if name in draws else (value, value)
        lines.append(f"{name} = {value:.6g} [{low:.6g}, {high:.6g}] {known[name].unit}")
    if model.mechanisms:
        lines.append(f"Not in this file: {', '.join(model.mechanisms)}.")
    suffix, text = write(values, lines)
    path = output_folder(out or folder) / f"calibrated{suffix}"
    _check_absent([path], overwrite)
    with whole(path) as partial:
        Path(partial).write_text(text, encoding="utf-8")
    return path


def _check_absent(paths: Sequence[Path], overwrite: bool) -> None:
    """Raise InputError if an earlier export would be replaced."""
    there = [path for path in paths if path.exists()]
    if there and not overwrite:
        raise InputError(
            "is there already",
            where=str(there[0]),
            remedy="choose another folder with --out, or replace it with --overwrite",
        )


def _rows(record: PosteriorRecord, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    phi = summary.get("phi")
    rows = []
    for info in record.free:
        if phi:
            entry = phi[info.name]
            statistics = {key: float(entry[key]) for key in ("mean", "std", "low", "high")}
        else:
            draws = record.flat(info.name)
            low, high = np.quantile(draws, [0.005, 0.995])
            statistics = {"mean": draws.mean(), "std": draws.std(), "low": low, "high": high}
        factor = millimetre_factor(info.unit)
        values = {key: float(value) for key, value in statistics.items()}
        in_millimetres = {f"{key}_mm_kg_s": value * factor for key, value in values.items()}
        rows.append({"parameter": info.name, "unit": info.unit, **values, **in_millimetres})
    return rows


def _correlation(names: list[str], stack: np.ndarray) -> dict[str, dict[str, float]]:
    """Correlations of the draws; a constant parameter correlates with itself only."""
    deviation = stack.std(axis=1)
    scaled = (stack - stack.mean(axis=1, keepdims=True)) / np.where(deviation > 0.0, deviation, 1.0)[:, None]
    matrix = scaled @ scaled.T / stack.shape[1]
    np.fill_diagonal(matrix, 1.0)
    return {a: dict(zip(names, matrix[i].tolist(), strict=True)) for i, a in enumerate(names)}
