"""Comparison of exported policies with their models, before and after training.

Some options of an algorithm change the network in ways that an export may not follow. A failure after hours of training
is avoided: the untrained policy is exported and compared first, as it is and with random weights, because an untrained
policy's actions are near zero, and hide a missing tanh or limit.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.policies.evaluation import Act
from rfdropo_bayes.policies.onnx_export import ExportedPolicy, export_policy, policy_layers
from rfdropo_bayes.robots.policy_layout import PolicyLayout

ROWS = 512


SMALLEST, USUAL, LARGEST = 0.01, 3.0, 20.0
"""Observations in deviations from their mean: nearly zero, usual for a trained policy, and twice the clipping limit of
a normalisation.
"""


TOLERANCE = 1e-3
"""Largest difference of a continuous action, which ranges from -1 to 1. The order of float32 operations causes less
than a tenth of it; a missing layer causes a hundred times it.
"""


TIES = 0.01
"""Share of discrete actions that may differ: if two actions have equal values to the last bit, both are right."""


OUTPUT = 4.0
"""Deviation of the last layer's output with drawn weights, in deviations of its input: twice the limit of gSDE."""


def observations(normalisation: Any, size: int, largest: float = USUAL) -> Float[np.ndarray, "row size"]:
    """Observations from near their mean to ``largest`` deviations away from it, as the environments give them.

    Args:
        normalisation: the ``VecNormalize`` of the policy.
        size: size of an observation.
        largest: deviations of the last row.
    """
    rows = np.random.default_rng(0).normal(size=(ROWS, size)) * np.geomspace(SMALLEST, largest, ROWS)[:, None]
    moments = normalisation.obs_rms
    return (moments.mean + np.sqrt(moments.var + normalisation.epsilon) * rows).astype(np.float32)


def difference(policy: ExportedPolicy, act: Act, seen: Float[np.ndarray, "row size"]) -> str | None:
    """Difference between an exported policy and ``act``, in words; None if it does not."""
    exported, wanted = policy.act(seen), np.asarray(act(seen))
    if policy.layout.kind == "discrete":
        share = float(np.mean(exported != wanted))
        return f"in {share:.0%} of its actions" if share > TIES else None
    apart = np.abs(exported - wanted)
    row = np.unravel_index(np.argmax(np.where(np.isnan(apart), np.inf, apart)), apart.shape)
    if apart[row] <= TOLERANCE:
        return None
    return f"{exported[row]:.3f} for {wanted[row]:.3f} of an action from -1 to 1"


def check_exportable(model: Any, normalisation: Any, act: Act, layout: PolicyLayout) -> None:
    """Refuse a model whose export would act otherwise; model, normalisation and random generators are unchanged.

    Args:
        model: model of Stable-Baselines3, trained or untrained.
        normalisation: the ``VecNormalize`` around its environments.
        act: map from the environments' observations to the model's most likely actions.
        layout: layout of the policy's observation and action.

    Raises:
        InputError: a layer that cannot be exported, or another action.
    """
    modes = [(module, module.training) for module in model.policy.modules()]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.onnx"
        _compare(model, normalisation, act, layout, path)
        with _drawn(model, normalisation):
            _compare(model, normalisation, act, layout, path)
    for module, mode in modes:  # a prediction ends the mode of training
        module.training = mode


def _compare(model: Any, normalisation: Any, act: Act, layout: PolicyLayout, path: Path) -> None:
    policy = ExportedPolicy(export_policy(model, normalisation, layout, path, {}))
    apart = difference(policy, act, observations(normalisation, layout.size, LARGEST))
    if apart is not None:
        raise InputError(
            f"the exported policy would act otherwise than the trained one: {apart}",
            where="[training.options]",
            remedy="leave out the options that change the network, such as policy_kwargs",
        )


@contextmanager
def _drawn(model: Any, normalisation: Any) -> Iterator[None]:
    """A model with drawn weights and a normalisation with drawn moments, for as long as the context lasts.

    Tensors and moments are exchanged and put back, not changed: training then starts from the original values, bit for
    bit.
    """
    import torch

    rng = np.random.default_rng(1)
    kept = [(parameter, parameter.data) for parameter in model.policy.parameters()]
    last = policy_layers(model)[0][-1].modules()
    outputs = [module.weight for module in last if isinstance(module, torch.nn.Linear)][-1]
    moments = normalisation.obs_rms
    try:
        for parameter, data in kept:
            # He et al. (2015): with variance 2 / n of the weights neither ReLU nor tanh lets a signal die or blow up.
            gain = OUTPUT if parameter is outputs else np.sqrt(2.0)
            scale = gain / np.sqrt(max(data.shape[-1], 1)) if data.ndim > 1 else 0.5
            parameter.data = torch.as_tensor(rng.normal(scale=scale, size=data.shape)).to(data)
        drawn = moments.copy()
        drawn.mean = rng.normal(scale=0.3, size=drawn.mean.shape)  # m, as a robot of that length
        drawn.var = rng.uniform(1e-4, 1.0, size=drawn.var.shape)
        normalisation.obs_rms = drawn
        yield
    finally:
        for parameter, data in kept:
            parameter.data = data
        normalisation.obs_rms = moments
