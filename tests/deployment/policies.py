"""Small ONNX policies for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from rfdropo_bayes.deployment.policy import PolicyCard
from rfdropo_bayes.robots import Robot


def linear_policy(
    path: Path, robot: Robot, weight: np.ndarray, bias: np.ndarray, /, card: bool = True, **changes: Any
) -> Path:
    """action = observation @ weight + bias, observation as the card says; by default the command and the tip."""
    channels, tip = robot.channel_names, robot.marker_names[-1]
    names = tuple(f"command.{channel}" for channel in channels) + tuple(f"marker.{tip}.{axis}" for axis in "xyz")
    table = {
        "robot": robot.name,
        "rate_hz": 10.0,
        "unit": robot.command_unit,
        "action": "increment",
        "channels": channels,
        "observation": names,
        "low": (-0.01,) * len(channels),
        "high": (0.01,) * len(channels),
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
        helper.set_model_props(model, PolicyCard(**(table | changes)).metadata())
    onnx.save(model, str(path))
    return path
