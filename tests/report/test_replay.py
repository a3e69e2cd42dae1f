"""The replay of a page: what it holds is what was measured and simulated, and in a browser it moves."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rfdropo_bayes.posteriors import RecordingPrediction
from rfdropo_bayes.report import build_summary, render_page
from rfdropo_bayes.report.replay import FRAMES, Track, replay, tracks_of

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
OUTLINE = {"station": [0.0, 0.2], "half_width": [[0.02, 0.02], [0.01, 0.01]], "gravity": [9.81, 0.0, 0.0]}


def circle(rows: int = 60, name: str = "circle") -> Track:
    time = np.linspace(0.0, 3.0, rows)
    turn = np.stack([np.cos(time), np.sin(time), 3.0 + 0.0 * time], axis=-1)
    heights = np.array([0.3, 1.0])[:, None]
    measured = 0.05 * turn[:, None] * heights
    measured[3, 1] = np.nan
    return Track(
        name, "test", time, ("middle", "tip"), {"measured": measured, "after the fit": 0.05 * turn[:, None] * heights}
    )


def content(tracks: list[Track]) -> dict:
    text = replay(tracks, OUTLINE)
    assert text is not None
    return json.loads(text)


def test_positions_are_tenths_of_a_millimetre_and_gaps_stay_gaps():
    track = circle()
    plain = content([track])["tracks"][0]
    back = np.array([np.nan if v is None else v for v in plain["series"]["measured"]], float).reshape(60, 2, 3)
    assert np.nanmax(np.abs(back - 1e4 * track.series["measured"])) <= 0.5
    np.testing.assert_array_equal(np.isnan(back), np.isnan(track.series["measured"]))


def test_long_recordings_are_thinned_to_their_ends():
    plain = content([circle(5000)])["tracks"][0]
    assert len(plain["time"]) == FRAMES
    assert (plain["time"][0], plain["time"][-1]) == (0.0, 3.0)
    assert len(plain["series"]["measured"]) == 6 * FRAMES


def test_a_name_cannot_end_the_script():
    text = replay([circle(name="</script><b>")], None)
    assert text is not None
    assert "<" not in text
    assert json.loads(text)["tracks"][0]["name"] == "</script><b>"


def test_masked_positions_are_gaps_and_the_mean_is_what_moves():
    observed = np.ones((4, 1, 3))
    mask = np.array([[True], [False], [True], [True]])
    drawn = np.stack([np.zeros((4, 1, 3)), np.full((4, 1, 3), 2.0)])
    recording = RecordingPrediction(
        "one", "fit", np.arange(4.0), ("tip",), observed, mask, drawn, prior_predicted=drawn + 1
    )
    (track,) = tracks_of([recording])
    assert list(track.series) == ["measured", "before the fit", "after the fit"]
    assert np.isnan(track.series["measured"][1]).all()
    assert (track.series["after the fit"] == 1.0).all()
    assert (track.series["before the fit"] == 2.0).all()


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
@pytest.mark.parametrize("width", [400, 1400])
def test_in_a_browser_it_moves_without_a_message_on_the_console(tmp_path: Path, run: Any, width: int):
    page = tmp_path / "report.html"
    page.write_text(render_page(run.record, build_summary(run.record, run.facts), ""))
    done = subprocess.run(
        [
            *(str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900"),
            *(f"--user-data-dir={tmp_path / 'profile'}", "--no-first-run", "--enable-logging=stderr", "--v=0"),
            *("--virtual-time-budget=2500", "--dump-dom", page.as_uri()),
        ],
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    )
    frame = re.search(r'data-frame="(\d+)"', done.stdout)
    assert frame is not None
    assert int(frame[1]) > 0
    assert re.search(r"after the fit: [0-9.]+ mm off at ", done.stdout)
    assert "CONSOLE" not in done.stderr
