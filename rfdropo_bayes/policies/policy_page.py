"""report.html of a training: learning curve, success rate, draws for which the policy fails, and next steps."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import spearmanr

from rfdropo_bayes.policies.episodes import Episodes
from rfdropo_bayes.policies.evaluation import (
    EVALUATION_SEED,
    THRESHOLDS,
    Case,
    Episode,
    draw_cases,
    peak_tension,
    play,
    success,
    tension_sentence,
    without_end,
)
from rfdropo_bayes.policies.onnx_export import ExportedPolicy
from rfdropo_bayes.policies.policy_figures import curve_figure, draws_figure, save_animation, success_figure
from rfdropo_bayes.policies.rendering import frames_of
from rfdropo_bayes.policies.vec_env import TrunkVecEnv
from rfdropo_bayes.report.page import render
from rfdropo_bayes.report.style import embed

SECTIONS = (
    ("result", "Result"),
    ("success", "Success"),
    ("draws", "Draws of the parameters"),
    ("films", "Films"),
    ("curve", "How it learnt"),
    ("reproduce", "To reproduce"),
)
EPISODES = 128  # an interval of 95 % is then at most 17 points wide
WORST = 8  # episodes that the page lists
RISING = 0.8  # median of the last evaluation over that at two thirds of the training, below which it still fell
SIGNIFICANT, STRONG = 0.05, 0.3  # of rank correlations, over all parameters; and their size
EVERY = 2  # frames of an episode that a film shows


class Played(NamedTuple):
    """Episodes of a policy under its own randomisation."""

    cases: Sequence[Case]  # parameters and goals of the episodes
    episodes: Sequence[Episode]  # results of the cases
    films: Mapping[str, bytes]  # GIFs of single episodes, by title

    @property
    def varied(self) -> dict[str, np.ndarray]:
        """The values [SI] of every parameter that differs between episodes."""
        names = self.cases[0].parameters
        values = {name: np.array([case.parameters[name] for case in self.cases]) for name in names}
        return {name: column for name, column in values.items() if np.ptp(column) > 0.0}

    @property
    def distances(self) -> np.ndarray:
        """Distance from the goal at the end of every episode [m]; infinite if simulation or drives failed."""
        return np.array([episode.distance for episode in self.episodes])

    @property
    def stopped(self) -> int:
        """Episodes that the limit on tension stopped."""
        return sum(episode.stopped for episode in self.episodes)

    @property
    def failed(self) -> int:
        """Episodes whose simulation failed."""
        return sum(episode.diverged for episode in self.episodes)


def play_policy(policy: ExportedPolicy, batch: Episodes, seed: int) -> Played:
    """Play a policy under the randomisation of its training, in episodes that the training has not seen."""
    venv = TrunkVecEnv(batch)
    cases = draw_cases(venv, EPISODES, EVALUATION_SEED + seed)
    episodes = play(policy.act, venv, cases, seed)
    ordered = sorted((each for each in episodes if np.isfinite(each.distance)), key=lambda each: each.distance)
    middle = (len(ordered) - 1) // 2
    shown = {"the median episode": ordered[middle], "the worst episode": ordered[-1]} if ordered else {}
    films = {}
    for words, episode in shown.items():
        case = cases[episode.case]
        frames = frames_of(batch, episode.actions, case.parameters, case.goal)
        with TemporaryDirectory() as folder:
            path = save_animation(frames[::EVERY], Path(folder) / "film.gif", EVERY * batch.layout.period_s)
            films[f"{words}, {1e3 * episode.distance:.1f} mm from the goal at its end"] = path.read_bytes()
    return Played(cases, episodes, films)


def render_policy(summary: Mapping[str, Any], played: Played, title: str, config: str) -> str:
    """HTML of the page.

    Args:
        summary: content of summary.json of the training.
        played: episodes of the policy that was kept.
        title: title of the experiment.
        config: the experiment file of the run.
    """
    rates = [(1e3 * limit, *success(played.episodes, limit)) for limit in THRESHOLDS]
    pictures = {
        "curve": embed(curve_figure(summary["curve"]), "Reward and final distance of the evaluations"),
        "success": embed(success_figure({"this policy": played.episodes}, THRESHOLDS), "Share of episodes by distance"),
    }
    if played.varied:
        words = "Final distance against every parameter"
        pictures["draws"] = embed(draws_figure(played.varied, played.distances), words)
    worst = sorted(played.episodes, key=lambda each: -each.distance)[:WORST]
    encoded = {words: base64.b64encode(gif).decode("ascii") for words, gif in played.films.items()}
    pull, middle = peak_tension(played.episodes), float(np.median(played.distances))
    return render(
        "policy.html.j2",
        summary=summary,
        title=title,
        sections=[each for each in SECTIONS if {"draws": played.varied, "films": encoded}.get(each[0], True)],
        pictures=pictures,
        rates=rates,
        parameters=list(played.varied),
        worst=[(each, played.cases[each.case]) for each in worst],
        episodes=len(played.episodes),
        median=1e3 * middle if np.isfinite(middle) else None,
        unended=without_end(played.stopped, played.failed),
        films=encoded,
        tension=None if pull is None else tension_sentence(pull, summary["settings"]["tension_limit"]),
        advice=next_steps(summary, played),
        config=config,
    )


def next_steps(summary: Mapping[str, Any], played: Played) -> list[str]:
    """Recommended next steps, each a sentence with its reason."""
    steps = []
    medians = [np.inf if row["distance_median"] is None else row["distance_median"] for row in summary["curve"]]
    before = medians[(2 * len(medians)) // 3 - 1] if len(medians) > 2 else np.inf
    if medians[-1] < RISING * before < np.inf:
        ratio = f"{1e3 * before:.1f} to {1e3 * medians[-1]:.1f} mm"
        steps.append(f"The median distance fell from {ratio} in the last third of the training: raise training.steps.")
    if played.stopped:
        words = f"{played.stopped} of {len(played.episodes)} episodes were stopped by the limit on tension"
        steps.append(f"{words}: train longer, or raise training.tension_limit if the motors allow more.")
    if played.failed:
        words = f"{played.failed} of {len(played.episodes)} simulations failed"
        steps.append(f"{words}: see for which parameters below, and shorten simulator.time_step or narrow their range.")
    finite = np.isfinite(played.distances)
    for name, values in played.varied.items():
        rank = spearmanr(values[finite], played.distances[finite]) if finite.sum() > 2 else None
        if rank is not None and rank.pvalue * len(played.varied) < SIGNIFICANT and abs(rank.statistic) > STRONG:
            side = "large" if rank.statistic > 0.0 else "small"
            steps.append(
                f"Episodes end farther from the goal when {name} is {side} (rank correlation "
                f"{rank.statistic:.2f}): train longer, or record motions that determine it better."
            )
    steps.append(
        "It has seen a simulator only: play it on another model with rfdropo evaluate, then on simulated drives."
    )
    return steps
