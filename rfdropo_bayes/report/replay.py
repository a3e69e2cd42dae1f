"""A replay in three dimensions of measured and simulated motion, drawn by the page itself, offline.

The page holds positions in tenths of a millimetre; `templates/replay.js` draws, rotates and plays them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from rfdropo_bayes.posteriors import RecordingPrediction

FRAMES = 400  # of a recording, at most: eight recordings of four markers in three series are then 1 MB of the page
TENTHS = 1e4  # of a millimetre in a metre
MOST_RECORDINGS = 8


@dataclass(frozen=True)
class Track:
    """Replay of one recording."""

    name: str  # name of the recording
    role: str  # "fit", "test" or "unseen"
    time: Float[np.ndarray, " time"]  # [s]
    markers: tuple[str, ...]  # names, base to tip
    series: Mapping[str, Float[np.ndarray, "time marker 3"]]  # positions [m] by label, "measured" first; NaN if unknown


def tracks_of(recordings: Sequence[RecordingPrediction]) -> list[Track]:
    """Recordings of a calibration: measured, and simulated before the fit (if kept) and after it."""
    tracks = []
    for recording in sorted(recordings, key=lambda r: r.split != "test")[:MOST_RECORDINGS]:
        series = {"measured": np.where(recording.mask[..., None], recording.observed, np.nan)}
        if recording.prior_predicted is not None:
            series["before the fit"] = np.asarray(recording.prior_predicted).mean(axis=0)
        series["after the fit"] = recording.central
        tracks.append(Track(recording.name, recording.split, recording.time, recording.marker_names, series))
    return tracks


def replay(tracks: Sequence[Track], outline: Mapping[str, Any] | None) -> Markup | None:
    """Data of a page's script, as JSON that may stand inside a script element; None without recordings.

    Args:
        tracks: replays to choose from; the first is shown.
        outline: outline of the robot from `robots.robot_shape`: base, width and direction of gravity. Without an
            outline, markers are joined by a line, and the third axis points upwards.
    """
    if not tracks:
        return None
    content: dict[str, Any] = {"tracks": [_plain(track) for track in tracks[:MOST_RECORDINGS]], "outline": None}
    if outline is not None:
        content["outline"] = {
            "base": [0, 0, round(TENTHS * outline["station"][0])],
            "half_width": [round(TENTHS * float(np.mean(pair))) for pair in outline["half_width"]],
            "gravity": list(outline["gravity"]),
        }
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))  # a name may not end the script element


def _plain(track: Track) -> dict[str, Any]:
    rows = np.unique(np.linspace(0, len(track.time) - 1, min(FRAMES, len(track.time))).round().astype(int))
    return {
        "name": track.name,
        "role": track.role,
        "markers": list(track.markers),
        "time": [round(float(t), 4) for t in track.time[rows] - track.time[0]],
        "series": {name: _tenths(np.asarray(values)[rows]) for name, values in track.series.items()},
    }


def _tenths(position: Float[np.ndarray, "time marker 3"]) -> list[int | None]:
    """All numbers in one row, None for an unknown position."""
    flat = TENTHS * np.asarray(position, float).reshape(-1)
    return [None if not np.isfinite(value) else round(value) for value in flat.tolist()]
