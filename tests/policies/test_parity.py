"""What an export would change is found before a training starts, and the training does not notice."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecNormalize

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.policies import onnx_export, parity
from rfdropo_bayes.policies import training as run
from rfdropo_bayes.policies.onnx_export import ExportedPolicy, export_policy
from rfdropo_bayes.policies.parity import check_exportable, difference, observations
from rfdropo_bayes.policies.ppo import ppo_options
from rfdropo_bayes.policies.training import Trained, train
from rfdropo_bayes.policies.training_config import TrainingTable
from tests.policies.toys import Points, layout

SQUASHED = {"use_sde": True, "policy_kwargs": {"squash_output": True}}


def untrained(given: dict[str, Any], kind: str = "continuous") -> Trained:
    normalisation = VecNormalize(Points(4, kind), epsilon=1e-4)
    model = PPO("MlpPolicy", normalisation, seed=0, device="cpu", **ppo_options(kind, 0.9, given, 4))
    return Trained(model, normalisation, [], 0, 0.0)


def check(policy: Trained, kind: str = "continuous") -> None:
    check_exportable(policy.model, policy.normalisation, policy.act, layout(kind))


@pytest.mark.parametrize(
    "options",
    [
        {"use_sde": True},
        SQUASHED,
        {"policy_kwargs": {"share_features_extractor": False, "net_arch": {"pi": [8], "vf": []}}},
    ],
)
def test_an_export_acts_as_the_model_where_its_limits_are_met(tmp_path, options) -> None:
    """As `predict` itself, with weights so large that a tanh differs from a limit by a quarter."""
    policy = untrained(options)
    check(policy)
    with torch.no_grad():
        for parameter in policy.model.policy.parameters():
            parameter.mul_(3.0)
        for module in policy.model.policy.modules():
            if isinstance(module, torch.nn.Linear) and module.out_features == 1:
                module.weight.mul_(10.0)
    exported = ExportedPolicy(
        export_policy(policy.model, policy.normalisation, layout("continuous"), tmp_path / "policy.onnx", {})
    )
    seen = np.random.default_rng(0).uniform(-2.0, 2.0, (300, 2)).astype(np.float32)
    wanted = policy.act(seen)
    assert np.abs(wanted).max() > 0.45  # beyond half of the range, or at the limit of 0.5 of one of the cases
    assert exported.act(seen) == pytest.approx(wanted, abs=1e-4)


class Absolute(torch.nn.Module):
    """A layer that no export knows."""

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return values.abs()


class Features(BaseFeaturesExtractor):
    """A features extractor with weights of its own."""

    def __init__(self, space: Any) -> None:
        super().__init__(space, 2)
        self.net = torch.nn.Linear(2, 2)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return self.net(values)


@pytest.mark.parametrize(
    ("kind", "kwargs", "words"),
    [
        ("continuous", {"activation_fn": torch.nn.GELU}, "GELU"),
        ("continuous", {"activation_fn": Absolute}, "Absolute"),
        ("continuous", {"features_extractor_class": Features}, "Features"),
        ("discrete", {"features_extractor_class": Features, "share_features_extractor": False}, "Features"),
    ],
)
def test_what_cannot_be_exported_is_refused(kind, kwargs, words) -> None:
    with pytest.raises(InputError, match=f"{words} cannot be exported"):
        check(untrained({"policy_kwargs": kwargs}, kind), kind)


def test_an_export_that_leaves_out_a_tanh_is_refused(monkeypatch) -> None:
    """The actions of an untrained policy are near zero, where a tanh does nothing."""
    real = onnx_export.policy_layers
    policy = untrained(SQUASHED)
    check(policy)
    monkeypatch.setattr("rfdropo_bayes.policies.onnx_export.policy_layers", lambda model: (real(model)[0], False))
    with pytest.raises(InputError, match="would act otherwise"):
        check(policy)


def test_an_export_without_the_limits_of_the_normalisation_is_refused(monkeypatch) -> None:
    policy = untrained({})
    unlimited = VecNormalize(Points(4), epsilon=1e-4, clip_obs=1e9)
    monkeypatch.setattr(parity, "export_policy", lambda model, _, *rest: export_policy(model, unlimited, *rest))
    with pytest.raises(InputError, match="would act otherwise"):
        check(policy)


def test_another_choice_among_discrete_actions_is_a_difference(tmp_path) -> None:
    policy = untrained({}, "discrete")
    path = export_policy(policy.model, policy.normalisation, layout("discrete"), tmp_path / "policy.onnx", {})
    seen = observations(policy.normalisation, 2)
    assert difference(ExportedPolicy(path), policy.act, seen) is None
    assert "100%" in str(difference(ExportedPolicy(path), lambda seen: (policy.act(seen) + 1) % 3, seen))


def test_the_check_leaves_a_training_as_it_was(tmp_path, monkeypatch) -> None:
    """Weights, moments and random numbers: the curve is the same, bit for bit, without the check."""
    given = {"use_sde": True, "n_steps": 20, "net_arch": [16]}
    sizes = {"steps": 320, "environments": 16, "evaluate_every": 160, "evaluation_episodes": 4}
    table = TrainingTable(options=given, **sizes)
    checked = train(Points, table, tmp_path / "checked", seed=1, gamma=0.9)
    monkeypatch.setattr(run, "check_exportable", lambda *rest: None)
    bare = train(Points, table, tmp_path / "bare", seed=1, gamma=0.9)
    for mine, theirs in zip(checked.model.policy.parameters(), bare.model.policy.parameters(), strict=True):
        assert np.array_equal(mine.detach().numpy(), theirs.detach().numpy())
    assert [row["reward"] for row in checked.curve] == [row["reward"] for row in bare.curve]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"policy_kwargs": {"activation_fn": torch.nn.GELU}}, "cannot be stored in a file"),
        ({"policy_kwargs": {"squash_output": True}}, "only available when using gSDE"),
        ({"policy_kwargs": {"activation_fn": "gelu"}}, "PPO cannot be made"),
        ({"policy_kwargs": {"n_critics": 3}}, "unexpected keyword argument 'n_critics'"),
        ({"policy_kwargs": [1]}, "policy_kwargs is not a table"),
    ],
)
def test_options_that_make_no_policy_are_refused_in_one_line(tmp_path, options, words) -> None:
    with pytest.raises(InputError, match=words) as error:
        train(Points, TrainingTable(options=options), tmp_path, seed=1, gamma=0.9)
    assert "[training.options]" in str(error.value)
    assert "\n" not in str(error.value)


def test_the_check_comes_before_the_first_step(tmp_path, monkeypatch) -> None:
    def refuse(*rest: Any) -> None:
        raise InputError("refused")

    class Still(Points):
        """Points that never move."""

        def step_wait(self) -> Any:
            raise AssertionError("an environment was stepped")

    monkeypatch.setattr(run, "check_exportable", refuse)
    with pytest.raises(InputError, match="refused"):
        train(Still, TrainingTable(options={"net_arch": [8]}), tmp_path, seed=1, gamma=0.9)
