"""The comparison of policies as a table and a figure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rfdropo_bayes.report.style import CYCLE, WIDTH, styled


def as_markdown(content: Mapping[str, Any]) -> str:
    """The table for people."""
    size = content["size"]
    lines = [
        "# Table II on a robot that no policy has seen",
        "",
        f"`{content['command']}`",
        "",
        f"Share of episodes that end within a distance of the goal, {size['episodes']} of each policy, the same for "
        "all. The 95 % intervals know chance in episodes and, where a row has several seeds, in trainings.",
        "",
    ]
    for task in dict.fromkeys(row["task"] for row in content["rows"]):
        rows = [row for row in content["rows"] if row["task"] == task]
        names = list(rows[0]["success"])
        heads = ["row", *(f"{name} mm" for name in names), "median [mm]", "seeds", "15.25 mm by seed", "steps", "s"]
        lines += [f"## {task}", "", f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
        lines += [_row(row) for row in rows]
        lines.append("")
    if content["claims"]:
        lines += ["## Claims", "", "| task | claim | value | holds |", "|---|---|---|---|"]
        lines += [
            f"| {c['task']} | {c['claim']} | {c['value']:.2f} | {'yes' if c['holds'] else 'no'} |"
            for c in content["claims"]
        ]
        lines.append("")
    if content["failed"] or content["not_done"]:
        lines += [f"{content['not_done']} cells are not done.", ""]
        lines += [f"- {cell}: {why}" for cell, why in content["failed"].items()]
    paper = ", ".join(f"{100 * share:.0f} % within {name} mm" for name, share in content["paper"].items())
    lines += ["", f"The paper, RF-DROPO on hardware, TrunkPush: {paper}."]
    return "\n".join(lines) + "\n"


def _row(row: Mapping[str, Any]) -> str:
    cells = [f"{100 * s['share']:.0f} % [{100 * s['low']:.0f}, {100 * s['high']:.0f}]" for s in row["success"].values()]
    by_seed = ", ".join(f"{100 * share:.0f}" for share in row["by_seed"])
    entries = [row["row"], *cells, f"{row['median_mm']:.1f}", row["seeds"], by_seed, f"{row['steps']:,}"]
    return f"| {' | '.join(map(str, entries))} | {row['training_seconds']:.0f} |"


@styled
def draw_figure(content: Mapping[str, Any]) -> Figure:
    """Success of every row at every distance, with its interval; there is a row at least."""
    tasks = list(dict.fromkeys(row["task"] for row in content["rows"]))
    heights = [1.0 + 0.4 * sum(row["task"] == task for row in content["rows"]) for task in tasks]
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(tasks), 1, squeeze=False, height_ratios=heights)[:, 0]
    for task, axes in zip(tasks, panels, strict=True):
        rows = [row for row in content["rows"] if row["task"] == task]
        names = list(rows[0]["success"])
        for k, (name, colour) in enumerate(zip(names, CYCLE, strict=False)):
            for place, row in enumerate(rows):
                found = row["success"][name]
                share, low, high = (100.0 * found[key] for key in ("share", "low", "high"))
                axes.errorbar(
                    share, place + 0.2 * (k - 1), xerr=[[share - low], [high - share]], fmt="o", ms=4, color=colour,
                    label=f"within {name} mm" if place == 0 else None,
                )  # fmt: skip
        axes.set(xlim=(-2, 102), xlabel="episodes [%]", title=task)
        axes.set_yticks(range(len(rows)), [row["row"] for row in rows])
        axes.invert_yaxis()
        axes.legend(loc="best")
    return figure
