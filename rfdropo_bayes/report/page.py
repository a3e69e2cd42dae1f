"""report.html: one file that needs nothing else, from a posterior, the numbers of its summary and its experiment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from rfdropo_bayes.discrepancy.candidates import spoken
from rfdropo_bayes.discrepancy.score_tests import p_in_words
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, RecordingPrediction
from rfdropo_bayes.posteriors.bounds import PILED
from rfdropo_bayes.report import check_figures, posterior_figures, trajectory_figures
from rfdropo_bayes.report.coverage import coverage, transform_curve
from rfdropo_bayes.report.headline import best_baseline
from rfdropo_bayes.report.replay import replay, tracks_of
from rfdropo_bayes.report.robot_figure import robot_figure
from rfdropo_bayes.report.scores import MeasuredPath, settled_rows
from rfdropo_bayes.report.sentences import sentences
from rfdropo_bayes.report.style import Picture, embed
from rfdropo_bayes.report.units import display_name, display_unit

MOST_RECORDINGS = 8
NOTHING = "\u2013"
OPEN_RECORDINGS = 2
LEAST_P = 1e-16
COVERAGE_CURVE = tuple(np.round(np.arange(0.1, 1.0, 0.1), 1))

SECTIONS = (
    ("result", "Result"),
    ("replay", "Replay"),
    ("errors", "Errors beside simpler predictors"),
    ("data", "Data"),
    ("model", "Model and priors"),
    ("posterior", "Posterior"),
    ("identifiability", "Determined parameters"),
    ("predictions", "Measured against predicted"),
    ("bands", "Are the bands honest?"),
    ("computation", "Computation"),
    ("limits", "Limits"),
    ("reproduce", "To reproduce"),
)


@dataclass(frozen=True)
class RecordingView:
    """Figures of one recording; an ``opened`` view is unfolded."""

    name: str
    split: str
    error: float | None
    bands: Picture
    path: Picture
    residuals: Picture
    opened: bool


def render(template: str, **content: Any) -> str:
    """HTML of a template of this package, with the style of all pages."""
    environment = Environment(
        loader=PackageLoader("rfdropo_bayes.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "words": display_name, "duration": duration, "breakable": breakable}
    environment.filters |= {"bootstrap_p": bootstrap_p, "p_value": p_value, "sentences": sentences, "spoken": spoken}
    environment.filters["sized"] = sized
    environment.globals["interval"] = interval
    assets = {}
    for name, file in (("stylesheet", "page.css"), ("script", "replay.js"), ("sort", "sort.js")):
        assets[name] = Markup(environment.loader.get_source(environment, file)[0]) if environment.loader else ""
    return environment.get_template(template).render(**assets, **content)


def render_page(record: PosteriorRecord, summary: Mapping[str, Any], config: str) -> str:
    """HTML of the report.

    Args:
        record: posterior and predictions.
        summary: content of summary.json, as `build_summary` made it.
        config: the experiment file of the run, TOML.
    """
    return render(
        "page.html.j2",
        summary=summary,
        sections=[section for section in SECTIONS if section[0] != "replay" or record.recordings],
        replayed=replay(tracks_of(record.recordings), summary.get("outline")),
        tiles=_tiles(summary),
        rows=_posterior_rows(summary),
        priors=_prior_rows(record),
        figures=_run_figures(record, summary),
        recordings=_recording_views(record, summary),
        total_recordings=len(record.recordings),
        limits=limits(summary),
        piled=PILED,
        config=config,
    )


def number(value: Any, digits: int = 3) -> str:
    """A number for people; an en dash if there is none."""
    if value is None:
        return NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) or (isinstance(value, float) and value.is_integer() and abs(value) < 1e6):
        return f"{int(value)}"
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e+0" in text and abs(value) < 1e6 else text


def sized(row: Mapping[str, Any]) -> str:
    """Mean and 90 % interval of a parameter with its unit."""
    factor, unit = display_unit(row["unit"], max(abs(row["q05"]), abs(row["q95"])))
    mean, low, high = (number(row[key] / factor) for key in ("mean", "q05", "q95"))
    return f"{mean} [{low}, {high}] {unit}".strip()


def bootstrap_p(p: float, simulated: int) -> str:
    """A bootstrap's p-value in a table."""
    return p_in_words(p, simulated).removeprefix("= ")


def p_value(p: float) -> str:
    """A p-value from a distribution; below its limit only the limit is printed."""
    return number(p, 2) if p >= LEAST_P else f"< {LEAST_P:.0e}"


def breakable(name: str) -> Markup:
    """A long name that may be broken after its underscores."""
    return Markup(str(escape(name)).replace("_", "_<wbr>").replace("@", "@<wbr>"))


