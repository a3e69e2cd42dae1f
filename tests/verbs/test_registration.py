"""The frame of a recording, by points of a rod at rest: exact for exact points, robust to right angles and scale."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rfdropo_bayes.verbs.registration import frame_of


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31 - 1), st.booleans())
def test_a_rigid_motion_of_points_is_found_exactly(seed, scaled):
    rng = np.random.default_rng(seed)
    made = rng.normal(size=(20, 2, 3)) * (0.05, 0.04, 0.02)
    rotation, shift = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    scale = float(rng.uniform(0.3, 3.0)) if scaled else 1.0
    seen = scale * made @ rotation.T + shift
    seen[3] = np.nan
    found = frame_of(made, seen, scaled=scaled)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(found.shift, shift, atol=1e-9)
    assert found.scale == pytest.approx(scale)
    assert found.explained == pytest.approx(1.0)
    rest = Rotation.from_rotvec(found.left_over).as_matrix()
    np.testing.assert_allclose(found.quarter @ rest, rotation, atol=1e-9)
    assert np.linalg.norm(found.left_over) < np.radians(63.0)  # the largest angle to the nearest of the 24 rotations


def test_a_mirror_image_is_not_explained():
    rng = np.random.default_rng(0)
    made = rng.normal(size=(50, 1, 3))
    assert frame_of(made, made * (-1.0, 1.0, 1.0), scaled=False).explained < 0.9


def test_markers_that_rest_are_no_motion_that_a_rod_explains():
    """Two markers far apart that move otherwise than the rod: their distance explains nothing."""
    rng = np.random.default_rng(1)
    places = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2]])
    made, seen = (places + 0.01 * rng.normal(size=(40, 2, 3)) for _ in range(2))
    assert frame_of(made, seen, scaled=False).explained < 0.3
