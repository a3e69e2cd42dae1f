"""The parameter space: names, transforms with their Jacobians, parameters of single recordings."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.bayes.space import build_space
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.parameters import ParameterSpec

SPECS = (
    ParameterSpec(
        "young_modulus", "Pa", 1e6, 5e7, 4.5e6, {"distribution": "LogNormal", "median": 4e6, "sigma": 0.5}, ""
    ),
    ParameterSpec("poisson_ratio", "-", 0.1, 0.499, 0.45, {"distribution": "Uniform", "low": 0.3, "high": 0.499}, ""),
    ParameterSpec("offset_x", "m", -0.1, 0.1, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 0.01}, ""),
)


def space():
    return build_space(
        SPECS, {"young_modulus": {}, "poisson_ratio": {}, "offset_x": {}}, {"offset_x": ["a", "b"]}, ["a", "b", "c"]
    )


def test_a_parameter_of_single_recordings_is_free_there_and_absent_elsewhere():
    values = space().sample(jax.random.key(0), 3)
    assert set(values) == {"young_modulus", "poisson_ratio", "offset_x@a", "offset_x@b"}
    np.testing.assert_array_equal(space().for_recording(values, "b")["offset_x"], values["offset_x@b"])
    assert "offset_x" not in space().for_recording(values, "c")


def test_the_unconstrained_map_is_a_bijection_and_its_density_carries_the_jacobian():
    chosen = space()
    values = chosen.sample(jax.random.key(1), 50)
    u = chosen.to_unconstrained(values)
    back = chosen.from_unconstrained(u)
    for name in chosen.names:
        np.testing.assert_allclose(back[name], values[name], rtol=1e-10)
    # Density in u = density in physical units times |dx/du|, the latter by automatic differentiation.
    slope = jax.vmap(jax.jacfwd(lambda row: jnp.stack([chosen.from_unconstrained(row)[n] for n in chosen.names])))(u)
    expected = chosen.log_prior(values) + jnp.linalg.slogdet(slope)[1]
    np.testing.assert_allclose(chosen.log_prior_unconstrained(u), expected, rtol=1e-9)


def test_draws_around_an_earlier_posterior_keep_its_rows_together_and_stay_inside():
    """What it lacks, and what lies outside the support, comes from the prior; one value for all serves every one."""
    modulus = np.array([2e6, 3e6, 1e6, 9e9])  # the third on the bound, the fourth beyond it
    earlier = {"young_modulus": modulus, "offset_x": 1e-9 * modulus, "offset_x@b": np.full(4, 0.02)}
    values = space().sample_around(earlier, jax.random.key(3), 200)
    assert np.isfinite(space().to_unconstrained(values)).all()
    inside = np.isin(np.round(values["young_modulus"], 3), modulus)
    np.testing.assert_allclose(values["offset_x@a"][inside], 1e-9 * values["young_modulus"][inside], rtol=1e-9)
    assert np.isin([2e6, 3e6], np.round(values["young_modulus"], 3)).all()
    assert np.max(values["young_modulus"]) < 5e7
    np.testing.assert_allclose(values["offset_x@b"], 0.02, rtol=1e-12)
    assert len(np.unique(values["poisson_ratio"])) == 200
    other = space().sample_around({"offset_x@elsewhere": np.full(4, 0.03)}, jax.random.key(3), 5)
    np.testing.assert_allclose(other["offset_x@a"], 0.03, rtol=1e-12)


@pytest.mark.parametrize(
    ("priors", "scopes", "message"),
    [
        ({"young_modulos": {}}, {}, "did you mean 'young_modulus'"),
        ({}, {}, "no parameter has a prior"),
        ({"offset_x": {}}, {"offset_x": ["d"]}, "no recording is called 'd'"),
        ({"poisson_ratio": {"distribution": "Uniform", "low": 0.4, "high": 0.6}}, {}, "outside the bounds"),
    ],
)
def test_what_cannot_be_inferred_is_refused(priors, scopes, message):
    with pytest.raises(InputError, match=message):
        build_space(SPECS, priors, scopes, ["a", "b", "c"])
