"""A critic that sees parameters: it learns from them, and the policy never does."""

from __future__ import annotations

from functools import partial

import numpy as np
import onnx
import pytest
import stable_baselines3
import torch
from stable_baselines3.common.vec_env import VecNormalize

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.policies.algorithms import ALGORITHMS, algorithm_options, check_critic
from rfdropo_bayes.policies.building import make_episodes
from rfdropo_bayes.policies.critic import AsymmetricPolicy, ParametersBeside, varied_parameters
from rfdropo_bayes.policies.onnx_export import ExportedPolicy, export_policy
from rfdropo_bayes.policies.parity import check_exportable
from rfdropo_bayes.policies.randomisation import Draws, Layers, Point, Uniform
from rfdropo_bayes.policies.training import Trained, train
from rfdropo_bayes.policies.training_config import TrainingTable
from rfdropo_bayes.policies.vec_env import TrunkVecEnv
from tests.policies.toys import Points, layout

OPTIONS = {"n_steps": 20, "batch_size": 160, "n_epochs": 5, "learning_rate": 3e-3, "net_arch": [32]}
TABLE = TrainingTable(
    options=OPTIONS, steps=6400, environments=16, evaluate_every=3200, evaluation_episodes=8, critic="parameters"
)
ROOT_OF_12 = np.sqrt(12.0)


def untrained(algorithm: str, given: dict, kind: str = "continuous", normalise: bool = True) -> Trained:
    venv = Points(4, kind)
    normalisation = VecNormalize(venv, epsilon=1e-4) if normalise else None
    around = ParametersBeside(normalisation or venv)
    options = algorithm_options(algorithm, kind, 0.9, given, 4)
    options["policy_kwargs"]["unseen"] = 1
    model = getattr(stable_baselines3, algorithm)(AsymmetricPolicy, around, seed=0, device="cpu", **options)
    return Trained(model, normalisation, [], 0, 0.0)


def test_observations_end_with_the_parameters_of_their_own_episode() -> None:
    """In deviations of a uniform range: its width over the root of 12. A last observation has those it ended under."""
    venv = ParametersBeside(Points(3))
    seen = venv.reset()
    assert seen.shape == (3, 3)
    assert venv.observation_space.shape == (3,)
    gains = []
    for action in range(21):
        now = np.array([info["parameters"]["gain"] for info in venv.unwrapped.reset_infos])
        gains.append(now)
        assert seen[:, 2] == pytest.approx(ROOT_OF_12 * (now - 1.0) / 0.4, abs=0.15)
        seen, _, done, infos = venv.step(np.zeros((3, 1), dtype=np.float32))
        assert done.all() == (action == 19)
        if action == 19:
            last = np.array([info["terminal_observation"] for info in infos])
            assert last[:, 2] == pytest.approx(ROOT_OF_12 * (now - 1.0) / 0.4, abs=0.15)
    assert np.abs(gains[-1] - gains[0]).max() > 0.01


def test_only_what_varies_is_seen_in_the_order_of_the_randomisation() -> None:
    draws = Draws(("b", "fixed", "a"), np.random.default_rng(0).normal([5.0, 1.0, 1e6], [1.0, 0.0, 2e5], (400, 3)), "")
    found = varied_parameters(Layers((Point({"held": 2.0}), draws, Uniform({"start": (0.0, 1.0)})), "posterior"))
    assert found.names == ("b", "a", "start")
    assert found.mean == pytest.approx([5.0, 1e6, 0.5], rel=0.1)
    assert found.deviation == pytest.approx([1.0, 2e5, 1.0 / ROOT_OF_12], rel=0.15)
    again = varied_parameters(Layers((draws, Uniform({"start": (0.0, 1.0)})), "posterior"))
    assert np.array_equal(again.mean, found.mean)


def test_a_critic_that_has_nothing_to_see_is_refused() -> None:
    with pytest.raises(InputError, match="no parameter differs between episodes"):
        varied_parameters(Point({"a": 1.0}))


@pytest.mark.parametrize("name", ALGORITHMS)
def test_algorithms_whose_critic_sees_the_observation_alone_say_so(tmp_path, name) -> None:
    check_critic(name, "observation")
    if name in ("PPO", "A2C"):
        return check_critic(name, "parameters")
    kind = "discrete" if name == "DQN" else "continuous"
    with pytest.raises(InputError, match=f'critic of {name} cannot see .*use algorithm = "PPO" or "A2C"'):
        train(
            partial(Points, kind=kind),
            TABLE.model_copy(update={"algorithm": name, "options": {}}),
            tmp_path,
            seed=1,
            gamma=0.9,
        )
    return None


