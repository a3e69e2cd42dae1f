"""A moving picture of one recording: measured, and simulated before and after a calibration.

    python tools/moving_picture.py DIR RECORDING --out docs/images/before_after.gif

DIR is the folder of a calibration, RECORDING the name of one of its test recordings. Before: nominal parameters.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

import rfdropo_bayes as rb
from rfdropo_bayes.report.motion import smooth_line, upright
from rfdropo_bayes.report.style import MEASURED, POSTERIOR, TEST

FRAMES, FRAMES_A_SECOND = 60, 12


def main() -> None:
    """Predict, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("recording")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    model = rb.Model.read(asked.run / "config.toml")
    measured = next(run for run in model.recordings("test") if run.name == asked.recording)
    after = next(p for p in rb.load(asked.run).record.recordings if p.name == asked.recording)
    before = rb.simulate(model, [measured])[0].position
    rotation = upright(model.robot.gravity)
    seen = np.where(measured.position_mask[..., None], measured.position, np.nan) @ rotation.T
    found = [before @ rotation.T, after.central @ rotation.T]
    draw(measured.time, seen, found, model.robot.marker_points()[:, 2], asked.out)


def draw(time: np.ndarray, seen: np.ndarray, found: list[np.ndarray], rest: np.ndarray, out: Path) -> None:
    """Two views side by side, one for each prediction; positions in metres, the third axis upwards."""
    errors = [1e3 * np.sqrt(np.nanmean(np.sum((path - seen)[:, -1] ** 2, axis=-1))) for path in found]
    figure, panels = plt.subplots(1, 2, figsize=(8.4, 3.6), subplot_kw={"projection": "3d"}, layout="constrained")
    every = 1e3 * np.concatenate([seen.reshape(-1, 3), *(path.reshape(-1, 3) for path in found), np.zeros((1, 3))])
    low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
    rows = np.linspace(0, len(time) - 1, min(FRAMES, len(time))).round().astype(int)
    lines = [
        smooth_line(np.concatenate([np.zeros((len(path), 1, 3)), path], axis=1), np.r_[0.0, rest])[0] for path in found
    ]
    artists = []
    for axes, words, colour in zip(panels, ("before calibration", "after calibration"), (TEST, POSTERIOR), strict=True):
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(np.maximum(high - low, 1.0))
        axes.set_axis_off()
        axes.view_init(elev=18, azim=-62)
        error = errors[words.startswith("after")]
        axes.set_title(f"{words}: tip off by {error:.0f} mm", color=colour, fontsize=11)
        body = axes.plot([], [], [], color=colour, linewidth=7, alpha=0.55, solid_capstyle="round")[0]
        trail = axes.plot([], [], [], color=MEASURED, linewidth=0.8, alpha=0.6)[0]
        dots = axes.plot([], [], [], "o", color=MEASURED, markersize=4)[0]
        artists.append((body, trail, dots))
    caption = figure.supxlabel("", fontsize=9)

    def frame(index: int) -> list:
        row = rows[index]
        for (body, trail, dots), line in zip(artists, lines, strict=True):
            body.set_data_3d(*(1e3 * line[row].T))
            trail.set_data_3d(*(1e3 * seen[: row + 1, -1].T))
            dots.set_data_3d(*(1e3 * seen[row].T))
        caption.set_text(
            f"dots: measured by motion capture; body: simulated from the commands alone; {time[row] - time[0]:.1f} s"
        )
        return []

    out.parent.mkdir(parents=True, exist_ok=True)
    FuncAnimation(figure, frame, len(rows)).save(out, PillowWriter(fps=FRAMES_A_SECOND), dpi=96)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB; tip off by {errors[0]:.1f} and {errors[1]:.1f} mm")


if __name__ == "__main__":
    main()
