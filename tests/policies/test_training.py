"""Training, resume, evaluation and export, on points whose best policy is known."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.policies import onnx_export as export
from rfdropo_bayes.policies import training as run
from rfdropo_bayes.policies.evaluation import (
    Case,
    Episode,
    draw_cases,
    episode_table,
    interquartile_mean,
    median_episode,
    play,
    success,
)
from rfdropo_bayes.policies.onnx_export import ExportedPolicy, export_policy, latency
from rfdropo_bayes.policies.ppo import ppo_options
from rfdropo_bayes.policies.training import train
from rfdropo_bayes.policies.training_config import TrainingTable
from tests.policies.toys import STEP, Points, layout

SEED = 3
OPTIONS = {"n_steps": 20, "batch_size": 160, "n_epochs": 5, "learning_rate": 3e-3, "net_arch": [32]}
TABLE = TrainingTable(
    options=OPTIONS, steps=6400, environments=16, evaluate_every=3200, evaluation_episodes=20, actions="continuous"
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    return out, train(Points, TABLE, out, seed=3, gamma=0.9)


def to_the_goal(seen: np.ndarray) -> np.ndarray:
    """The best policy: straight to the goal."""
    return np.clip((seen[:, 1:] - seen[:, :1]) / STEP, -1.0, 1.0)


def test_the_policy_gets_better_and_the_log_says_so(trained) -> None:
    out, policy = trained
    rows = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    assert [row["steps"] for row in rows] == [3200, 6400]
    idle = play(lambda seen: np.zeros((len(seen), 1)), Points(16), draw_cases(Points(16), 50, 5))
    found = play(policy.act, Points(16), draw_cases(Points(16), 50, 5))
    assert np.median([e.distance for e in found]) < 0.3 * np.median([e.distance for e in idle])


class OneGoal(Points):
    """Points whose goal never varies."""

    def _start(self, lane, options):
        return super()._start(lane, {"goal": [0.5], **options})


def test_an_observation_that_never_varied_is_not_blown_up(tmp_path) -> None:
    """Another millimetre of it on the robot must not be an input that no training has seen."""
    found = train(OneGoal, TABLE.model_copy(update={"steps": 3200}), tmp_path, seed=3, gamma=0.9)
    seen = np.array([[0.2, 0.5], [0.2, 0.501]], dtype=np.float32)
    one, other = found.normalisation.normalize_obs(seen)
    assert abs(other[1] - one[1]) <= 0.11
    assert np.abs(found.act(seen)[1] - found.act(seen)[0]).max() < 0.1


def test_same_seed_same_curve_and_another_seed_another(trained, tmp_path) -> None:
    _, policy = trained
    half = TABLE.model_copy(update={"steps": 3200})
    again, other = (train(Points, half, tmp_path / str(seed), seed=seed, gamma=0.9) for seed in (3, 4))

    def first(run):
        return {k: v for k, v in run.curve[0].items() if k != "seconds"}

    assert first(again) == first(policy) != first(other)


@pytest.mark.parametrize(("best", "interrupted"), [(0, False), (2, False), (0, True), (3, True)])
def test_the_policy_is_that_of_the_best_evaluation(tmp_path, monkeypatch, interrupted, best) -> None:
    """Of four evaluations whose rewards are given: which of them a training learns best in is not what is tested."""
    weights, means, evaluate = [], [], run.play

    def judged(act, *rest) -> list[Episode]:
        model, normalisation = act.__self__.model, act.__self__.normalisation
        reward = 0.0 if len(weights) == best else -1.0
        weights.append([parameter.detach().numpy().copy() for parameter in model.policy.parameters()])
        means.append(normalisation.obs_rms.mean.copy())
        return [replace(episode, total=reward) for episode in evaluate(act, *rest)]

    monkeypatch.setattr(run, "play", judged)
    table = TABLE.model_copy(update={"steps": 1280, "evaluate_every": 320})
    if interrupted:
        train(Points, table.model_copy(update={"steps": 960}), tmp_path, seed=SEED, gamma=0.9)
    found = train(Points, table, tmp_path, seed=SEED, gamma=0.9, resume=interrupted)
    assert [row["reward"] for row in found.curve] == [0.0 if leg == best else -1.0 for leg in range(4)]
    assert found.best is found.curve[best]
    for mine, evaluated in zip(found.model.policy.parameters(), weights[best], strict=True):
        assert np.array_equal(mine.detach().numpy(), evaluated)
    assert np.array_equal(found.normalisation.obs_rms.mean, means[best])
    assert not np.array_equal(weights[best][0], weights[best - 1][0])


def test_a_run_that_was_killed_goes_on_as_if_it_had_not_been(trained, tmp_path) -> None:
    _, policy = trained
    train(Points, TABLE.model_copy(update={"steps": 3200}), tmp_path, seed=3, gamma=0.9)
    resumed = train(Points, TABLE, tmp_path, seed=3, gamma=0.9, resume=True)
    for mine, theirs in zip(resumed.model.policy.parameters(), policy.model.policy.parameters(), strict=True):
        assert np.array_equal(mine.detach().numpy(), theirs.detach().numpy())


LEG = 640


class Killed(Points):
    """Points whose process ends in the third of four legs."""

    steps = 0

    def step_wait(self):
        self.steps += 1
        if self.steps == 2 * (LEG // 16 + 20) + 15:
            raise KeyboardInterrupt
        return super().step_wait()


class Logged(Points):
    """Points that write a line for each episode, as the tasks do."""

    log: Path | None = None

    def step_wait(self):
        found = super().step_wait()
        if self.log is not None:
            with self.log.open("a") as file:
                file.writelines(json.dumps({"position": p}) + "\n" for p in self.position[found[2]])
        return found


class LoggedAndKilled(Killed, Logged):
    """Both."""


@pytest.mark.slow
def test_a_kill_in_the_middle_of_a_leg_changes_nothing(tmp_path) -> None:
    """Neither the curve nor the log of episodes, which holds each one once."""
    table = TABLE.model_copy(update={"steps": 4 * LEG, "evaluate_every": LEG})
    whole = train(Logged, table, tmp_path / "whole", seed=3, gamma=0.9)
    with pytest.raises(KeyboardInterrupt):
        train(LoggedAndKilled, table, tmp_path / "killed", seed=3, gamma=0.9)
    resumed = train(Logged, table, tmp_path / "killed", seed=3, gamma=0.9, resume=True)
    assert [row["reward"] for row in resumed.curve] == [row["reward"] for row in whole.curve]
    logs = [(tmp_path / name / "episodes.jsonl").read_text() for name in ("whole", "killed")]
    assert logs[0] == logs[1]
    assert len(logs[0].splitlines()) == 4 * LEG // 20


def test_tensorboard_has_the_losses_and_the_evaluations(trained) -> None:
    event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    out, policy = trained
    tags: dict[str, list] = {}
    for path in (out / "tensorboard").rglob("events*"):
        read = event_accumulator.EventAccumulator(str(path))
        read.Reload()
        for tag in read.Tags()["scalars"]:
            tags.setdefault(tag, []).extend(event.value for event in read.Scalars(tag))
    assert {"train/value_loss", "evaluation/reward"} <= set(tags)
    assert sorted(tags["evaluation/reward"]) == pytest.approx(sorted(row["reward"] for row in policy.curve), rel=1e-5)


def test_a_kill_between_two_renames_loses_nothing(trained, tmp_path) -> None:
    source, _ = trained
    shutil.copytree(source / "checkpoints", tmp_path / "checkpoints.old")
    assert train(Points, TABLE, tmp_path, seed=3, gamma=0.9, resume=True).curve[-1]["steps"] == 6400


@pytest.mark.parametrize("lost", ["logged", "best_model.zip", "normalisation.pkl"])
def test_a_damaged_checkpoint_is_refused(trained, tmp_path, lost) -> None:
    folder = tmp_path / "checkpoints"
    shutil.copytree(trained[0] / "checkpoints", folder)
    state = json.loads((folder / "state.json").read_text())
    (folder / "state.json").write_text(json.dumps({key: value for key, value in state.items() if key != lost}))
    (folder / lost).unlink(missing_ok=True)
    with pytest.raises(InputError, match=f"lacks {lost}: .*damaged; start anew"):
        train(Points, TABLE, tmp_path, seed=3, gamma=0.9, resume=True)


@pytest.mark.parametrize(("change", "seed", "words"), [({"environments": 8}, 3, "environments"), ({}, 4, "seed")])
def test_a_checkpoint_of_other_settings_is_refused(trained, tmp_path, change, seed, words) -> None:
    source, _ = trained
    shutil.copytree(source / "checkpoints", tmp_path / "checkpoints")
    with pytest.raises(InputError, match=f"other settings: .*{words}"):
        train(Points, TABLE.model_copy(update=change), tmp_path, seed=seed, gamma=0.9, resume=True)


class KilledEarly(Points):
    """Points whose process ends before the first checkpoint."""

    steps = 0

    def step_wait(self):
        self.steps += 1
        if self.steps == 50:
            raise KeyboardInterrupt
        return super().step_wait()


@pytest.mark.slow
def test_a_run_that_was_killed_before_its_first_checkpoint_goes_on_from_its_start(trained, tmp_path) -> None:
    with pytest.raises(KeyboardInterrupt):
        train(KilledEarly, TABLE, tmp_path, seed=3, gamma=0.9)
    assert not (tmp_path / "checkpoints").exists()
    resumed = train(Points, TABLE, tmp_path, seed=3, gamma=0.9, resume=True)
    assert [row["reward"] for row in resumed.curve] == [row["reward"] for row in trained[1].curve]


def test_a_checkpoint_that_cannot_be_read_is_refused(tmp_path) -> None:
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(InputError, match=r"no readable state\.json; start anew"):
        train(Points, TABLE, tmp_path, seed=3, gamma=0.9, resume=True)


@pytest.mark.parametrize(("kind", "options"), [("continuous", OPTIONS), ("discrete", OPTIONS | {"activation": "elu"})])
def test_an_exported_policy_acts_as_the_trained_one(tmp_path, kind, options) -> None:
    table = TrainingTable(options=options, steps=640, environments=16, evaluate_every=640, evaluation_episodes=4)
    policy = train(partial(Points, kind=kind), table, tmp_path, seed=1, gamma=0.9)
    path = export_policy(policy.model, policy.normalisation, layout(kind), tmp_path / "policy.onnx", {"seed": "1"})
    exported = ExportedPolicy(path)
    assert exported.layout == layout(kind)
    assert exported.facts == {"seed": "1"}
    seen = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2)).astype(np.float32)
    assert exported.act(seen) == pytest.approx(policy.act(seen), abs=2e-6)
    assert exported.change(seen) == pytest.approx(layout(kind).change(policy.act(seen)), abs=2e-7)


def test_the_time_of_a_decision_is_that_of_the_clock(trained, tmp_path, monkeypatch) -> None:
    """On a clock by which decision k takes k ms: of 1 to 100 ms the median is 50.5 and the quantile 99.01."""
    _, policy = trained
    path = export_policy(policy.model, policy.normalisation, layout("continuous"), tmp_path / "policy.onnx", {})
    ticks = iter(np.cumsum([0.001 * (call // 2) if call % 2 else 5.0 for call in range(2, 202)]))
    monkeypatch.setattr(export.time, "perf_counter", lambda: next(ticks))
    times = latency(ExportedPolicy(path), calls=100)
    assert times == pytest.approx({"median_s": 0.0505, "p99_s": 0.09901})


@pytest.mark.parametrize("content", [b"", b"not a model"])
def test_a_file_that_is_no_policy_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "policy.onnx"
    with pytest.raises(InputError, match="no such policy; name a policy"):
        ExportedPolicy(path)
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot read the policy"):
        ExportedPolicy(path)


def test_cases_are_the_same_for_all_policies_and_episodes_follow_them() -> None:
    venv = Points(7)
    cases = draw_cases(venv, 20, seed=9)
    assert cases == draw_cases(Points(7), 20, seed=9) != draw_cases(venv, 20, seed=10)
    episodes = play(to_the_goal, venv, cases)
    assert [episode.case for episode in episodes] == list(range(20))
    assert max(episode.distance for episode in episodes) < 0.1  # gains off by 20 % overshoot by less than a step
    idle = play(lambda seen: np.zeros((len(seen), 1)), venv, cases)
    assert [e.distance for e in idle] == pytest.approx([abs(case.goal[0]) for case in cases])


def test_cases_of_two_seeds_have_nothing_in_common() -> None:
    one, other = (draw_cases(Points(7), 40, seed=seed) for seed in (0, 1))
    assert not {case.goal for case in one} & {case.goal for case in other}


class Shaking(Points):
    """Points that are seen with noise from the generators of their lanes."""

    def _seen(self):
        return super()._seen() + 0.1 * np.array([[g.normal(), 0.0] for g in self.generators], dtype=np.float32)


def test_noise_is_the_same_for_all_policies_however_many_play_at_once() -> None:
    cases = draw_cases(Shaking(5), 12, seed=2)
    found = [[e.distance for e in play(to_the_goal, Shaking(lanes), cases, 4)] for lanes in (5, 12, 1)]
    assert found[0] == pytest.approx(found[1])
    assert found[0] == pytest.approx(found[2])
    assert found[0] != pytest.approx([e.distance for e in play(to_the_goal, Shaking(5), cases, 5)])


def test_a_failed_simulation_is_a_failure_at_every_distance() -> None:
    episodes = play(to_the_goal, Points(2), [Case({"gain": 3.0}, (0.0,)), Case({"gain": 1.0}, (0.0,))])
    assert [e.diverged for e in episodes] == [True, False]
    assert success(episodes, 1e9)[0] == 0.5


def episodes_with(distances) -> list[Episode]:
    return [Episode(k, np.array([d]), 0.0, False, np.zeros(1)) for k, d in enumerate(distances)]


def test_quantiles_are_finite_up_to_the_first_episode_without_an_end() -> None:
    """Of 41 episodes, the quantile of 95 % is the 39th, and has no weight on the 40th."""
    ends = [*np.full(38, 0.01), 0.02, np.inf, np.inf]
    episodes = [Episode(0, np.array([min(end, 1.0)]), 0.0, np.isinf(end), np.zeros(1)) for end in ends]
    row = run._summary(episodes)
    assert [row[f"distance_{name}"] for name in ("q05", "median", "q95")] == [0.01, 0.01, 0.02]
    assert run._summary([*episodes, episodes[-1]])["distance_q95"] == np.inf
    assert run._summary(episodes[-2:])["distance_q05"] == np.inf


def test_success_has_wilsons_interval() -> None:
    share, low, high = success(episodes_with([0.01] * 8 + [0.03] * 2), 0.02)
    # Wilson (1927) for 8 of 10 at 95 %: (p + z^2/2n -+ z sqrt(p q / n + z^2/4n^2)) / (1 + z^2/n)
    z, n, p = 1.959964, 10, 0.8
    half = z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2)) / (1 + z**2 / n)
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    assert (share, low, high) == pytest.approx((0.8, middle - half, middle + half), abs=1e-6)
    assert low != pytest.approx(binomtest(8, 10).proportion_ci(method="exact").low)


def test_the_interquartile_mean_ignores_the_outer_halves_and_its_interval_holds_it() -> None:
    rng = np.random.default_rng(2)
    groups = [episodes_with(np.concatenate([rng.normal(0.02, 0.001, 60), [9.0] * 5])) for _ in range(3)]
    found, low, high = interquartile_mean(groups, seed=0)
    assert found == pytest.approx(0.02, abs=5e-4)
    assert low < found < high < 0.021


def test_the_mean_of_one_episode_has_no_interval() -> None:
    assert interquartile_mean([episodes_with([0.01])], seed=0) == pytest.approx((0.01, np.nan, np.nan), nan_ok=True)


def test_failures_of_a_quarter_leave_no_interquartile_mean() -> None:
    found = interquartile_mean([episodes_with([0.01] * 14 + [np.inf] * 6)], seed=0)
    assert found == (np.inf, np.inf, np.inf)
    found, low, high = interquartile_mean([episodes_with([0.01] * 80 + [np.inf] * 20)], seed=0)
    assert found == low == pytest.approx(0.01)
    assert not np.isfinite(high)  # of many resamples a quarter failed


def test_the_table_has_a_row_for_every_policy_and_case() -> None:
    cases = draw_cases(Points(5), 5, seed=1)
    episodes = play(to_the_goal, Points(5), cases)
    table = episode_table({"a": episodes, "b": episodes}, cases)
    assert len(table) == 10
    assert set(table.columns) >= {"policy", "case", "distance", "goal_x", "gain", "diverged"}
    assert median_episode(episodes).distance == np.sort([e.distance for e in episodes])[2]


def test_options_are_checked_by_name() -> None:
    assert ppo_options("discrete", 0.95, {"gamma": 0.9})["gamma"] == 0.9
    for wrong, words in (
        ({"learning_rat": 1.0}, "did you mean 'learning_rate'"),
        ({"activation": "rulu"}, "unknown activation"),
        ({"rollout_buffer_class": "mine"}, "is an object of Python"),
    ):
        with pytest.raises(InputError, match=words):
            ppo_options("continuous", 0.95, wrong)
