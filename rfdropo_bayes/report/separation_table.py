"""What `rfdropo separate` found, as a table and a figure; see ``audit.separation``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rfdropo_bayes.report import style

ALIKE = 0.95


def separation_markdown(content: Mapping[str, Any]) -> str:
    """Tables of the variants, and of the cosines between effects."""
    groups = content["groups"]
    lines = [
        f"Without any: {content['rmse_none_mm']:.2f} mm. With all: {content['rmse_all_mm']:.2f} mm, log evidence "
        f"{content['log_evidence_all_over_none']:+.1f}.",
        "",
        "| | alone [nats] | error [mm] | without [nats] | error [mm] | own share | sizes with all (5 % to 95 %) |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in groups.items():
        sizes = "; ".join(
            f"{size} {v['median']:.3g} ({v['q05']:.3g} to {v['q95']:.3g}) {v['unit']}"
            for size, v in row["sizes_with_all"].items()
        )
        lines.append(
            f"| {name.replace('_', ' ')} | {row['gain_alone']:+.1f} | {row['rmse_alone_mm']:.2f} | "
            f"{-row['loss_without']:+.1f} | {row['rmse_without_mm']:.2f} | {row['own_share']:.2f} | "
            f"{sizes if len(row['members']) == 1 else ', '.join(row['members'])} |"
        )
    lines += ["", "Cosines between effects:", "", "| |" + "|".join(name.replace("_", " ") for name in groups) + "|"]
    lines.append("|---" * (len(groups) + 1) + "|")
    for name, row in zip(groups, content["cosines"], strict=True):
        lines.append(f"| {name.replace('_', ' ')} | " + " | ".join(f"{value:.2f}" for value in row) + " |")
    return "\n".join(lines) + "\n"


@style.styled
def separation_figure(content: Mapping[str, Any]) -> Figure:
    """Evidence that each brings alone and that is lost without it, and how alike the effects are."""
    names = list(content["groups"])
    titles = [name.replace("_", " ") for name in names]
    figure = Figure(figsize=(style.WIDTH, 1.2 + 0.34 * len(names)))
    bars, cosines = figure.subplots(1, 2, width_ratios=[1.2, 1.0])
    place = np.arange(len(names))
    for shift, key, label in ((-0.2, "gain_alone", "gained by it alone"), (0.2, "loss_without", "lost without it")):
        bars.barh(place + shift, [content["groups"][name][key] for name in names], 0.38, label=label)
    bars.set_xscale("symlog", linthresh=10.0)
    bars.set_yticks(place, titles)
    bars.invert_yaxis()
    bars.set_xlabel("log evidence [nats]")
    bars.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    values = np.array(content["cosines"])
    cosines.imshow(values, vmin=0.0, vmax=1.0, cmap="Blues")
    cosines.grid(visible=False)
    cosines.set_xticks(place, titles, rotation=60, ha="right")
    cosines.set_yticks(place, [])
    cosines.set_title(f"cosine of the effects; above {ALIKE:g} they cannot be told apart")
    for row, column in np.ndindex(*values.shape):
        value = values[row, column]
        cosines.text(
            column,
            row,
            f"{value:.2f}",
            ha="center",
            va="center",
            fontsize=6.5,
            color="white" if value > 0.6 else "black",
        )
    return figure
