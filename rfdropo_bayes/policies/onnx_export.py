"""A trained policy as ONNX: normalisation, network, clipping and the map to commands in one graph.

The graph has one input, ``observation`` (float32, batch by size), and two float32 outputs. ``action`` (batch by
channel) is the change of each channel's command per control period [m or rad]. ``raw`` is the action as the environment
takes it: a number from -1 to 1 for every channel, or the index of a discrete action (batch by 1). The metadata hold the
layout (`PolicyLayout.to_json`) and the origin of the policy. The graph is built node by node: PyTorch's own exporter
needs one more package, and would leave the normalisation out.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots.policy_layout import PolicyLayout

LAYOUT = "rfdropo_layout"  # key of the layout among the metadata
OPSET, IR_VERSION = 17, 9
ACTIVATIONS = {"Tanh": "Tanh", "ReLU": "Relu", "ELU": "Elu", "LeakyReLU": "LeakyRelu", "Sigmoid": "Sigmoid"}


class _Graph:
    """Nodes and constants of a graph under construction; ``at`` is the name of the last result."""

    def __init__(self, at: str) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self.at = at

    def constant(self, values: Any, dtype: type = np.float32) -> str:
        """A named constant."""
        from onnx import numpy_helper

        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(values, dtype=dtype), name))
        return name

    def apply(self, kind: str, *inputs: str, name: str | None = None, **attributes: Any) -> str:
        """An operation on the last result and further inputs; ``name`` names its result."""
        from onnx import helper

        name = name or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, [self.at, *inputs], [name], **attributes))
        self.at = name
        return name

    def network(self, modules: Any) -> None:
        """Layers of a sequential network of PyTorch."""
        for module in modules:
            kind = type(module).__name__
            if not type(module).__module__.startswith(("torch.nn.", "stable_baselines3.")):
                kind = f"{type(module).__module__}.{kind}"  # whatever it is called, it may do something else
            if kind == "Sequential":
                self.network(module)
            elif kind == "Linear":
                self.apply("Gemm", *(self.constant(p.detach().cpu().numpy()) for p in module.parameters()), transB=1)
            elif kind == "Hardtanh":
                self.apply("Clip", self.constant(module.min_val), self.constant(module.max_val))
            elif kind == "ELU":
                self.apply("Elu", alpha=float(module.alpha))
            elif kind == "LeakyReLU":
                self.apply("LeakyRelu", alpha=float(module.negative_slope))
            elif kind in ACTIVATIONS:
                self.apply(ACTIVATIONS[kind])
            elif kind not in ("Flatten", "FlattenExtractor", "Identity"):
                raise InputError(
                    f"a layer of type {kind} cannot be exported",
                    where="policy",
                    remedy=f"use Linear and {', '.join(ACTIVATIONS)}",
                )


def policy_layers(model: Any) -> tuple[list[Any], bool]:
    """Layers of a model of PPO from observation to action, and whether a tanh ends them."""
    policy = model.policy  # a tanh only with gSDE and squash_output
    return [policy.pi_features_extractor, policy.mlp_extractor.policy_net, policy.action_net], policy.squash_output


def export_policy(model: Any, normalisation: Any, layout: PolicyLayout, path: Path, facts: Mapping[str, str]) -> Path:
    """Write a policy of Stable-Baselines3 with everything between measurement and command.

    Args:
        model: the trained model.
        normalisation: ``VecNormalize`` of the policy's training.
        layout: layout of the policy's observation and action.
        path: file to write.
        facts: further metadata: hashes, seed, versions.

    Raises:
        InputError: a network with layers that have no counterpart here.
    """
    from onnx import TensorProto, checker, helper, save

    graph = _Graph("observation")
    moments, limit = normalisation.obs_rms, float(normalisation.clip_obs)
    graph.apply("Sub", graph.constant(moments.mean))
    graph.apply("Div", graph.constant(np.sqrt(moments.var + normalisation.epsilon)))
    graph.apply("Clip", graph.constant(-limit), graph.constant(limit))
    layers, squashed = policy_layers(model)
    graph.network(layers)
    if layout.kind == "discrete":
        chosen = graph.apply("ArgMax", axis=-1, keepdims=0)
        graph.apply("Unsqueeze", graph.constant([1], np.int64))
        graph.apply("Cast", name="raw", to=TensorProto.FLOAT)
        graph.at = graph.constant(layout.moves)
        graph.apply("Gather", chosen, name="action", axis=0)
    else:
        if squashed:
            graph.apply("Tanh")
        graph.apply("Clip", graph.constant(-1.0), graph.constant(1.0), name="raw")
        graph.apply("Mul", graph.constant(layout.moves[0]), name="action")
    width = 1 if layout.kind == "discrete" else len(layout.channels)
    ends = {"observation": layout.size, "action": len(layout.channels), "raw": width}
    tensors = {n: helper.make_tensor_value_info(n, TensorProto.FLOAT, ["batch", size]) for n, size in ends.items()}
    described = helper.make_graph(
        graph.nodes, "policy", [tensors["observation"]], [tensors["action"], tensors["raw"]], graph.constants
    )
    proto = helper.make_model(described, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    helper.set_model_props(proto, {LAYOUT: layout.to_json(), **facts})
    checker.check_model(proto, full_check=True)
    save(proto, str(path))
    return Path(path)


class ExportedPolicy:
    """An exported policy, ready to act.

    Args:
        path: path of the ONNX file.

    Attributes:
        layout: layout of the policy's observation and action.
        facts: its other metadata.

    Raises:
        InputError: no such file, not a model, or a model without a layout.
    """

    def __init__(self, path: Path) -> None:
        import onnxruntime

        if not Path(path).is_file():
            raise InputError(
                "no such policy", where=str(path), remedy="name a policy.onnx, or the folder of a training"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # two threads take longer over so small a network
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime raises its own classes for each way to fail
            reason = str(error).splitlines()[0]
            raise InputError(f"cannot read the policy: {reason}", where=str(path), remedy="check the path") from None
        facts = dict(self._session.get_modelmeta().custom_metadata_map)
        if LAYOUT not in facts:
            raise InputError("the model carries no layout", where=str(path), remedy="export it with `rfdropo train`")
        self.layout = PolicyLayout.from_json(facts.pop(LAYOUT), where=str(path))
        self.facts = facts

    def change(self, observation: Float[np.ndarray, "lane size"]) -> Float[np.ndarray, "lane channel"]:
        """Change of each channel's command [m or rad]."""
        return self._session.run(["action"], {"observation": np.asarray(observation, dtype=np.float32)})[0]

    def act(self, observation: Float[np.ndarray, "lane size"]) -> np.ndarray:
        """Actions as the environments take them."""
        raw = self._session.run(["raw"], {"observation": np.asarray(observation, dtype=np.float32)})[0]
        return raw[:, 0].astype(np.int64) if self.layout.kind == "discrete" else raw


def latency(policy: ExportedPolicy, calls: int = 2000) -> dict[str, float]:
    """Median and 99th percentile of the time of one decision [s]."""
    observation = np.zeros((1, policy.layout.size), dtype=np.float32)
    times = np.empty(calls)
    for call in range(calls):
        began = time.perf_counter()
        policy.change(observation)
        times[call] = time.perf_counter() - began
    return {"median_s": float(np.median(times)), "p99_s": float(np.quantile(times, 0.99))}