@pytest.mark.parametrize("normalise", [True, False])
@pytest.mark.parametrize(
    ("algorithm", "options", "kind"),
    [
        ("PPO", {}, "continuous"),
        ("PPO", {"net_arch": []}, "continuous"),
        ("PPO", {"net_arch": {"pi": [8], "vf": [16, 16]}, "activation": "elu"}, "discrete"),
        ("PPO", {"use_sde": True, "policy_kwargs": {"squash_output": True}}, "continuous"),
        ("PPO", {"policy_kwargs": {"share_features_extractor": False}}, "continuous"),
        ("A2C", {}, "discrete"),
    ],
)
def test_an_export_is_the_actor_on_the_ordinary_observation(tmp_path, algorithm, options, kind, normalise) -> None:
    """No parameter is among its inputs, and it acts as the model with weights so large that limits are met."""
    policy = untrained(algorithm, options, kind, normalise)
    check_exportable(policy.model, policy.normalisation, policy.act, layout(kind))
    with torch.no_grad():
        for parameter in policy.model.policy.parameters():
            parameter.mul_(5.0)
    path = export_policy(policy.model, policy.normalisation, layout(kind), tmp_path / "policy.onnx", {})
    (entry,) = onnx.load(path).graph.input
    assert [size.dim_value or size.dim_param for size in entry.type.tensor_type.shape.dim] == ["batch", 2]
    seen = np.random.default_rng(0).uniform(-2.0, 2.0, (300, 2)).astype(np.float32)
    assert ExportedPolicy(path).act(seen) == pytest.approx(policy.act(seen), abs=1e-4)


def test_the_actor_does_not_see_parameters_and_the_critic_does() -> None:
    model = untrained("PPO", {}).model
    seen = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    other = seen.copy()
    other[:, 2] += 3.0
    with torch.no_grad():
        one, two = (model.policy.predict_values(torch.as_tensor(rows)) for rows in (seen, other))
        distributions = [model.policy.get_distribution(torch.as_tensor(rows)).mode() for rows in (seen, other)]
    assert torch.equal(*distributions)
    assert np.array_equal(
        model.predict(seen, deterministic=True)[0], model.predict(other[:, :2], deterministic=True)[0]
    )
    assert (one - two).abs().median() > 0.1


class Paid(Points):
    """Points whose reward is the deviation of their gain, whatever they do."""

    def step_wait(self):
        gain = self.gain.copy()
        seen, _, done, infos = super().step_wait()
        return seen, (gain - 1.0) / 0.2, done, infos


@pytest.mark.parametrize(("critic", "low", "high"), [("parameters", 0.9, 1.0), ("observation", -0.2, 0.2)])
def test_a_critic_that_sees_the_gain_knows_what_an_episode_is_worth(tmp_path, critic, low, high) -> None:
    """The value of a first observation is a multiple of the gain's deviation. Of 512 episodes a critic that does not
    see it has a correlation of more than 0.2 by chance in one seed of 100,000."""
    table = TABLE.model_copy(update={"critic": critic, "normalise": False})
    model = train(Paid, table, tmp_path, seed=3, gamma=0.9).model
    venv = Paid(512) if critic == "observation" else ParametersBeside(Paid(512))
    venv.seed(100)
    seen = venv.reset()
    with torch.no_grad():
        values = model.policy.predict_values(torch.as_tensor(seen))[:, 0].numpy()
    gains = [info["parameters"]["gain"] for info in venv.unwrapped.reset_infos]
    assert low < np.corrcoef(values, gains)[0, 1] < high


@pytest.mark.slow
def test_a_training_is_reproducible_and_goes_on_after_a_kill(tmp_path) -> None:
    """Bit for bit, and the input floor acts as without parameters."""
    whole = train(Points, TABLE, tmp_path / "whole", seed=3, gamma=0.9)
    short = TABLE.model_copy(update={"steps": 3200})
    train(Points, short, tmp_path / "killed", seed=3, gamma=0.9)
    resumed = train(Points, TABLE, tmp_path / "killed", seed=3, gamma=0.9, resume=True)
    for mine, theirs in zip(resumed.model.policy.parameters(), whole.model.policy.parameters(), strict=True):
        assert np.array_equal(mine.detach().numpy(), theirs.detach().numpy())
    assert resumed.normalisation.obs_rms.mean.shape == (2,)
    assert resumed.normalisation.epsilon == pytest.approx(1e-4)
    with pytest.raises(InputError, match="other settings: critic"):
        train(
            Points,
            TABLE.model_copy(update={"critic": "observation"}),
            tmp_path / "killed",
            seed=3,
            gamma=0.9,
            resume=True,
        )
    other = train(Points, short.model_copy(update={"critic": "observation"}), tmp_path / "other", seed=3, gamma=0.9)
    assert other.curve[0]["reward"] != whole.curve[0]["reward"]
    assert whole.curve[-1]["distance_median"] < 0.2


def test_lanes_of_a_task_show_the_parameters_that_they_were_given() -> None:
    """Of the trunk itself, through the normalisation, also in lanes that were begun again."""
    randomisation = Uniform({"young_modulus": (3e6, 6e6)})
    batch = make_episodes("TrunkReach-v0", 2, randomisation=randomisation, actions="continuous", near=10.0)
    venv = ParametersBeside(VecNormalize(TrunkVecEnv(batch)))
    seen = venv.reset()
    for _ in range(2):  # every episode ends with its first action: it is near enough
        drawn = np.array([lane["young_modulus"] for lane in batch.parameters])
        assert seen[:, -1] == pytest.approx(ROOT_OF_12 * (drawn - 4.5e6) / 3e6, abs=0.15)
        seen, _, done, _ = venv.step(np.zeros((2, len(batch.layout.channels)), dtype=np.float32))
        assert done.all()
