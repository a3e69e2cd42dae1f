"""Orientations of sections: from points of a section, as residuals, and as columns of a recording."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import rfdropo_bayes as rb
from rfdropo_bayes.bayes.channels import Orientation, Seen
from rfdropo_bayes.bayes.channels.quaternions import of_rotation_vector, product
from rfdropo_bayes.simulators.protocol import Observation
from rfdropo_bayes.simulators.robot_simulator import orientations
from studies.replicas import drawn

TURNS = Rotation.random(6, random_state=np.random.default_rng(0))


def test_three_points_of_a_section_tell_its_turn_whatever_it_is():
    """Turns by half a turn about each axis among them, where three of the four formulas fail."""
    turns = Rotation.concatenate([TURNS, Rotation.from_rotvec(np.pi * np.eye(3)), Rotation.identity()])
    corners = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0]])
    points = np.einsum("tij,kj->tki", turns.as_matrix(), corners) + np.array([0.1, 0.2, 0.3])
    found = Rotation.from_quat(np.asarray(orientations(jnp.asarray(points)))[:, 0])
    np.testing.assert_allclose((found * turns.inv()).magnitude(), 0.0, atol=1e-7)


def test_rotation_vectors_have_a_derivative_where_they_are_zero():
    vector = np.array([[0.3, -0.2, 0.1], [1e-5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    expected = Rotation.from_rotvec(vector).as_quat()
    np.testing.assert_allclose(of_rotation_vector(jnp.asarray(vector)), expected, atol=1e-15)
    slope = jax.jacobian(of_rotation_vector)(jnp.zeros(3))
    np.testing.assert_allclose(slope, np.eye(4, 3) / 2.0)


def channel(readings):
    """Of one section in one recording."""
    return Orientation(readings[None], np.ones((1, len(readings), 3), bool), sections=(0,))


def seen(turns, **values):
    found = Observation(jnp.zeros((1, len(turns), 1, 3)), jnp.zeros((1, len(turns), 1)), None, jnp.zeros(1))
    found = found._replace(orientation=jnp.asarray(turns)[None, :, None])
    return Seen(found, {"orientation_noise": 0.01, **values}, jnp.zeros((1, 3)))


def test_residuals_are_turns_in_the_frame_over_the_noise():
    small = np.array([0.01, -0.02, 0.005])
    measured = (Rotation.from_rotvec(small) * TURNS).as_quat()
    errors = channel(measured).residuals(seen(TURNS.as_quat()), measured[None])
    np.testing.assert_allclose(errors[0], np.tile(small / 0.01, (6, 1)), rtol=1e-4)


def test_a_turn_of_the_frame_takes_a_constant_turn_out():
    measured = (Rotation.from_rotvec([0.5, 0.1, -0.2]) * TURNS).as_quat()
    shown = seen(TURNS.as_quat(), frame_turn_x=0.5, frame_turn_y=0.1, frame_turn_z=-0.2)
    np.testing.assert_allclose(channel(measured).residuals(shown, measured[None]), 0.0, atol=1e-9)


def test_draws_have_the_size_of_the_noise():
    many = np.tile(TURNS.as_quat()[0], (4000, 1))
    one = channel(many)
    errors = drawn(one, jax.random.key(0), seen(many))
    assert np.std(one.deviation(errors, many[None])) == pytest.approx(0.01, rel=0.03)


def test_columns_may_hold_quaternions_or_rotation_vectors():
    """Along the file's axes, from the undeformed body; a missing row is left out and counted."""
    vector = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 20.0, 0.0]])
    quaternion = Rotation.from_rotvec(vector, degrees=True).as_quat()
    frame = pd.DataFrame({"t": [0.0, 0.1, 0.2], "u": [0.0, 1.0, 2.0], "x": 0.0, "y": 0.0, "z": [0.2, 0.19, 0.18]})
    frame[["vx", "vy", "vz"]], frame[["qx", "qy", "qz", "qw"]] = vector, quaternion
    frame.loc[2, "qx"] = np.nan
    columns = {"time": "t", "commands": ["u"], "command_unit": "mm", "positions": [["x", "z", "y"]]}
    columns |= {"position_unit": "m", "axes": ("x", "-z", "y"), "rotation_unit": "deg", "sections": ["one", "two"]}
    columns["orientations"] = [["vx", "vy", "vz"], ["qx", "qy", "qz", "qw"]]
    found = rb.Trajectory.from_pandas(frame, columns)
    assert found.section_names == ("one", "two")
    turned = Rotation.from_quat(found.orientation[:, 0]).as_rotvec(degrees=True)
    np.testing.assert_allclose(turned, [[0, 0, 0], [10, 0, 0], [0, 0, 20]], atol=1e-9)
    np.testing.assert_allclose(found.orientation[:2, 1], found.orientation[:2, 0])
    assert not np.isfinite(found.orientation[2, 1]).any()
    assert "1 missing orientations" in found.missing
    middle = found.resample(0.05)
    np.testing.assert_allclose(
        Rotation.from_quat(middle.orientation[1, 0]).as_rotvec(degrees=True), [5, 0, 0], atol=1e-9
    )


def test_a_product_turns_by_the_second_first():
    a, b = TURNS[:3], TURNS[3:]
    both = product(jnp.asarray(a.as_quat()), jnp.asarray(b.as_quat()))
    np.testing.assert_allclose((Rotation.from_quat(np.asarray(both)) * (a * b).inv()).magnitude(), 0.0, atol=1e-7)
