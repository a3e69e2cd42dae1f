"""Sensing mechanisms against SciPy's rotations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rfdropo_bayes.mechanisms import REGISTRY

POINTS = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3, 3)))


def turn(vector):
    values = {f"camera_rotation_{axis}": jnp.asarray(v) for axis, v in zip("xyz", vector, strict=True)}
    return REGISTRY["camera_rotation"]().sense(values, POINTS)


@given(st.tuples(*[st.floats(-0.8, 0.8)] * 3))
@settings(deadline=None, max_examples=40)
def test_the_camera_rotates_as_a_rotation_vector_says(vector):
    expected = Rotation.from_rotvec(vector).apply(np.array(POINTS).reshape(-1, 3)).reshape(POINTS.shape)
    np.testing.assert_allclose(turn(vector), expected, atol=1e-9)


def test_at_zero_nothing_turns_and_the_derivative_is_the_cross_product():
    np.testing.assert_array_equal(turn((0.0, 0.0, 0.0)), POINTS)
    slope = jax.jacfwd(lambda angle: turn((0.0, angle, 0.0)))(0.0)
    np.testing.assert_allclose(slope, jnp.cross(jnp.array([0.0, 1.0, 0.0]), POINTS), atol=1e-12)


def test_the_camera_scale_is_relative():
    scaled = REGISTRY["camera_scale"]().sense({"camera_scale_error": jnp.asarray(0.02)}, POINTS)
    np.testing.assert_allclose(scaled, 1.02 * POINTS)


def test_the_camera_drifts_from_the_first_row_whatever_its_clock_says():
    values = {
        f"camera_offset_{axis}_rate": jnp.asarray(speed) for axis, speed in zip("xyz", (0.01, 0.0, -0.02), strict=True)
    }
    moved = REGISTRY["camera_offset_drift"]().sense_over_time(values, POINTS, jnp.array([7.0, 7.5, 8.0, 9.0])) - POINTS
    np.testing.assert_allclose(moved[0], 0.0, atol=1e-15)
    np.testing.assert_allclose(moved[3], np.broadcast_to([0.02, 0.0, -0.04], (3, 3)), atol=1e-12)
