"""The page of a training: what it advises has a ground, and its tables sort in a browser."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.policies.evaluation import Case, Episode
from rfdropo_bayes.policies.policy_figures import draws_figure
from rfdropo_bayes.policies.policy_page import Played, next_steps, render_policy
from rfdropo_bayes.report.style import embed

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)


def curve(*medians: float) -> list[dict]:
    row = {"reward": 1.0, "distance_q05": 0.001, "distance_q95": 0.05}
    return [{**row, "steps": 1000 * k, "distance_median": median} for k, median in enumerate(medians, 1)]


def played(slope: float = 0.0, failed: int = 0, count: int = 100) -> Played:
    """Episodes that end farther from the goal the stiffer the trunk is, by ``slope``, the first few of which fail."""
    stiffness = np.linspace(1.0, 2.0, count)
    mass = np.random.default_rng(0).uniform(0.3, 0.4, count)
    rest = np.random.default_rng(1).uniform(0.004, 0.006, count)
    cases = [
        Case({"young_modulus": e, "trunk_mass": m, "poisson_ratio": 0.45}, (0.0, 0.0, 0.1))
        for e, m in zip(stiffness, mass, strict=True)
    ]
    ends = rest + slope * (stiffness - 1.0)
    episodes = [Episode(k, np.array([0.1, end]), 1.0, k < failed, np.zeros((2, 8))) for k, end in enumerate(ends)]
    return Played(cases, episodes, {"the median episode": b"GIF89a"})


SUMMARY = {
    "task": "TrunkReach-v0",
    "algorithm": "PPO",
    "steps": 6000,
    "seconds": 12.0,
    "randomisation": "uniform",
    "seed": "0",
    "evaluation": {"steps": 6000},
    "curve": curve(0.03, 0.02, 0.01),
    "settings": {"tension_limit": 150.0},
    "cautions": [],
    "versions": {"numpy": "2"},
}


def test_a_training_that_still_rose_is_told_to_go_on():
    (still, _) = next_steps({"curve": curve(0.04, 0.03, 0.02, 0.02, 0.01, 0.005)}, played())
    assert "fell from 20.0 to 5.0 mm" in still
    assert len(next_steps({"curve": curve(0.04, 0.01, 0.01, 0.01, 0.01, 0.0095)}, played())) == 1


def test_a_parameter_that_the_policy_does_not_cope_with_is_named_and_no_other():
    told = next_steps({"curve": curve(0.01, 0.01)}, played(slope=0.01))
    assert "when young_modulus is large" in told[0]
    assert not any("trunk_mass" in sentence for sentence in told)
    assert not any("poisson_ratio" in sentence for sentence in told)  # the same in every episode


def test_failed_simulations_are_counted():
    told = next_steps({"curve": curve(0.01, 0.01)}, played(failed=3))
    assert told[0].startswith("3 of 100 simulations failed")


@pytest.mark.slow
def test_stopped_episodes_are_counted_and_leave_a_median_that_is_no_number():
    seen = played(failed=1)
    pulls = [replace(each, tension=100.0, stopped=each.case > 40) for each in seen.episodes]
    seen = seen._replace(episodes=pulls)
    told = next_steps({"curve": curve(0.01, 0.01)}, seen)
    assert told[0].startswith("59 of 100 episodes were stopped by the limit on tension: train longer")
    page = render_policy(SUMMARY, seen, "My arm", "")
    assert "Fewer than half of 100 episodes reach an end (59 stopped by the limit on tension, 1 failed)," in page
    assert "inf" not in page[page.index('id="result"') : page.index('id="success"')]
    assert "Half of 100 episodes end within" in render_policy(SUMMARY, played(), "My arm", "")


def test_the_page_says_how_often_the_policy_succeeds():
    page = render_policy(SUMMARY, played(failed=3), "My arm", "seed = 0")
    assert "97 %" in page
    assert "data:image/gif;base64,R0lGODlh" in page
    assert page.count('<td class="n">failed</td>') == 3


def test_the_page_tells_of_tensions_and_of_what_speaks_against_the_posterior():
    seen = played()
    pulls = [replace(each, tension=100.0 + each.case, stopped=each.case > 50) for each in seen.episodes]
    caution = {"code": "unsafe_posterior", "sentence": "runs/fit is not safe", "grave": False}
    page = render_policy({**SUMMARY, "cautions": [caution]}, seen._replace(episodes=pulls), "My arm", "")
    assert "at most 150 N in half of the episodes, 199 N in all; the limit of 150 N stopped 49 of them" in page
    assert page.count('<td class="n">stopped</td>') == 8  # the worst episodes
    assert "<strong>Warning:</strong> runs/fit is not safe." in page
    assert "Warning" not in render_policy(SUMMARY, seen, "My arm", "")


@pytest.mark.parametrize("count", [1, 4, pytest.param(7, marks=pytest.mark.slow)])
def test_every_parameter_has_its_panel_however_the_grid_fills(count: int):
    values = {f"p{k}": np.linspace(1.0, 2.0, 20) for k in range(count)}
    figure = draws_figure(values, np.full(20, 0.01))
    shown = [axes for axes in figure.axes if axes.axison]
    assert [axes.get_xlabel() for axes in shown] == list(values)
    assert len(embed(figure, "draws").panels) in (1, count)
    figure.draw_without_rendering()
    assert max(len(axes.get_xticks()) for axes in shown) <= 7  # labels of a third of the page; one beyond each end


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_its_tables_sort_in_a_browser(tmp_path: Path):
    page = render_policy(SUMMARY, played(slope=0.01), "My arm", "")
    clicks = "const heads = document.querySelectorAll('#draws th.sorts'); heads[3].click();"
    path = tmp_path / "report.html"
    path.write_text(page.replace("</body>", f"<script>{clicks}</script></body>"))
    done = subprocess.run(
        [
            *(str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"),
            *(f"--user-data-dir={tmp_path / 'profile'}", "--enable-logging=stderr", "--v=0"),
            *("--virtual-time-budget=1000", "--dump-dom", path.as_uri()),
        ],
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "CONSOLE" not in done.stderr
    table = done.stdout[done.stdout.index("The worst episodes") :]
    masses = [float(re.findall(r'<td class="n">([^<]*)</td>', row)[-1]) for row in table.split("<tr>")[2:10]]
    assert masses == sorted(masses)
    assert 'aria-sort="ascending"' in table
