"""What the analysis of a run cannot see, from the numbers of its summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def limits(summary: Mapping[str, Any]) -> list[str]:
    """Sentences that hold for every run, those that hold for this one, and those the caller added."""
    sentences = [
        "Every interval is conditional on the simulator being right but for its parameters and the stated noise. A "
        "mechanism that is missing (friction, hysteresis, creep, a delay) is taken up by the parameters, which then "
        "are precise and wrong. The residuals and the coverage of the bands say whether that is so here.",
        "Cables whose length is imposed leave one scale free: every stiffness, mass and force multiplied by one factor "
        "gives the same motion. Only ratios are then known, unless a force or a mass was measured.",
    ]
    if not summary["rmse"]["test"]:
        sentences.append("No recording was kept back: the errors are those of the data that were fitted.")
    if not summary.get("noise_floor_mm"):
        sentences.append("No experiment was repeated, so nothing tells measurement noise from error of the model.")
    if summary["recordings"] and all(r["synthetic"] for r in summary["recordings"]):
        sentences.append("The recordings are synthetic: a simulator made them, and no real robot is described here.")
    masked = sum(r["masked"] for r in summary["recordings"])
    if masked:
        total = sum(r["positions"] for r in summary["recordings"])
        sentences.append(
            f"{masked} of {total} marker positions are left out as recording faults; what happened then is unknown."
        )
    chains = [row.get("r_hat") for row in summary["parameters"].values()]
    if chains and all(value is None for value in chains):
        sentences.append("There is one chain only: whether independent runs would agree was not measured.")
    return [*sentences, *summary.get("limits", [])]
