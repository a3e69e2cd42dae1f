"""Small ONNX policies for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from rfdropo_bayes.deployment.policy import METADATA
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.policy_layout import ObservationPart, PolicyLayout


def linear_policy(
    path: Path, robot: Robot, weight: np.ndarray, bias: np.ndarray, /, card: bool = True, **changes: Any
) -> Path:
    """action = observation @ weight + bias; the observation is commands and markers by default."""
    channels = robot.channel_names
    table = {
        "task": "test",
        "period_s": 0.1,
        "unit": robot.command_unit,
        "kind": "continuous",
        "channels": channels,
        "observation": (
            ObservationPart("commands", len(channels), robot.command_unit),
            ObservationPart("markers", 3 * len(robot.marker_names), "m"),
        ),
        "moves": ((0.01,) * len(channels),),
        "low": (-0.03,) * len(channels),
        "high": (0.03,) * len(channels),
    }
    values = [numpy_helper.from_array(array.astype(np.float32), name) for array, name in ((weight, "w"), (bias, "b"))]
    graph = helper.make_graph(
        [
            helper.make_node("MatMul", ["observation", "w"], ["product"]),
            helper.make_node("Add", ["product", "b"], ["action"]),
        ],
        "linear",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, [None, weight.shape[0]])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, [None, weight.shape[1]])],
        values,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    if card:
        helper.set_model_props(model, {METADATA: PolicyLayout(**(table | changes)).to_json()})
    onnx.save(model, str(path))
    return path
