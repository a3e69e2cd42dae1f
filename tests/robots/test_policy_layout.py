"""The layout that training and motors share: order, units, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots.policy_layout import ObservationPart, PolicyLayout

CONTINUOUS = PolicyLayout(
    task="TrunkReach-v0",
    period_s=0.1,
    observation=(ObservationPart("markers", 6, "m"), ObservationPart("goal", 3, "m")),
    channels=("left", "right"),
    unit="m",
    kind="continuous",
    moves=((0.005, 0.004),),
    low=(-0.01, -0.01),
    high=(0.07, 0.04),
)
DISCRETE = replace(CONTINUOUS, kind="discrete", moves=((0.005, 0.0), (0.0, 0.005), (-0.005, 0.0), (0.0, -0.005)))


def test_observations_are_put_together_in_the_layouts_order() -> None:
    parts = {"goal": np.array([[7.0, 8.0, 9.0]]), "markers": np.arange(1.0, 7.0)[None]}
    assert CONTINUOUS.assemble(parts).tolist() == [[1, 2, 3, 4, 5, 6, 7, 8, 9]]
    assert CONTINUOUS.size == 9


def test_actions_move_channels_by_their_own_steps() -> None:
    assert CONTINUOUS.change(np.array([2.0, -0.5])) == pytest.approx([0.005, -0.002])
    assert DISCRETE.change(np.array([1, 2])) == pytest.approx(np.array([[0.0, 0.005], [-0.005, 0.0]]))


@pytest.mark.parametrize("layout", [CONTINUOUS, DISCRETE])
def test_text_and_back(layout: PolicyLayout) -> None:
    again = PolicyLayout.from_json(layout.to_json(), where="here")
    assert again == layout
    assert again.sha256 == layout.sha256 != replace(layout, period_s=0.2).sha256


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"period_s": 0.05}, "period_s is 0.05"),
        ({"observation": CONTINUOUS.observation[:1]}, "observation is"),
        ({"channels": ("right", "left")}, "channels is"),
        ({"unit": "rad"}, "unit is rad"),
    ],
)
def test_another_layout_is_refused_by_name(change: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        CONTINUOUS.require(replace(CONTINUOUS, **change), where="policy.onnx")


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"task": "x", "observation": [{"size": 1}]}'])
def test_text_that_is_no_layout_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        PolicyLayout.from_json(text, where="policy.onnx")


def test_parts_that_are_missing_or_of_another_size_are_refused() -> None:
    with pytest.raises(InputError, match="no 'goal'"):
        CONTINUOUS.assemble({"markers": np.zeros(6)})
    with pytest.raises(InputError, match="'goal' has 2"):
        CONTINUOUS.assemble({"markers": np.zeros(6), "goal": np.zeros(2)})


@pytest.mark.parametrize("change", [{"moves": ((0.1,),)}, {"low": (0.1, 0.1), "high": (0.0, 0.2)}, {"period_s": 0.0}])
def test_layouts_that_cannot_be_are_refused(change: dict) -> None:
    with pytest.raises(InputError):
        replace(CONTINUOUS, **change)
