"""Evaluation of policies on the same episodes: success within a distance, with intervals.

A case is the start of an episode: parameters of the simulator and a goal. Policies that are compared see the same
cases, in the same order. An episode succeeds if the distance to the goal at its end is within a threshold, as in the
paper's Table II. An episode that ends by a failed simulation or the tension limit fails at every threshold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.stats import binomtest, bootstrap, trim_mean

from rfdropo_bayes.errors import InputError

LONGEST = 10_000  # most actions of an episode
THRESHOLDS = (0.005, 0.01, 0.01525, 0.02157, 0.030)
"""Distances [m] within which an episode succeeds; the last three are the paper's."""
EVALUATION_SEED = 2_000_003  # None of the seeds that training or its evaluations use
Act = Callable[[Float[np.ndarray, "lane size"]], np.ndarray]  # from observations to actions of the environments


@dataclass(frozen=True)
class Case:
    """Start of an episode: values of the simulator's parameters [SI] and the goal [m]."""

    parameters: Mapping[str, float]
    goal: tuple[float, ...]


@dataclass(frozen=True)
class Episode:
    """Result of one case."""

    case: int  # index of the case
    distances: Float[np.ndarray, " action"]  # distance to the goal after every action [m]
    total: float  # sum of rewards
    diverged: bool  # whether the simulation failed; the episode then counts as a failure at every distance
    actions: np.ndarray = field(repr=False)  # the actions taken, to see the episode again
    tension: float = float("nan")  # largest tension of any cable [N]; NaN if the simulator reports none
    stopped: bool = False  # whether a tension beyond the limit ended it; it then counts as a failure at every distance

    @property
    def distance(self) -> float:
        """Distance to the goal at the end [m]; infinite if the simulation failed or the limit on tension ended it."""
        return float("inf") if self.diverged or self.stopped else float(self.distances[-1])