def interval(low: float, high: float) -> str:
    """Hard bounds in words."""
    if math.isinf(low) and math.isinf(high):
        return "none"
    if math.isinf(high):
        return f"at least {number(low, 4)}"
    return f"at most {number(high, 4)}" if math.isinf(low) else f"{number(low, 4)} to {number(high, 4)}"


def duration(seconds: float) -> str:
    """Seconds, minutes or hours."""
    if seconds < 100:
        return f"{seconds:.3g} s"
    return f"{seconds / 60:.3g} min" if seconds < 6000 else f"{seconds / 3600:.3g} h"


def _tiles(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Value, unit and meaning of the figures at the top of the page."""
    tiles = []
    for role, words in (("test", "error on test recordings"), ("fit", "error where fitted")):
        values = list(summary["rmse"][role].values())
        repeated = len(summary.get("fitted_commands") or ()) if role == "test" else 0
        if repeated:
            words += (
                f" ({repeated} of {sum(r['split'] == 'test' for r in summary['recordings'])} repeat fitted commands)"
            )
        if values and values[-1] is not None:
            tiles.append((number(values[-1]), "mm", words))
    best = best_baseline(summary, "test" if summary["rmse"]["test"] else "fit")
    if best is not None:
        tiles.append((number(best[1]), "mm", f"best without a simulator: {best[0]}"))
    if summary["coverage"].get("0.9") is not None:
        tiles.append((f"{100 * summary['coverage']['0.9']:.0f}", "%", "of measurements in the 90 % band"))
    if summary["log_evidence"]["value"] is not None:
        sd = summary["log_evidence"]["sd"]
        words = "log evidence" if sd is None else f"log evidence ± {number(sd, 2)}"
        tiles.append((_grouped(summary["log_evidence"]["value"]), "nat", words))
    tiles.append((_grouped(summary["rollouts"]), "", f"rollouts in {duration(summary['seconds'])}"))
    return tiles


def _grouped(value: float) -> str:
    """A number with at most one decimal, narrow spaces between its thousands, and a minus sign; it fits into a tile."""
    decimals = 1 if isinstance(value, float) and abs(value) < 1000.0 and value != round(value) else 0
    return f"{value:,.{decimals}f}".replace(",", "\u202f").replace("-", "\u2212")


def _prior_rows(record: PosteriorRecord) -> list[tuple[str, ParameterInfo]]:
    """Name and facts of every inferred parameter; one line for all parameters of a kind that belong to single
    recordings.
    """
    kinds: dict[tuple[str, str], list[ParameterInfo]] = {}
    for info in record.free:
        kinds.setdefault((info.parameter, str(info.prior)), []).append(info)
    return [
        (f"{name} (one for each of {len(infos)} recordings)" if len(infos) > 1 else infos[0].name, infos[0])
        for (name, _), infos in kinds.items()
    ]


def _posterior_rows(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The posterior table in units that read well, one unit per parameter for all recordings."""
    magnitude: dict[str, float] = {}
    for row in summary["parameters"].values():
        base = row["parameter"]
        magnitude[base] = max(magnitude.get(base, 0.0), abs(row["q05"]), abs(row["q95"]))
    rows = []
    for name, row in summary["parameters"].items():
        factor, unit = display_unit(row["unit"], magnitude[row["parameter"]])
        keys = ("mean", "sd", "q05", "median", "q95", "prior_q05", "prior_q95")
        scaled = {key: None if row.get(key) is None else row[key] / factor for key in keys}
        rows.append({**row, **scaled, "name": name, "unit": unit, "own": bool(row["owner"])})
    return rows


def _error_rows(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Model first, then the predictors without a simulator; errors by part are of the test, else of the fit."""

    def row(title: str, own: bool, errors: Mapping[str, Any]) -> dict[str, Any]:
        last = {r: list(errors[r]["over_time"].values())[-1] if errors.get(r) else None for r in ("fit", "test")}
        parts = errors.get("test") if summary["rmse"]["test"] else errors.get("fit")
        return {
            "title": title,
            "own": own,
            **last,
            "moving": parts["moving"] if parts else None,
            "final": parts["final"] if parts else None,
            "description": errors.get("description", "the calibrated simulator"),
            "reason": errors.get("reason", ""),
        }

    own = row("this simulator", True, summary["errors"])
    return [own, *(row(b["title"], False, b) for b in summary["baselines"].values())]


def _run_figures(record: PosteriorRecord, summary: Mapping[str, Any]) -> dict[str, Any]:
    """Figures of the run as a whole; None for a figure without data."""
    rows = _error_rows(summary)
    floor = summary.get("noise_floor_mm")
    scored = any(row[role] is not None for row in rows for role in ("fit", "test"))
    pair = posterior_figures.paired_names(record)
    own = [info for info in record.free if info.scope.owner]
    shared = [info.name for info in record.parameters if not info.scope.owner][: posterior_figures.MOST_PANELS]
    outline = summary.get("outline")
    return {
        "robot": embed(robot_figure(outline), "The robot from the side and from its base") if outline else None,
        "error_rows": rows,
        "errors": embed(
            check_figures.error_figure(rows, list(floor.values())[-1] if floor else None),
            "Bars: error of the last marker for this simulator and for simpler predictors",
        )
        if scored
        else None,
        "pair": embed(posterior_figures.pair_figure(record, pair), "Scatter of each pair of parameters", whole=True)
        if len(pair) > 1
        else None,
        "pair_names": pair,
        "marginals": embed(
            posterior_figures.prior_posterior_figure(record, shared), "Prior and posterior density of each parameter"
        )
        if shared
        else None,
        "forest": embed(posterior_figures.forest_figure(record, own), "Intervals of the parameters of each recording")
        if own
        else None,
        "coverage": _band_coverage(record),
        "trace": embed(check_figures.trace_figure(record.trace), "Numbers of the sampler over its stages")
        if any(key in row for row in record.trace for key in check_figures.TRACES)
        else None,
        "blocks": embed(check_figures.block_figure(record.block_scores), "Log score per row of each block of rows")
        if record.block_scores
        else None,
    }


def _band_coverage(record: PosteriorRecord) -> Picture | None:
    curves, shares = {}, {}
    for role in ("fit", "test"):
        chosen = [r for r in record.recordings if r.split == role]
        curve = transform_curve(chosen)
        if curve is not None:
            curves[role] = curve
            shares[role] = coverage(chosen, nominal=COVERAGE_CURVE).over_all
    figure = check_figures.coverage_figure(curves, shares) if curves else None
    return embed(figure, "PIT-ECDF and coverage of the predictive bands") if figure else None


def _recording_views(record: PosteriorRecord, summary: Mapping[str, Any]) -> list[RecordingView]:
    """Test recordings first; of many, the first `MOST_RECORDINGS` get figures."""
    ordered = sorted(record.recordings, key=lambda r: r.split != "test")
    settled = settled_rows([MeasuredPath.of_prediction(r) for r in ordered])
    views: list[RecordingView] = []
    for recording, row in list(zip(ordered, settled, strict=True))[:MOST_RECORDINGS]:
        already = sum(view.split == recording.split for view in views)
        views.append(_recording_view(recording, row, summary, opened=already < OPEN_RECORDINGS))
    return views


def _recording_view(
    recording: RecordingPrediction, settled: int | None, summary: Mapping[str, Any], *, opened: bool
) -> RecordingView:
    errors = (summary["errors"].get(recording.split) or {}).get("recordings", {}).get(recording.name, {})
    return RecordingView(
        recording.name,
        recording.split,
        errors.get("over_time"),
        embed(trajectory_figures.bands_figure(recording), f"{recording.name}: measured and predicted over time"),
        embed(trajectory_figures.path_figure(recording), f"{recording.name}: path of the last marker"),
        embed(
            trajectory_figures.residual_figure(recording, settled), f"{recording.name}: residuals of the last marker"
        ),
        opened,
    )


def limits(summary: Mapping[str, Any]) -> list[str]:
    """Sentences on limits of every run and of this run, and the caller's."""
    sentences = [
        "Every interval is conditional on the simulator being right but for its parameters and the stated noise. A "
        "mechanism that is missing (friction, hysteresis, creep, a delay) is taken up by the parameters, which then "
        "are precise and wrong. The residuals and the coverage of the bands show whether this happened here.",
        "Cables whose length is imposed leave one scale free: every stiffness, mass and force multiplied by one factor "
        "gives the same motion. Only ratios are then known, unless a force or a mass was measured.",
    ]
    if not summary["rmse"]["test"]:
        sentences.append("No recording was kept back: the errors are of the fitted data.")
    if not summary.get("noise_floor_mm"):
        sentences.append("No experiment was repeated: noise and model error cannot be distinguished.")
    if summary["recordings"] and all(r["synthetic"] for r in summary["recordings"]):
        sentences.append("The recordings are synthetic: a simulator made them, and no real robot is described here.")
    masked = sum(r["masked"] for r in summary["recordings"])
    if masked:
        total = sum(r["positions"] for r in summary["recordings"])
        sentences.append(
            f"{masked} of {total} marker positions are left out as recording faults; the motion at these "
            "times is unknown."
        )
    chains = [row.get("r_hat") for row in summary["parameters"].values()]
    if chains and all(value is None for value in chains):
        sentences.append("There is one chain only: whether independent runs would agree was not measured.")
    return [*sentences, *summary.get("limits", [])]
