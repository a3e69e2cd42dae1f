"""Cable tensions in episodes: those of rollouts, the limit that ends an episode, and what is said of them."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.policies.building import make_episodes
from rfdropo_bayes.policies.evaluation import Case, Episode, peak_tension, play, success, tension_sentence
from rfdropo_bayes.policies.gym_env import TrunkEnv
from rfdropo_bayes.policies.tasks import EPISODE, FLOOR, PERIOD
from rfdropo_bayes.policies.vec_env import TrunkVecEnv

REACH, CHANNELS = "TrunkReach-v0", 4
OPTIONS = {"actions": "continuous", "observed": "full", "robot": "smooth_arm"}
ACTIONS = np.random.default_rng(4).uniform(-0.2, 1.0, (8, CHANNELS)).astype(np.float32)
START = {"goal": [0.0, 0.0, 0.13]}


def played(actions, **options):
    """Tension, reward, whether it is over, and info after every action of an episode of the single environment."""
    env = TrunkEnv(REACH, **OPTIONS, **options)
    env.reset(seed=3, options=START)
    found = []
    for action in actions:
        _, reward, terminated, _, info = env.step(action)
        found.append((info["tension"], reward, terminated, info))
        if terminated:
            break
    return env, found


@pytest.fixture(scope="module")
def free():
    return played(ACTIONS)


def test_the_tension_of_an_action_is_the_largest_of_a_rollout_under_the_same_commands(free) -> None:
    env, found = free
    simulator, count = env.episodes.simulator, len(ACTIONS)
    again = TrunkEnv(REACH, **OPTIONS)
    again.reset(seed=3, options=START)
    commands = [again.step(action) and again.episodes.commands[0].copy() for action in ACTIONS]
    steps = round(PERIOD / simulator.time_step)
    every = simulator.time_step * np.arange(steps * count + 1)
    given = simulator.commands(PERIOD * np.arange(count), np.array(commands), np.zeros(CHANNELS), every)
    tension = np.asarray(simulator.rollout({}, given).tension)[1:].reshape(count, -1)
    assert [each[0] for each in found] == pytest.approx(tension.max(axis=1), rel=1e-9)
    assert tension.max() > 1.0


def test_a_tension_beyond_the_limit_ends_the_episode_in_all_kinds_of_environments(free) -> None:
    tensions, rewards = [each[0] for each in free[1]], [each[1] for each in free[1]]
    last = int(np.argmax(tensions))
    limit = max(tensions[:last]) + 1e-6  # below the peak: the first action beyond it is the peak's own
    assert last > 2
    _, found = played(ACTIONS, tension_limit=limit)
    assert [each[2] for each in found] == [False] * last + [True]
    assert [each[1] for each in found[:-1]] == rewards[:last]
    worst = min(FLOOR, *rewards[: last + 1])
    assert found[-1][1] == pytest.approx(worst * (EPISODE - last))
    assert found[-1][3]["stopped"]
    venv = TrunkVecEnv(make_episodes(REACH, 2, **OPTIONS, tension_limit=limit))
    venv.seed(3)
    venv.set_options(START)
    venv.reset()
    still = np.zeros_like(ACTIONS[0])
    for k, action in enumerate(ACTIONS[: last + 1]):
        both = np.stack([action, still])
        _, reward, done, infos = venv.step(both)
        assert done.tolist() == [k == last, False]
        assert reward[0] == np.float32(found[k][1])
        assert infos[0]["tension"] == found[k][0]
    assert not infos[0]["TimeLimit.truncated"]
    assert infos[0]["episode"]["l"] == last + 1
    assert [each["stopped"] for each in infos] == [True, False]


@pytest.mark.parametrize("away", [0.004, 0.05])
def test_a_stop_is_never_worth_more_than_holding_still(away) -> None:
    """An episode that begins at its goal and leaves it has rewards below the floor: the stop has them, too."""
    env = TrunkEnv(REACH, **OPTIONS)
    env.reset(seed=3)
    goal = (env.episodes.marker[0, -1] + np.array([away, 0.0, 0.0])).tolist()
    pull = np.zeros((6, CHANNELS), dtype=np.float32)
    pull[:, 0] = 1.0
    totals = {}
    for limit in (None, 1e-6):
        env = TrunkEnv(REACH, **OPTIONS)
        env.reset(seed=3, options={"goal": goal})
        rewards = [env.step(action)[1] for action in pull]
        env.episodes.settings = SimpleNamespace(**{**vars(env.episodes.settings), "tension_limit": limit})
        for _ in range(EPISODE - len(pull)):
            _, reward, ended, _, _ = env.step(pull[0] if limit else np.zeros(CHANNELS, dtype=np.float32))
            rewards.append(reward)
            if ended:
                break
        totals[limit] = rewards
    assert len(totals[None]) == EPISODE
    assert len(totals[1e-6]) == len(pull) + 1
    assert sum(totals[1e-6]) <= sum(totals[None])
    assert (min(totals[None]) < FLOOR) == (away < 0.01)


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, np.inf])
def test_a_limit_that_is_no_positive_number_is_refused(limit) -> None:
    with pytest.raises(InputError, match=r"tension_limit = .* give a positive number"):
        make_episodes(REACH, 1, **OPTIONS, tension_limit=limit)


def test_a_limit_below_the_tension_at_rest_is_refused_and_another_changes_nothing() -> None:
    """The arm pulls 1.6 N without an action."""
    told = {}
    for limit in (None, 1.7):
        lanes = make_episodes(REACH, 2, **OPTIONS, tension_limit=limit)
        for lane in range(2):
            lanes.seed(lane, lane)
        lanes.reset([0, 1])
        told[limit] = lanes.act(np.zeros((2, CHANNELS)))
    np.testing.assert_array_equal(told[1.7].observation, told[None].observation)
    np.testing.assert_array_equal(told[1.7].tension, told[None].tension)
    assert not told[1.7].stopped.any()
    least = re.escape(f"{told[None].tension.min():.3g}")
    with pytest.raises(InputError, match=f"cables of smooth_arm pull at least {least} N before any action, above"):
        make_episodes(REACH, 2, **OPTIONS, tension_limit=1.0).reset([0, 1])


@pytest.mark.parametrize("peak", [None, np.array([[1.0, np.nan, 1.0, 1.0]])])
def test_a_limit_where_no_tension_is_told_is_refused(monkeypatch, peak) -> None:
    lanes = make_episodes(REACH, 1, **OPTIONS, tension_limit=10.0)
    lanes.reset([0])
    act = lanes.session.act
    monkeypatch.setattr(lanes.session, "act", lambda commands: act(commands)._replace(peak=peak))
    with pytest.raises(InputError, match=r"smooth_arm gives no cable tensions .* Motion\.peak"):
        lanes.act(np.zeros((1, CHANNELS)))


def test_an_episode_that_the_limit_ends_fails_and_its_tension_is_counted(free) -> None:
    peak = max(each[0] for each in free[1])
    cases = [Case({}, tuple(START["goal"]))]
    found = {}
    for limit in (None, 0.5 * peak):
        lanes = TrunkVecEnv(make_episodes(REACH, 1, **OPTIONS, tension_limit=limit))
        order = iter([*ACTIONS, *np.zeros((EPISODE, CHANNELS))])
        found[limit] = play(lambda _, order=order: next(order)[None], lanes, cases)
    free_run, stopped = (episodes[0] for episodes in found.values())
    assert (free_run.stopped, stopped.stopped) == (False, True)
    assert free_run.tension == pytest.approx(peak)
    assert success([free_run], 1.0)[0] == 1.0
    assert success([stopped], 1.0)[0] == 0.0
    assert peak_tension([free_run, stopped])["stopped"] == 1


def episode(tension: float, *, diverged: bool = False, stopped: bool = False) -> Episode:
    return Episode(0, np.array([0.01]), 0.0, diverged, np.zeros(1), tension, stopped)


def test_peaks_are_those_of_episodes_whose_simulation_did_not_fail() -> None:
    episodes = [episode(1.0), episode(2.0), episode(6.0, stopped=True), episode(1e9, diverged=True)]
    pull = peak_tension(episodes)
    assert pull == {"median": 2.0, "largest": 6.0, "stopped": 1}
    assert "at most 2 N in half of the episodes, 6 N in all; the limit of 5 N stopped 1" in tension_sentence(pull, 5.0)
    assert peak_tension([episode(np.nan)]) is None
