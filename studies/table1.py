"""``python -m studies table1``: the paper's Table I with its rivals and with truths that its table lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.cautions import grave, read_cautions
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import write_json, write_text
from rfdropo_bayes.inference.progress import Progress
from rfdropo_bayes.model.run_folder import COMMANDS, LOG, RunKind, run_folder
from rfdropo_bayes.report.facts import software_versions
from studies.comparison import RIVALS, ROWS, fit, misleads
from studies.fits import finished, run_fits
from studies.rivals import import_sbi
from studies.virtual_tasks import TASKS

COMMANDS["table1"] = RunKind(("table1.json", "table1.md", "table1.png", "fits.jsonl"), resumable=True, shared=True)

PAPER = {  # mean squared error and its deviation, Table I
    "TrunkReach": {"BayesSim": (16.60, 0.30), "NPDR": (8.38, 3.22), "RF-DROPO": (1.70, 1.93)},
    "TrunkPush": {"BayesSim": (25.50, 5.14), "NPDR": (1.71, 0.17), "RF-DROPO": (0.62, 0.34)},
}
NEEDS_SBI = ("BayesSim", "NPDR")
OWN = ("ours", "ours + tension")
NO_FITS = ("prior", "mid-range")
TRUTHS = ("paper", "off-centre")
FIGURES = {
    "mse": "MSE",
    "mse_excited": "MSE, told",
    "ratio_error_percent": "E / mass [%]",
    "poisson_error_percent": "Poisson [%]",
    "log_score": "log score",
    "held_out_mm": "held out [mm]",
    "rollouts": "rollouts",
    "seconds": "s",
}
"""Figures of a fit, with their headings; coverage, which many fits have together, stands behind the fourth."""
COMPARED = {"mse": 1, "ratio_error_percent": 1, "poisson_error_percent": 1, "held_out_mm": 1, "log_score": -1}
"""Figures that rows are compared in, 1 where less is better."""
PANELS = (
    ("mse_excited", "MSE of what the motion tells (ranges scaled to [0, 4])"),
    ("held_out_mm", "held-out tip error [mm]"),
)
COLOURS = {"paper": "#4c72b0", "off-centre": "#dd8452"}


@dataclass(frozen=True)
class Table1Size:
    """How large the benchmark is.

    Attributes:
        truths: off-centre truths for our rows.
        rival_truths: off-centre truths, and data sets at the paper's truth, for every other row.
        budget: rollouts per posterior.
        actions: length of the recording, in moves of 50 ms; the paper's has 100.
        seed: of everything.
        repeats: data sets at the paper's truth for our rows, if there are as many truths.
    """

    truths: int = 100
    rival_truths: int = 5
    budget: int = 10000
    actions: int = 100
    seed: int = 0
    repeats: int = 20

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if value < (0 if name == "seed" else 1):
                raise InputError(f"{name} = {value} is too small", where="table1")


def run_table1(
    out: Path,
    size: Table1Size,
    *,
    rows: Sequence[str] = tuple(ROWS),
    tasks: Sequence[str] = tuple(TASKS),
    resume: bool = False,
    cluster: str | None = None,
    only_done: bool = False,
    overwrite: bool = False,
    command: str = "",
) -> dict[str, Any]:
    """Do all fits and write ``table1.json``, ``table1.md`` and ``table1.png``; fits.jsonl keeps each fit as it ends.

    With ``only_done`` no fit is done: the tables are those of what fits.jsonl holds of an interrupted run.

    Raises:
        InputError: an unknown row or task, or a folder that cannot be written.
    """
    for kind, given, known in (("row", rows, ROWS), ("task", tasks, TASKS)):
        for name in given:
            if name not in known:
                raise InputError(f"unknown {kind} {name!r}", where=f"--{kind}", remedy=f"some of {', '.join(known)}")
    # A study may grow: more truths, rows and tasks go on with the fits that are there.
    options = {"budget": size.budget, "actions": size.actions, "seed": size.seed}
    going_on = resume or only_done
    with run_folder(out, "table1", options=options, resume=going_on, overwrite=overwrite) as out:
        left_out = _without_sbi(rows)
        jobs = list_jobs(size, [row for row in rows if row not in left_out], tasks)
        ledger = out / "fits.jsonl"
        if only_done:
            done = finished(jobs, ledger)
        else:
            with Progress("table1", show=None, log=out / LOG) as progress:
                done = run_fits(jobs, fit, ledger, resume=resume, cluster=cluster, progress=progress)
        # Ledgers older than this figure have no cube: their motion tells of all parameters.
        found = [{"mse_excited": result.get("mse"), **result} for result in done]
        content = {
            "schema_version": 1,
            "command": command,
            "size": asdict(size),
            "left_out": left_out,
            "not_done": len(jobs) - len(done),
            "paper": PAPER,
            "cells": summarise(found),
            "claims": claims(found),
            "ahead_of_ours": ahead_of_ours(found),
            "misleading": misleading(found),
            "by_caution": by_caution(found),
            "versions": software_versions(),
        }
        write_json(out / "table1.json", content)
        write_text(out / "table1.md", as_markdown(content))
        draw_figure(content, out / "table1.png")
    return content


def list_jobs(size: Table1Size, rows: Sequence[str], tasks: Sequence[str] = tuple(TASKS)) -> list[dict[str, Any]]:
    """Every fit; rows share their truths and data, so that they can be compared in pairs. Cheap rounds come first."""
    shared = {"budget": size.budget, "actions": size.actions, "seed": size.seed}
    jobs = []
    for index in range(max(size.truths, size.rival_truths)):
        for truths in TRUTHS:
            for task in tasks:
                own = size.truths if truths == "off-centre" else min(size.truths, size.repeats)
                chosen = [row for row in rows if index < (own if row in OWN else size.rival_truths)]
                jobs += [{"task": task, "row": row, "truths": truths, "index": index, **shared} for row in chosen]
    return jobs


def _without_sbi(rows: Sequence[str]) -> dict[str, str]:
    """Rows that the optional package is missing for, with the reason."""
    if not any(row in NEEDS_SBI for row in rows):
        return {}
    try:
        import_sbi()
    except InputError as error:
        return {row: str(error) for row in rows if row in NEEDS_SBI}
    return {}


def summarise(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Mean, deviation and median of every figure, and pooled coverage, per task, kind of truth and row."""
    cells = []
    for task in TASKS:
        for truths in TRUTHS:
            for row in ROWS:
                members = [r for r in found if (r["task"], r["truths"], r["row"]) == (task, truths, row)]
                done = [r for r in members if "failed" not in r]
                if not members:
                    continue
                cell: dict[str, Any] = {"task": task, "truths": truths, "row": row, "fits": len(done)}
                cell["failed"] = [r["failed"] for r in members if "failed" in r]
                cell |= {figure: _moments([r.get(figure) for r in done]) for figure in FIGURES}
                # A point has no interval to cover anything with.
                inside = [hit for r in done for hit in r["inside_90"]] if row != "mid-range" else []
                cell["coverage_90"] = float(np.mean(inside)) if inside else None
                fitted = row not in NO_FITS
                cell["misleading"] = sum(misleads(TASKS[task], r) for r in done) if fitted else None
                cells.append(cell)
    return cells