def draw_cases(venv: Any, count: int, seed: int) -> list[Case]:
    """Cases from the distribution that an environment's resets draw from; other seeds have other cases."""
    cases: list[Case] = []
    for turn in range(-(-count // venv.num_envs)):
        venv.seed(_first_seed(seed) + turn * venv.num_envs)
        venv.reset()
        cases += [
            Case({name: float(value) for name, value in info["parameters"].items()}, tuple(map(float, info["goal"])))
            for info in venv.reset_infos
        ]
    return cases[:count]


def _first_seed(seed: int, *stream: int) -> int:
    """First seed of the lanes, which count up from it; far from the seeds of other streams."""
    return int(np.random.SeedSequence([seed, *stream]).generate_state(1)[0])


def play(act: Act, venv: Any, cases: Sequence[Case], seed: int = 0) -> list[Episode]:
    """Play every case once. The noise depends neither on the policy nor on the number of lanes.

    Args:
        act: the policy; it sees observations as the environments give them.
        venv: environments that take ``parameters`` and ``goal`` as reset options and report ``distance`` and
            ``diverged`` in their info, and perhaps ``tension`` and ``stopped``.
        cases: starts of the episodes.
        seed: seed of the noise.

    Returns:
        an episode for every case, in order.
    """
    episodes: list[Episode] = []
    for first in range(0, len(cases), venv.num_envs):
        chunk = list(cases[first : first + venv.num_envs])
        lanes = chunk + [chunk[-1]] * (venv.num_envs - len(chunk))
        venv.seed(_first_seed(seed, 1) + first)
        venv.set_options([{"parameters": dict(case.parameters), "goal": list(case.goal)} for case in lanes])
        episodes += _play_lanes(act, venv, len(chunk), first)
    return episodes


def _play_lanes(act: Act, venv: Any, count: int, first: int) -> list[Episode]:
    """One episode in each of the first ``count`` lanes."""
    distances: list[list[float]] = [[] for _ in range(count)]
    actions: list[list[np.ndarray]] = [[] for _ in range(count)]
    total, tension = np.zeros(count), np.full(count, np.nan)
    diverged, stopped, done = np.zeros((3, count), dtype=bool)
    seen = venv.reset()
    for _ in range(LONGEST):
        action = act(seen)
        seen, reward, ended, infos = venv.step(action)
        for lane in np.flatnonzero(~done):
            distances[lane].append(float(infos[lane]["distance"]))
            actions[lane].append(np.asarray(action[lane]))
            total[lane] += reward[lane]
            diverged[lane] |= bool(infos[lane].get("diverged", False))
            stopped[lane] |= bool(infos[lane].get("stopped", False))
            tension[lane] = np.fmax(tension[lane], infos[lane].get("tension", np.nan))
        done |= ended[:count]
        if done.all():
            return [
                Episode(
                    first + k,
                    np.array(distances[k]),
                    float(total[k]),
                    bool(diverged[k]),
                    np.array(actions[k]),
                    float(tension[k]),
                    bool(stopped[k]),
                )
                for k in range(count)
            ]
    raise InputError(f"an episode did not end within {LONGEST} actions", where="evaluation", remedy="give it a limit")


def success(episodes: Sequence[Episode], threshold: float) -> tuple[float, float, float]:
    """Share of the episodes that end within ``threshold`` [m], with the ends of its 95 % Wilson interval."""
    hits = int(np.sum([episode.distance <= threshold for episode in episodes]))
    interval = binomtest(hits, len(episodes)).proportion_ci(0.95, method="wilson")
    return hits / len(episodes), float(interval.low), float(interval.high)


def peak_tension(episodes: Sequence[Episode]) -> dict[str, float] | None:
    """Median and largest over episodes of their largest tension [N], and the number of episodes that the limit stopped;
    None without tensions. Episodes whose simulation failed do not count.
    """
    known = [each.tension for each in episodes if not each.diverged and np.isfinite(each.tension)]
    if not known:
        return None
    ended = sum(each.stopped for each in episodes)
    return {"median": float(np.median(known)), "largest": max(known), "stopped": ended}


def tension_sentence(pull: Mapping[str, float], limit: float | None) -> str:
    """Sentence about the result of `peak_tension`; ``limit`` on tension [N]."""
    words = f"Cables pull at most {pull['median']:.3g} N in half of the episodes, {pull['largest']:.3g} N in all"
    return f"{words}." if limit is None else f"{words}; the limit of {limit:g} N stopped {pull['stopped']:.0f} of them."


def without_end(stopped: float, failed: float) -> str:
    """Number of episodes without an end, and the reason, in words."""
    return f"{stopped:.0f} stopped by the limit on tension, {failed:.0f} failed"


def interquartile_mean(groups: Sequence[Sequence[Episode]], seed: int) -> tuple[float, float, float]:
    """Mean of the middle half of all final distances [m], with a 95 % bootstrap interval stratified by group.

    Args:
        groups: episodes of each training seed (Agarwal et al. 2021, "Deep RL at the edge of the statistical
            precipice").
        seed: seed of the bootstrap.

    Returns:
        the mean and the ends of its interval; the ends are NaN if a group has a single episode.
    """
    distances = [np.array([episode.distance for episode in group]) for group in groups]

    def middle(*parts: np.ndarray, axis: int = -1) -> np.ndarray:
        return trim_mean(np.concatenate(parts, axis=axis), 0.25, axis=axis)

    mean = float(middle(*distances))
    if not np.isfinite(mean):  # a quarter and more of the simulations failed
        return mean, mean, mean
    if min(map(len, distances)) < 2:
        return mean, float("nan"), float("nan")
    # Strata are resampled apart: each argument of `bootstrap` is one.
    with np.errstate(invalid="ignore"):  # resamples of which a quarter failed have no middle
        interval = bootstrap(
            distances,
            middle,
            n_resamples=2000,
            confidence_level=0.95,
            method="percentile",
            vectorized=True,
            rng=np.random.default_rng(seed),
        ).confidence_interval
    return mean, float(interval.low), float(interval.high)


def episode_table(policies: Mapping[str, Sequence[Episode]], cases: Sequence[Case]) -> pd.DataFrame:
    """A row for every policy and case: final and smallest distance [m], sum of rewards, largest tension [N],
    whether the limit on it ended the episode, goal and parameters."""
    rows = [
        {
            "policy": name,
            "case": episode.case,
            "distance": episode.distance,
            "smallest_distance": float(np.min(episode.distances)),
            "total_reward": episode.total,
            "diverged": episode.diverged,
            "peak_tension": episode.tension,
            "stopped": episode.stopped,
            **{f"goal_{axis}": value for axis, value in zip("xyz", cases[episode.case].goal, strict=False)},
            **dict(cases[episode.case].parameters),
        }
        for name, episodes in policies.items()
        for episode in episodes
    ]
    return pd.DataFrame(rows)


def median_episode(episodes: Sequence[Episode]) -> Episode:
    """The episode whose final distance is the (lower) median."""
    return sorted(episodes, key=lambda episode: episode.distance)[(len(episodes) - 1) // 2]
