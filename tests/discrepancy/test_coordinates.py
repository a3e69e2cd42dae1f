"""Parameters of an audit as one vector, and what each recording's rollout is given."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfdropo_bayes.bayes.inferred_parameter import Pooled
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.groups import gather_groups
from rfdropo_bayes.simulators.parameters import ParameterSpec

SPECS = (
    ParameterSpec("modulus", "Pa", 0.0, np.inf, 1.0, {"distribution": "LogNormal", "median": 1.0, "sigma": 0.3}, ""),
    ParameterSpec("zero", "m", -1.0, 1.0, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 0.1}, ""),
)
RECORDINGS = ("a1", "b", "a2", "c")


def test_a_recording_is_given_the_shared_value_and_its_group_s_deviation():
    """As the calibration gives it, and with the derivatives of that."""
    groups = gather_groups(RECORDINGS[:2], {"a": "a*"}) | {"a": ("a1", "a2")}
    space = build_scopes(SPECS, {"modulus": {}, "zero": {}}, {}, RECORDINGS[:2], pooled={"zero": Pooled(0.02, groups)})
    coordinates = Coordinates(space, len(space.names), ("zero", "modulus"))
    drawn = {name: np.asarray(v) for name, v in space.sample(jax.random.key(0), 5).items()}
    x = np.stack([coordinates.encode({n: v[k] for n, v in drawn.items()}) for k in range(5)])
    slots = coordinates.slots(RECORDINGS)
    found = coordinates.physical_values(x, slots)
    for index, recording in enumerate(RECORDINGS):
        known = space.values_in(recording, drawn)
        np.testing.assert_allclose(found[:, index], np.stack([known["zero"], known["modulus"]], axis=1), rtol=1e-9)
    assert np.ptp(found[0, [0, 2], 0]) == 0.0
    assert np.ptp(found[0, [0, 1], 0]) > 0.0
    direction = np.random.default_rng(0).normal(size=x.shape)
    step = 1e-6 * direction
    differences = (coordinates.physical_values(x + step, slots) - coordinates.physical_values(x - step, slots)) / 2e-6
    np.testing.assert_allclose(coordinates.physical_tangents(x, direction, slots), differences, rtol=1e-6, atol=1e-9)


def test_the_prior_is_the_calibration_s_own_density_with_its_derivatives():
    """Base parameters as in the unconstrained space of the calibration; a size measured from null by its own density,
    which is half a normal's twice as high."""
    half = ParameterSpec("play", "rad", 0.0, 9.0, 0.0, {"distribution": "HalfNormal", "scale": 0.5}, "")
    space = build_scopes((*SPECS, half), {"modulus": {}, "zero": {}, "play": {}}, {}, RECORDINGS)
    coordinates = Coordinates(space, 2, ("modulus", "zero", "play"))
    x = np.array([0.4, -0.3, 1.2])
    base = build_scopes(SPECS, {"modulus": {}, "zero": {}}, {}, RECORDINGS)
    expected = float(base.log_prior_unconstrained(jnp.asarray(x[None, :2]))[0])
    found = coordinates.log_prior(x[None])[0]
    assert found[:2].sum() == pytest.approx(expected, rel=1e-9)
    assert found[2] == pytest.approx(stats.halfnorm.logpdf(1.2), abs=1e-6)
    slope, curvature = coordinates.prior_slopes(x)
    single = jax.grad(lambda u: base.log_prior_unconstrained(u[None])[0])
    np.testing.assert_allclose(slope[:2], single(jnp.asarray(x[:2])), rtol=1e-5)
    np.testing.assert_allclose(curvature[:2], np.diag(jax.jacfwd(single)(jnp.asarray(x[:2]))), rtol=1e-4)
    assert (slope[2], curvature[2]) == (pytest.approx(-1.2), pytest.approx(-1.0, rel=1e-5))