def misleading(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Our fits that say less of their truths than the prior does, worst first, with the cautions they gave.

    Cautions are None where the fit is older than their record.
    """
    wrong = [r for r in found if r["row"] in OWN and "failed" not in r and misleads(TASKS[r["task"]], r)]
    kept = ("task", "truths", "row", "index", "log_score")
    entries = [{**{name: r[name] for name in kept}, "cautions": r.get("cautions")} for r in wrong]
    return sorted(entries, key=lambda entry: -np.inf if entry["log_score"] is None else entry["log_score"])


def by_caution(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Coverage of our fits off the centre, those with a grave caution apart from the others.

    Fits older than the record of cautions are left out.
    """
    cells = []
    for task in TASKS:
        for row in OWN:
            known = [r for r in _of(found, task, "off-centre", row) if r.get("cautions") is not None]
            for said in (False, True):
                fits = [r for r in known if bool(grave(read_cautions(r["cautions"]))) == said]
                if fits:
                    share = float(np.mean([hit for r in fits for hit in r["inside_90"]]))
                    misled = sum(misleads(TASKS[task], r) for r in fits)
                    facts = {"task": task, "row": row, "said": said, "fits": len(fits)}
                    cells.append(facts | {"coverage_90": share, "misleading": misled})
    return cells


def _moments(values: Sequence[float | None]) -> dict[str, float | None]:
    known = np.array([value for value in values if value is not None], dtype=float)
    if len(known) == 0:
        return {"mean": None, "sd": None, "median": None}
    sd = float(known.std(ddof=1)) if len(known) > 1 else None
    return {"mean": float(known.mean()), "sd": sd, "median": float(np.median(known))}


def claims(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What ours is meant to achieve, checked: the claim, the number behind it, and whether it holds at this size."""
    checked = []
    for task in TASKS:
        at = partial(_of, found, task, "off-centre")
        plain, tension = at("ours"), at("ours + tension")
        if plain:
            for figure, words in (("ratio_error_percent", "E / mass"), ("poisson_error_percent", "Poisson's ratio")):
                value = float(np.median([r[figure] for r in plain]))
                checked.append(
                    _claim(task, f"median error of {words} at most 1 % without tension", value, value <= 1.0)
                )
            share = float(np.mean([hit for r in plain for hit in r["inside_90"]]))
            checked.append(_claim(task, "90 % intervals hold 85 to 95 % of the truths", share, 0.85 <= share <= 0.95))
        if tension:
            value = float(np.mean([r["mse_excited"] for r in tension]))
            words = "the paper's error of what the motion tells at most 0.05 with tension"
            checked.append(_claim(task, words, value, value <= 0.05))
        for rival in RIVALS:
            excess = _paired(plain, at(rival))
            if excess is not None:
                words = f"held-out error not worse than {rival}'s by more than 2 paired standard errors"
                checked.append(_claim(task, words, excess, excess <= 2.0))
    return checked


def _of(found: Sequence[Mapping[str, Any]], task: str, truths: str, row: str) -> list[Mapping[str, Any]]:
    return [r for r in found if (r["task"], r["truths"], r["row"]) == (task, truths, row) and "failed" not in r]


def _claim(task: str, words: str, value: float, holds: bool) -> dict[str, Any]:
    return {"task": task, "claim": words, "value": value, "holds": bool(holds)}


def _paired(own: Sequence[Mapping[str, Any]], rival: Sequence[Mapping[str, Any]]) -> float | None:
    """Mean excess of our held-out error over a rival's in its standard errors; None for fewer than two pairs."""
    pairs = _pairs(own, rival, "held_out_mm")
    return None if len(pairs) < 2 else _standard_errors(pairs[:, 0] - pairs[:, 1])


def _pairs(own: Sequence[Mapping[str, Any]], rival: Sequence[Mapping[str, Any]], figure: str) -> np.ndarray:
    """A figure of ours and of a rival's, side by side, for the data sets that both have."""
    theirs = {r["index"]: r[figure] for r in rival if r[figure] is not None}
    pairs = [(r[figure], theirs[r["index"]]) for r in own if r["index"] in theirs and r[figure] is not None]
    return np.array(pairs, dtype=float).reshape(-1, 2)


def _standard_errors(excess: Float[np.ndarray, " n"]) -> float:
    return float(excess.mean() / max(float(excess.std(ddof=1)) / np.sqrt(len(excess)), 1e-12))


def ahead_of_ours(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Every figure in which another row is on average better than ours without tension on the data that both have:
    the two means, and by how many paired standard errors they differ."""
    listed = []
    for task in TASKS:
        for truths in TRUTHS:
            own = _of(found, task, truths, "ours")
            for row in (row for row in ROWS if row not in OWN):
                for figure, sign in COMPARED.items():
                    pairs = _pairs(own, _of(found, task, truths, row), figure)
                    excess = sign * (pairs[:, 0] - pairs[:, 1])
                    if len(pairs) < 2 or excess.mean() <= 0.0:
                        continue
                    where = {"task": task, "truths": truths, "row": row, "figure": figure, "data_sets": len(pairs)}
                    means = {"ours": float(pairs[:, 0].mean()), "theirs": float(pairs[:, 1].mean())}
                    listed.append(where | means | {"standard_errors": _standard_errors(excess)})
    return listed


def as_markdown(content: Mapping[str, Any]) -> str:
    """The table for people."""
    size = content["size"]
    lines = [
        "# Table I, with the rows it lacks",
        "",
        f"`{content['command']}`",
        "",
        f"Recordings of {size['actions']} actions; at most {size['budget']} rollouts per posterior. Our rows: "
        f"{size['truths']} truths off the centre, {min(size['truths'], size['repeats'])} data sets at the truth of the "
        f"paper; the others {size['rival_truths']} of each. Mean ± standard deviation. "
        "MSE: the paper's, in ranges scaled to [0, 4]; told: of the parameters that the motion tells of, which are "
        "those of a cube only where it is pushed by 5 mm. Held out: tip error of the mean prediction under commands "
        "that no fit saw. Misleading: fits whose log score is below the prior's log density at the truth.",
        "",
    ]
    for task in dict.fromkeys(cell["task"] for cell in content["cells"]):
        done = {cell["truths"] for cell in content["cells"] if cell["task"] == task}
        for truths in [kind for kind in TRUTHS if kind in done]:
            lines += [f"## {task}, {'the truth of the paper' if truths == 'paper' else 'off-centre truths'}", ""]
            names = list(FIGURES.values())
            headings = ["row", "fits", *names[:4], "90 % coverage", "misleading", *names[4:]]
            lines += [f"| {' | '.join(headings)} |", f"|{'---|' * len(headings)}"]
            cells = [c for c in content["cells"] if (c["task"], c["truths"]) == (task, truths)]
            lines += [_row(cell) for cell in cells] + [""]
    lines += ["## Claims", "", "| claim | value | holds |", "|---|---|---|"]
    lines += [
        f"| {c['task']}: {c['claim']} | {c['value']:.3g} | {'yes' if c['holds'] else 'NO'} |" for c in content["claims"]
    ]
    lines += ["", "## Where another row is better than ours without tension, on the same data", ""]
    lines += [_ahead(entry) for entry in content["ahead_of_ours"]] or ["Nowhere."]
    if content["by_caution"]:
        lines += ["", "## Off-centre fits of ours by whether the sampler said that it did not arrive", ""]
        lines += ["| task | row | it said so | fits | 90 % coverage | misleading |", "|---|---|---|---|---|---|"]
        lines += [_told(cell) for cell in content["by_caution"]]
    lines += ["", "## Posteriors of ours that mislead, and whether they said so", ""]
    lines += [_misled(entry) for entry in content["misleading"]] or ["None."]
    missing = [f"{row}: {reason}" for row, reason in content["left_out"].items()]
    if content["not_done"]:
        missing.append(f"{content['not_done']} fits that were not done; the column of fits says how many were")
    missing += [f"{c['row']}, {c['truths']}: {reason}" for c in content["cells"] for reason in c["failed"]]
    if missing:
        lines += ["", "## Left out or failed", "", *(f"- {line}" for line in missing)]
    lines += ["", "The paper: " + "; ".join(_published(task) for task in PAPER) + "."]
    return "\n".join(lines) + "\n"


def _kind(truths: str) -> str:
    return "the paper's truth" if truths == "paper" else "off-centre"


def _told(cell: Mapping[str, Any]) -> str:
    share = f"{100 * cell['coverage_90']:.1f} %"
    entries = [cell["task"], cell["row"], "yes" if cell["said"] else "no", cell["fits"], share, cell["misleading"]]
    return f"| {' | '.join(map(str, entries))} |"


def _misled(entry: Mapping[str, Any]) -> str:
    cautions = entry["cautions"]
    said = "cautions not recorded" if cautions is None else "; ".join(c["sentence"] for c in cautions) or "no caution"
    place = f"{entry['task']}, {_kind(entry['truths'])} {entry['index']}, {entry['row']}"
    score = "no spread" if entry["log_score"] is None else f"log score {entry['log_score']:.3g}"
    return f"- {place}: {score}; {said}"


def _ahead(entry: Mapping[str, Any]) -> str:
    place = f"{entry['task']}, {_kind(entry['truths'])}, {FIGURES[entry['figure']]}"
    return (
        f"- {place}: {entry['row']} {entry['theirs']:.3g}, ours {entry['ours']:.3g} "
        f"({entry['data_sets']} data sets, {entry['standard_errors']:.1f} standard errors)"
    )


def _published(task: str) -> str:
    return f"{task} " + ", ".join(f"{row} {mean:g} ± {sd:g}" for row, (mean, sd) in PAPER[task].items())


def _row(cell: Mapping[str, Any]) -> str:
    def moments(figure: str) -> str:
        entry = cell[figure]
        if entry["mean"] is None:
            return "-"
        spread = "" if entry["sd"] is None else f" ± {entry['sd']:.2g}"
        return f"{entry['mean']:.3g}{spread}"

    coverage = "-" if cell["coverage_90"] is None else f"{100 * cell['coverage_90']:.0f} %"
    figures = [moments(figure) for figure in FIGURES]
    misleading = "-" if cell["misleading"] is None else cell["misleading"]
    entries = [cell["row"], cell["fits"], *figures[:4], coverage, misleading, *figures[4:]]
    return f"| {' | '.join(map(str, entries))} |"


def draw_figure(content: Mapping[str, Any], path: Path) -> None:
    """Points with one standard deviation, on logarithmic axes; the paper's own values as crosses."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tasks = list(dict.fromkeys(cell["task"] for cell in content["cells"]))
    of_task = {task: [cell for cell in content["cells"] if cell["task"] == task] for task in tasks}
    rows_of = {task: list(dict.fromkeys(cell["row"] for cell in cells)) for task, cells in of_task.items()}
    heights = [1.3 + 0.35 * len(rows) for rows in rows_of.values()]
    size = (11, 0.2 + sum(heights))
    figure, axes = plt.subplots(len(tasks), 2, squeeze=False, sharey="row", figsize=size, height_ratios=heights)
    for task, line in zip(tasks, axes, strict=True):
        cells, rows = of_task[task], rows_of[task]
        for (key, label), ax in zip(PANELS, line, strict=True):
            for cell in cells:
                mean, sd = cell[key]["mean"], cell[key]["sd"] or 0.0
                if mean is None:
                    continue
                shift = 0.15 if cell["truths"] == "paper" else -0.15
                # The lower end stays positive: the axis is logarithmic.
                spread = [[min(sd, 0.95 * mean)], [sd]]
                ax.errorbar(
                    mean, rows.index(cell["row"]) + shift, xerr=spread, fmt="o", ms=4, color=COLOURS[cell["truths"]]
                )
            ax.set(xscale="log", xlabel=label, yticks=range(len(rows)), yticklabels=rows, title=task)
            ax.xaxis.set_minor_formatter("")  # within one decade its labels lie upon each other
            ax.grid(axis="x", alpha=0.3)
        for name, (mean, _) in content["paper"][task].items():
            beside = [i for i, row in enumerate(rows) if row.startswith(name)][:1]
            line[0].plot([mean] * len(beside), beside, "kx")
        line[0].set_ylim(len(rows) - 0.5, -0.5)
    handles = [plt.Line2D([], [], marker="o", ls="", color=c, label=f"{k} truth") for k, c in COLOURS.items()]
    handles.append(plt.Line2D([], [], marker="x", ls="", color="k", label="published"))
    axes[0, 1].legend(handles=handles, fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)
