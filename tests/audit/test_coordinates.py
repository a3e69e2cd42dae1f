"""Parameters of an audit as one vector, and what each recording's rollout is given."""

from __future__ import annotations

import jax
import numpy as np

from rfdropo_bayes.audit.coordinates import Coordinates
from rfdropo_bayes.bayes.pooling import Pooled, gather_groups
from rfdropo_bayes.bayes.space import build_space
from rfdropo_bayes.simulators.parameters import ParameterSpec

SPECS = (
    ParameterSpec("modulus", "Pa", 0.0, np.inf, 1.0, {"distribution": "LogNormal", "median": 1.0, "sigma": 0.3}, ""),
    ParameterSpec("zero", "m", -1.0, 1.0, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 0.1}, ""),
)
RECORDINGS = ("a1", "b", "a2", "c")


def test_a_recording_is_given_the_shared_value_and_its_group_s_deviation():
    """As the calibration gives it, and with the derivatives of that."""
    groups = gather_groups(RECORDINGS[:2], {"a": "a*"}) | {"a": ("a1", "a2")}
    space = build_space(SPECS, {"modulus": {}, "zero": {}}, {}, RECORDINGS[:2], pooled={"zero": Pooled(0.02, groups)})
    coordinates = Coordinates(space, len(space.names), ("zero", "modulus"), {"zero": 0.0, "modulus": 1.0}, {})
    drawn = {name: np.asarray(v) for name, v in space.sample(jax.random.key(0), 5).items()}
    x = np.stack([coordinates.encode({n: v[k] for n, v in drawn.items()}) for k in range(5)])
    slots = coordinates.slots(RECORDINGS)
    found = coordinates.physical_values(x, slots)
    for index, recording in enumerate(RECORDINGS):
        known = space.for_recording(drawn, recording)
        np.testing.assert_allclose(found[:, index], np.stack([known["zero"], known["modulus"]], axis=1), rtol=1e-9)
    assert np.ptp(found[0, [0, 2], 0]) == 0.0
    assert np.ptp(found[0, [0, 1], 0]) > 0.0
    direction = np.random.default_rng(0).normal(size=x.shape)
    step = 1e-6 * direction
    differences = (coordinates.physical_values(x + step, slots) - coordinates.physical_values(x - step, slots)) / 2e-6
    np.testing.assert_allclose(coordinates.physical_tangents(x, direction, slots), differences, rtol=1e-6, atol=1e-9)
