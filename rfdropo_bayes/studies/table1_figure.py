"""Figure of the comparison: the paper's error and the held-out error of every row."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

PANELS = (
    ("mse_excited", "MSE of what the motion tells (ranges scaled to [0, 4])"),
    ("held_out_mm", "held-out tip error [mm]"),
)
COLOURS = {"paper": "#4c72b0", "off-centre": "#dd8452"}


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
