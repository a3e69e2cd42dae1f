"""The frame of a recording, by points of a rod at rest: exact for exact points, robust to right angles and scale."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.verbs.at_rest import resting
from rfdropo_bayes.verbs.registration import frame_of, register


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
    rest = Rotation.from_rotvec(found.remaining_turn).as_matrix()
    np.testing.assert_allclose(found.quarter @ rest, rotation, atol=1e-9)
    assert np.linalg.norm(found.remaining_turn) < np.radians(
        63.0
    )  # the largest angle to the nearest of the 24 rotations


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


TURN, SHIFT = Rotation.from_euler("xyz", (2.0, 0.4, -1.0)).as_matrix(), np.array([0.3, -0.1, 0.2])


def poses(position, markers, command, unit):
    """A recording of a robot at rest, turned and shifted."""
    time = np.arange(float(len(command)))
    return Trajectory.from_arrays(
        time=time,
        time_unit="s",
        position=position @ TURN.T + SHIFT,
        position_unit="m",
        markers=markers,
        channels=("c1", "c2", "c3"),
        command=command,
        command_unit=unit,
        command_time=time - 0.5,
        initial_command="zero",
        name="poses",
    )


def arm(length: float, radius: float, spool: float) -> Robot:
    """An arm without gravity whose sizes were not given."""
    return Robot.outline(
        name="arm",
        length=length,
        radius=radius,
        cable_radius=0.75 * radius,
        cables=3,
        markers={"tip": length},
        command_unit="rad",
        spool_radius=spool,
    ).with_changes(gravity_m_s2=(0.0, 0.0, 0.0))


@pytest.mark.parametrize(("size", "spool"), [(0.6, 0.021), (1.8, 0.013)])
def test_sizes_order_and_frame_are_found_from_poses(size, spool):
    """Of a robot that is smaller or larger than described, bends further, is turned, and whose cables run the other
    way round: three pulls and the poses of a rod at rest under them are enough."""
    true = resting(ModelSpec(arm(0.2 * size, 0.012 * size, spool * size)))
    command = np.random.default_rng(0).uniform(0.0, 0.6, size=(60, 3))
    made = true.markers(command[:, [0, 2, 1]])[0]
    recording = poses(made, ("tip",), command, "rad")
    found = register(ModelSpec(arm(0.2, 0.012, 0.01)), recording, scaled=True, bends=True)
    assert found.arrangement is not None
    assert found.arrangement.columns in ((0, 2, 1), (2, 1, 0), (1, 0, 2))
    assert found.frame.explained > 0.995
    assert found.frame.scale == pytest.approx(size, rel=0.15)
    assert found.bend == pytest.approx(spool / 0.01, rel=0.25)  # the nearest of factors that lie 1.4 apart


def test_a_bend_that_priors_reach_leaves_the_sizes_as_they_are_told():
    """A swing in phase, or a softer body, may have made the motion larger."""
    true = resting(ModelSpec(arm(0.2, 0.012, 0.01)))
    command = np.random.default_rng(0).uniform(0.0, 0.3, size=(60, 3))
    spec = ModelSpec(arm(0.2, 0.012, 0.01))
    swung, bent = (
        register(spec, poses(true.markers(size * command)[0], ("tip",), command, "rad"), scaled=False, bends=True)
        for size in (1.4, 2.0)
    )
    assert (swung.bend, bent.bend) == (1.0, pytest.approx(2.0, rel=0.01))


def test_the_weight_of_an_arm_that_lies_shows_the_azimuth_of_its_cables():
    """A frame that is turned about the axis could explain the bends by cables alone, and not the sag."""

    def lying(azimuth: float) -> Robot:
        sizes = {"length": 0.2, "radius": 0.014, "cable_radius": 0.01, "young_modulus": 3e5}
        markers = {"middle": 0.1, "tip": 0.2}
        return Robot.outline(name="arm", cables=3, markers=markers, **sizes, gravity="-y", segment_azimuths=(azimuth,))

    command = np.random.default_rng(0).uniform(0.0, 0.008, size=(16, 3))
    made = resting(ModelSpec(lying(217.0))).markers(command)[0]
    found = register(ModelSpec(lying(0.0)), poses(made, ("middle", "tip"), command, "m"), scaled=False, bends=False)
    assert found.arrangement is not None
    assert found.arrangement.columns == (0, 1, 2)
    assert np.degrees(found.arrangement.turns[0]) % 360.0 == pytest.approx(217.0, abs=2.0)
    assert found.frame.explained > 0.999
    np.testing.assert_allclose(found.frame.rotation, TURN, atol=0.03)
