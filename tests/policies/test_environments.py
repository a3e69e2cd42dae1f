"""The tasks as environments: checkers, rewards, resets of single lanes, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_sb3

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.policies.building import make_episodes
from rfdropo_bayes.policies.gym_env import TrunkEnv
from rfdropo_bayes.policies.randomisation import (
    Draws,
    Layers,
    Phi,
    Point,
    Uniform,
    fitting,
    read_phi,
    read_posterior,
    with_width,
)
from rfdropo_bayes.policies.tasks import (
    FLOOR,
    MOVING,
    TASKS,
    TRACKED_HEIGHTS,
    layout_of,
    observed_of,
    potential,
    reward,
)
from rfdropo_bayes.policies.vec_env import TrunkVecEnv
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Result

REACH = "TrunkReach-v0"
SPECS = (
    ParameterSpec("young_modulus", "Pa", 1e6, 5e7, 4.5e6, {}, ""),
    ParameterSpec("trunk_mass", "kg", 1e-4, 10.0, 0.42, {}, ""),
)


@pytest.fixture(scope="module")
def episodes():
    """Four lanes, randomised over two ranges."""
    ranges = {"young_modulus": (3e6, 6e6), "trunk_mass": (0.3, 0.5)}
    return make_episodes(REACH, 4, actions="continuous", observed="full", randomisation=Uniform(ranges))


@pytest.fixture
def robot_arm():
    """Options of an arm that moves fast in tests."""
    return {"robot": "smooth_arm"}


@pytest.fixture
def venv(episodes):
    found = TrunkVecEnv(episodes)
    found.seed(0)
    found.reset()
    return found


def test_reward_is_the_papers() -> None:
    """Facts of the authors' code: p(d) = -0.006 d^2 - 500 ln(d^2 + 1e-3), d in mm; (p(d0) - p(d)) / p(d0) - 0.05."""
    d0, d = 60.0, 12.5

    def p(x):
        return -0.006 * x**2 - 500.0 * np.log(x**2 + 1e-3)

    assert potential(np.array([0.0125]))[0] == pytest.approx(p(d))
    assert reward(np.array([0.0125]), np.array([0.06]))[0] == pytest.approx((p(d0) - p(d)) / p(d0) - 0.05)
    assert reward(np.array([0.06]), np.array([0.06]))[0] == pytest.approx(-0.05)


def test_movements_of_the_commands_cost_a_part_of_the_reward() -> None:
    """Commands that alternate cancel in ramps longer than the control period: the distance does not see them."""
    env = TrunkEnv(REACH, actions="continuous")
    env.reset(seed=0)
    first = env.episodes.first.copy()
    for action in (np.zeros(8), np.linspace(-1.0, 1.0, 8), np.ones(8)):
        _, gained, _, _, info = env.step(action.astype(np.float32))
        expected = reward(np.array([info["distance"]]), first)[0] - MOVING * np.mean(action**2)
        assert gained == pytest.approx(expected, rel=1e-6)


def test_observations_have_the_papers_size_and_goals_its_boxes() -> None:
    robot = Robot.load("trunk_sofa")
    assert layout_of(TASKS[REACH], robot, "discrete", "paper").size == 66
    assert layout_of(TASKS["TrunkPush-v0"], robot, "discrete", "paper").size == 73
    assert len(layout_of(TASKS[REACH], robot, "discrete", "paper").moves) == 16
    assert len(robot.markers_near(TRACKED_HEIGHTS)) == 4
    low, high = robot.command_limits()
    assert high == pytest.approx([0.07] * 4 + [0.04] * 4)
    assert low == pytest.approx(-high)


@pytest.mark.parametrize(
    ("actions", "observed"), [pytest.param("discrete", "paper", marks=pytest.mark.slow), ("continuous", "markers")]
)
def test_gymnasium_and_sb3_accept_the_environment(actions, observed) -> None:
    env = TrunkEnv(REACH, actions=actions, observed=observed, render_mode="rgb_array")
    check_env(env, skip_render_check=True)
    check_sb3(env, warn=False)
    frame = env.render()
    assert frame is not None
    assert frame.shape == (480, 640, 3)
    assert frame.std() > 10.0  # something is drawn


@pytest.mark.slow
def test_gymnasium_finds_the_tasks_in_a_fresh_process() -> None:
    """By the module that the name begins with, and by the bare name once that is imported."""
    code = f"""if True:
        import gymnasium
        print(gymnasium.make("rfdropo_bayes.policies:{REACH}").spec.name, gymnasium.spec("{REACH}").name)
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["TrunkReach", "TrunkReach"]


def test_gymnasium_makes_the_tasks_by_name() -> None:
    env = gymnasium.make(REACH, actions="continuous")
    seen, info = env.reset(seed=3, options={"goal": [0.0, -0.02, 0.13]})
    assert info["goal"] == [0.0, -0.02, 0.13]
    assert seen.shape == (66,)


@pytest.mark.slow
def test_an_episode_is_recorded_as_a_video(tmp_path) -> None:
    pytest.importorskip("moviepy", reason="an extra that RecordVideo needs")
    env = gymnasium.make(REACH, actions="continuous", render_mode="rgb_array", period=0.1)
    assert env.unwrapped.metadata["render_fps"] == 10
    filmed = gymnasium.wrappers.RecordVideo(env, str(tmp_path / "videos"))
    filmed.reset(seed=0)
    for _ in range(3):
        filmed.step(np.zeros(8, dtype=np.float32))
    filmed.close()
    assert next((tmp_path / "videos").glob("*.mp4")).stat().st_size > 5000


def test_episodes_without_a_seed_differ() -> None:
    goals = [make_episodes(REACH, 1) for _ in range(2)]
    for one in goals:
        one.reset([0])
    assert not np.array_equal(goals[0].goal, goals[1].goal)


@pytest.mark.parametrize("task", [REACH, pytest.param("TrunkPush-v0", marks=pytest.mark.slow)])
def test_what_a_marker_has_moved_is_the_difference_of_two_sightings(task) -> None:
    """Else a policy could take the noise of motion capture off again. A fresh episode has not moved."""
    noisy = make_episodes(task, 2, actions="continuous", observed="full", noise=0.002)
    for lane in range(2):
        noisy.seed(lane, lane)
    part = {}
    for piece in noisy.layout.observation:
        start = sum(p.size for p in noisy.layout.observation[: len(part)])
        part[piece.name] = slice(start, start + piece.size)
    first = noisy.reset([0, 1])
    assert np.all(first[:, part["moved"]] == 0.0)
    second = noisy.act(np.zeros((2, 8))).observation
    assert second[:, part["moved"]] == pytest.approx(second[:, part["markers"]] - first[:, part["markers"]], abs=1e-6)
    errors = second[:, part["markers"]] - noisy.marker.reshape(2, -1)
    assert errors.std() == pytest.approx(0.002, rel=0.25)  # 126 numbers: four deviations
    if task != REACH:
        pose = second[:, part["object"]] - noisy.pose
        assert 0.0 < np.abs(pose[:, :3]).max() < 0.008
        assert (
            0.0 < np.abs(pose[:, 3:]).max() < 0.25
        )  # 2 mm over half a side is 0.11 rad, half of which is in a quaternion
        assert np.linalg.norm(second[:, part["object"]][:, 3:], axis=1) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("width", [0.5, 2.0])
def test_a_wider_posterior_keeps_its_middle_and_its_correlations(width) -> None:
    rng = np.random.default_rng(0)
    one = rng.normal(0.0, 0.1, 500)
    rows = np.stack([4e6 * np.exp(one), 0.4 * np.exp(-one)], axis=1)
    draws = Draws(("young_modulus", "trunk_mass"), rows, "x")
    wide = with_width(Layers((Point({}), draws), "posterior"), width, SPECS).parts[1]
    logs, own = np.log(wide.rows), np.log(rows)
    np.testing.assert_allclose(logs.mean(axis=0), own.mean(axis=0))
    np.testing.assert_allclose(logs.std(axis=0), width * own.std(axis=0))
    np.testing.assert_allclose(np.corrcoef(logs.T), np.corrcoef(own.T))
    assert wide.sha256 != draws.sha256
    phi = with_width(Phi({"trunk_mass": {"mean": 0.4, "std": 0.1, "low": 0.1, "high": 0.7}}), width, SPECS)
    assert phi.normals["trunk_mass"] == {"mean": 0.4, "std": 0.1 * width, "low": 0.1, "high": 0.7}


def test_a_wider_posterior_ends_at_hard_bounds_and_a_point_has_no_width() -> None:
    draws = Draws(("trunk_mass",), np.array([[1e-3], [9.0]]), "x")
    assert np.array_equal(with_width(draws, 5.0, SPECS).rows, [[1e-4], [10.0]])
    with pytest.raises(InputError, match=r"width = 2 applies only to a posterior"):
        with_width(Point({}), 2.0, SPECS)


@pytest.mark.parametrize("robot", ["trunk_sofa", "trunk_physical", "asl_trunk"])
@pytest.mark.parametrize("observed", ["full", "paper", "markers"])
def test_a_layout_tells_what_is_observed_of_a_robot(robot, observed) -> None:
    """Of 21 markers, of the four that are tracked themselves, and of three, of which two stand for the four."""
    described = Robot.load(robot)
    layout = layout_of(TASKS[REACH], described, "continuous", observed)
    found = observed_of(layout, len(described.marker_names))
    assert layout_of(TASKS[REACH], described, "continuous", found) == layout


def test_rewards_stay_finite_for_episodes_that_begin_at_the_goal() -> None:
    """The potential is zero a millimetre from the goal: relative to it, rewards would be anything."""
    far = np.array([0.05])
    for first in (0.0, 0.0005, 0.001, 0.0010005):
        assert reward(far, np.array([first]))[0] == reward(far, np.array([0.005]))[0] < -1.0


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_an_action_moves_the_same_cable_whether_commands_are_lengths_or_angles(kind) -> None:
    """5 mm of cable, by hand: 0.5 rad of a spool of 10 mm."""
    answers = {"length": 0.2, "radius": 0.01, "markers": {"tip": 0.2}}
    turned = Robot.outline(name="turned", command_unit="rad", spool_radius=0.01, **answers)
    pulled = Robot.outline(name="pulled", **answers)
    for robot, most in ((turned, 0.5), (pulled, 0.005)):
        layout = layout_of(TASKS[REACH], robot, kind, "full")
        assert np.max(layout.moves) == most
        assert layout_of(TASKS[REACH], robot, kind, "full", step=np.max(layout.moves, axis=0).tolist()) == layout


@pytest.mark.parametrize("action", [-1, 16, 3.0])
def test_a_discrete_action_that_is_none_is_refused(action) -> None:
    layout = layout_of(TASKS[REACH], Robot.load("trunk_sofa"), "discrete", "paper")
    with pytest.raises(InputError, match="not an action"):
        layout.change(np.array([0, action]))


def test_one_lane_begins_again_while_the_others_go_on(venv, episodes) -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        seen, _, _, _ = venv.step(rng.uniform(-1, 1, (4, 8)))
    before, parameters = seen.copy(), [dict(p) for p in episodes.parameters]
    episodes.reset([2])
    after = episodes._observe(np.arange(4))
    kept = [0, 1, 3]
    assert np.array_equal(after[kept], before[kept])
    assert not np.array_equal(after[2], before[2])
    assert [episodes.parameters[k] == parameters[k] for k in range(4)] == [True, True, False, True]
    assert episodes.age.tolist() == [5, 5, 0, 5]


def test_a_lane_does_not_depend_on_the_others(venv, episodes) -> None:
    """The same lane with the same options and actions moves the same, whatever its neighbours do."""
    options = [{"parameters": {"young_modulus": 4e6}, "goal": [0.0, 0.0, 0.13]}] * 4
    rng = np.random.default_rng(1)
    own = rng.uniform(-1, 1, (10, 8))
    seen = []
    for turn in range(2):
        venv.set_options(options)
        venv.reset()
        others = np.random.default_rng(turn + 5)
        for action in own:
            actions = others.uniform(-1, 1, (4, 8))
            actions[1] = action
            found = venv.step(actions)[0]
        seen.append(found[1])
    assert np.array_equal(*seen)


def test_an_episode_ends_after_a_hundred_actions_by_time_limit(venv) -> None:
    for k in range(100):
        before = venv.episodes.marker.copy()
        _, _, done, infos = venv.step(np.zeros((4, 8)))
        assert done.all() == (k == 99)
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert infos[0]["episode"]["l"] == 100
    assert infos[0]["terminal_observation"][:3] == pytest.approx(before[0, 0], abs=1e-3)


def test_same_seed_same_episodes(episodes) -> None:
    runs = []
    for _ in range(2):
        venv = TrunkVecEnv(episodes)
        venv.seed(7)
        venv.reset()
        seen = [venv.step(np.full((4, 8), 0.3))[0] for _ in range(3)]
        runs.append((venv.reset_infos, np.array(seen)))
    assert runs[0][0] == runs[1][0]
    assert np.array_equal(runs[0][1], runs[1][1])


def test_the_log_replays_an_episode(episodes, tmp_path) -> None:
    venv = TrunkVecEnv(episodes, log=tmp_path / "episodes.jsonl")
    venv.seed(11)
    venv.reset()
    for _ in range(100):
        _, _, _, infos = venv.step(np.full((4, 8), 0.2))
    lines = [json.loads(line) for line in (tmp_path / "episodes.jsonl").read_text().splitlines()]
    assert [line["lane"] for line in lines] == [0, 1, 2, 3]
    again = TrunkVecEnv(episodes)
    again.set_options([{name: line[name] for name in ("parameters", "goal")} for line in lines])
    again.reset()
    for _ in range(100):
        infos = again.step(np.full((4, 8), 0.2))[3]
    assert [info["distance"] for info in infos] == [line["distance"] for line in lines]


def failing(episodes, rows, code):
    """Let the session report a failure in some lanes after the next actions."""
    act = episodes.session.act

    def broken(commands):
        found = act(commands)
        status, position = np.array(found.status), np.array(found.position)
        status[rows], position[rows] = int(code), np.nan
        return found._replace(status=status, position=position)

    return broken


def test_a_diverged_lane_ends_with_the_floor_reward_and_is_drawn_anew(venv, episodes, monkeypatch) -> None:
    venv.step(np.zeros((4, 8)))
    monkeypatch.setattr(episodes.session, "act", failing(episodes, [1], Result.DIVERGED))
    first = dict(venv.reset_infos[1]["parameters"])
    seen, gained, done, infos = venv.step(np.zeros((4, 8)))
    assert done.tolist() == [False, True, False, False]
    assert gained[1] == pytest.approx(FLOOR * 99)
    assert infos[1]["diverged"]
    assert not infos[1]["TimeLimit.truncated"]
    assert np.isfinite(seen).all()
    assert np.isfinite(infos[1]["terminal_observation"]).all()
    assert venv.reset_infos[1]["parameters"] != first


def test_a_lane_without_an_initial_state_is_drawn_anew_a_bounded_number_of_times(episodes, monkeypatch) -> None:
    reset, calls = episodes.session.reset, []

    def sometimes(rows, parameters, **rest):
        calls.append(len(rows))
        found = reset(rows, parameters, **rest)
        status = np.array(found.status)
        status[: len(calls) < 3] = int(Result.NOT_IN_EQUILIBRIUM)
        return found._replace(status=status)

    monkeypatch.setattr(episodes.session, "reset", sometimes)
    before = episodes.redrawn
    episodes.reset([0, 1, 2, 3])
    assert calls == [4, 1, 1]
    assert episodes.redrawn == before + 2

    def never(rows, parameters, **rest):
        found = reset(rows, parameters, **rest)
        return found._replace(status=np.full(len(rows), int(Result.NOT_IN_EQUILIBRIUM)))

    monkeypatch.setattr(episodes.session, "reset", never)
    with pytest.raises(InputError, match=r"no initial state for .*young_modulus"):
        episodes.reset([0])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gaol": [0, 0, 0]}, "unknown option 'gaol'"),
        ({"goal": [0, float("nan"), 0]}, "three finite numbers"),
        ({"parameters": {"young_moduls": 1.0}}, "unknown parameter 'young_moduls'"),
        ({"parameters": {"young_modulus": -1.0}}, "outside its hard bounds"),
    ],
)
def test_options_that_cannot_be_are_refused(episodes, options, words) -> None:
    with pytest.raises(InputError, match=words):
        episodes.reset([0], [options])


def test_actions_that_are_no_numbers_are_refused(venv) -> None:
    actions = np.zeros((4, 8))
    actions[2, 3] = np.nan
    with pytest.raises(InputError, match="not finite"):
        venv.step(actions)


def posterior(path, modulus):
    """A saved posterior in which the mass follows the modulus."""
    infos = (
        ParameterInfo("young_modulus", "Pa", 1e6, 5e7),
        ParameterInfo("trunk_mass", "kg", 1e-4, 10.0),
        ParameterInfo("observation_noise", "m"),
    )
    modulus = np.asarray(modulus, dtype=float)
    draws = {"young_modulus": modulus, "trunk_mass": modulus * 1e-7, "observation_noise": np.full_like(modulus, 1e-3)}
    PosteriorRecord(infos, draws).save(path / "posterior.nc")


def test_whole_rows_are_drawn_from_a_posterior(tmp_path) -> None:
    posterior(tmp_path, np.linspace(3e6, 6e6, 50)[None])
    draws = read_posterior(tmp_path, SPECS)
    assert draws.names == ("young_modulus", "trunk_mass")
    rng = np.random.default_rng(0)
    for _ in range(20):
        row = fitting(draws, SPECS).draw(rng)
        assert row["trunk_mass"] == pytest.approx(1e-7 * row["young_modulus"])


def test_a_posterior_whose_mechanism_the_simulator_lacks_is_refused(tmp_path) -> None:
    """Not trained without a word on what is left of it."""
    names = ("young_modulus", "command_delay")
    infos = (ParameterInfo(names[0], "Pa", 1e6, 5e7), ParameterInfo(names[1], "s", 0.0, 1.0))
    PosteriorRecord(infos, dict.fromkeys(names, np.full((1, 4), 4e6))).save(tmp_path / "posterior.nc")
    with pytest.raises(InputError, match=r"command_delay, of the mechanism 'command_delay'.*add .command_delay."):
        read_posterior(tmp_path, SPECS)


def test_a_phi_of_another_simulator_is_refused(tmp_path) -> None:
    normal = {"mean": 1.0, "std": 1.0, "low": 0.0, "high": 2.0}
    (tmp_path / "summary.json").write_text(json.dumps({"method": "rfdropo", "phi": {"stiffness": normal}}))
    with pytest.raises(InputError, match="shares no parameter"):
        read_phi(tmp_path, SPECS)


def test_impossible_draws_are_counted_and_refused(tmp_path) -> None:
    posterior(tmp_path, np.array([[3e6, 5e5, -4e6, 4e6]]))
    draws = read_posterior(tmp_path, SPECS)
    with pytest.raises(InputError, match="2 of 4 draws of young_modulus"):
        fitting(draws, SPECS)


def test_phi_keeps_its_truncation_and_moments() -> None:
    phi = Phi({"young_modulus": {"mean": 4e6, "std": 1e6, "low": 2e6, "high": 6e6}})
    rng = np.random.default_rng(0)
    values = np.array([phi.draw(rng)["young_modulus"] for _ in range(4000)])
    assert values.min() >= 2e6
    assert values.max() <= 6e6
    assert values.mean() == pytest.approx(4e6, abs=4 * 0.88e6 / np.sqrt(4000))  # four standard errors
    assert values.std() == pytest.approx(0.88e6, rel=0.06)  # of a normal cut at two deviations


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        (Uniform({"young_modulus": (1e5, 4e6)}), "outside its hard bounds"),
        (Point({"trunk_mas": 0.4}), "did you mean 'trunk_mass'"),
        (Phi({"trunk_mass": {"mean": 1.0, "std": 1.0, "low": -1.0, "high": 3.0}}), "outside its hard bounds"),
    ],
)
def test_randomisations_that_do_not_fit_are_refused(chosen, words) -> None:
    with pytest.raises(InputError, match=words):
        fitting(chosen, SPECS)


def test_digests_tell_randomisations_apart() -> None:
    one = Draws(("a",), np.ones((2, 1)), "x")
    assert Point({"a": 1.0}).sha256 != Point({"a": 2.0}).sha256
    assert Uniform({"a": (1.0, 2.0)}).sha256 == Uniform({"a": (1.0, 2.0)}).sha256
    assert replace(one, sha256="y").sha256 == "y"


def test_unknown_tasks_and_settings_are_refused() -> None:
    with pytest.raises(InputError, match="unknown task"):
        make_episodes("TrunkJump-v0", 1)
    with pytest.raises(InputError, match="unknown setting 'acton'"):
        make_episodes(REACH, 1, acton="discrete")
