"""A cube on a plate: rest, slope, friction cone and energy in closed form; the contact law on problems of its own."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rfdropo_bayes.fem.constraints import CABLE_SOFTNESS, NORMAL_SOFTNESS, TANGENT_SOFTNESS, Contacts, Slips
from rfdropo_bayes.fem.pushing import FITTED, contact_frame, distance_to_box, mesh_spheres
from rfdropo_bayes.fem.rigid_body import (
    CORNERS,
    Cube,
    CubeState,
    cube_at,
    free_twist,
    inverse_inertia,
    moved,
    rotation_matrix,
    solid_gyration_radius,
)

from .constraint_solution import solve_constraints

MASS, SIDE, TIME_STEP, GRAVITY = 0.05, 0.035, 0.01, 9.81
UP = np.array([0.0, 1.0, 0.0])
CUBE = Cube(jnp.asarray(MASS), jnp.asarray(SIDE), solid_gyration_radius(SIDE), jnp.asarray(0.3))


def kinetic_energy(state: CubeState):
    """Energy of the cube's motion [J]."""
    return 0.5 * CUBE.mass * (jnp.sum(state.velocity**2) + CUBE.gyration_radius**2 * jnp.sum(state.spin**2))


def softness(rows) -> float:
    """Mean entry of a contact of the cube at rest on the diagonal of W, over its three rows."""
    return float(np.mean(np.diag((rows * inverse_inertia(CUBE)) @ rows.T).reshape(-1, 3), axis=1)[0])


class History(NamedTuple):
    state: CubeState
    contact: jax.Array  # (steps, corners, 3) [N s]
    converged: jax.Array


def on_plate(angle, friction, start: CubeState, rayleigh_mass=0.0) -> History:
    """A cube above a plate y = 0 that is tilted by ``angle``: gravity turns instead."""
    gravity = GRAVITY * jnp.array([jnp.sin(angle), -jnp.cos(angle), 0.0])
    frame = contact_frame(jnp.tile(jnp.asarray(UP), (8, 1)))

    def step(carry, _):
        state, before = carry
        arm = (CORNERS * CUBE.side) @ rotation_matrix(state.orientation).T
        rows = jnp.concatenate([frame, jnp.cross(arm[:, None, :], frame)], axis=2).reshape(24, 6)
        twist = free_twist(state, gravity, rayleigh_mass, TIME_STEP)
        gap = state.position[1] + arm[:, 1]
        compliance = (rows * inverse_inertia(CUBE)) @ rows.T
        contacts = Contacts(gap / TIME_STEP, friction, before)
        found = solve_constraints(compliance, rows @ twist, jnp.zeros(0), TIME_STEP, contacts=contacts)
        state = moved(state, twist + inverse_inertia(CUBE) * (rows.T @ found.contact.ravel()), TIME_STEP)
        return (state, found.contact), (state, found.contact, found.converged)

    return History(*jax.lax.scan(step, (start, jnp.zeros((8, 3))), None, length=50)[1])


rolled = jax.jit(on_plate)
RESTING = cube_at(jnp.array([0.0, SIDE / 2, 0.0]), 0.3, UP)


def test_a_falling_cube_comes_to_rest_where_it_touches():
    """It falls freely at first, the plate stops it without a rebound, and gives way as it says: R g h."""
    drop = cube_at(jnp.array([0.0, SIDE / 2 + 0.02, 0.0]), 0.0, UP)
    history = rolled(0.0, 0.3, drop)
    count = np.arange(1, 5)
    expected = 0.02 - GRAVITY * TIME_STEP**2 * count * (count + 1) / 2
    np.testing.assert_allclose(history.state.position[:4, 1] - SIDE / 2, expected, atol=1e-12)
    impulse = MASS * GRAVITY * TIME_STEP
    sunk = NORMAL_SOFTNESS * softness(corner_rows()) * impulse / 4 * TIME_STEP
    np.testing.assert_allclose(history.state.position[-1], [0.0, SIDE / 2 - sunk, 0.0], atol=1e-9)
    np.testing.assert_allclose(history.contact[-1].sum(axis=0)[0], impulse, rtol=1e-9)
    assert np.abs(history.state.velocity[-1]).max() < 1e-9
    assert sunk < 3e-5
    assert np.asarray(history.converged).all()


def corner_rows():
    """Rows of the corners that a cube at rest stands on, by its twist."""
    arm = jnp.asarray(CORNERS[CORNERS[:, 1] < 0.0] * SIDE)
    frame = contact_frame(jnp.tile(jnp.asarray(UP), (4, 1)))
    return jnp.concatenate([frame, jnp.cross(arm[:, None, :], frame)], axis=2).reshape(12, 6)


@pytest.mark.parametrize("friction", [0.1, 0.3, 0.7])
def test_it_slides_exactly_when_the_slope_exceeds_the_friction(friction):
    """Below the angle of friction it heels over as far as the corners give way, and stays; above it slides away."""
    critical = np.arctan(friction)
    below, above = rolled(critical - 0.005, friction, RESTING), rolled(critical + 0.005, friction, RESTING)
    assert np.abs(below.state.velocity[-1]).max() < 1e-9
    assert np.abs(below.state.position[-1] - RESTING.position).max() < 3e-5
    assert float(above.state.velocity[-1, 0]) > 1e-2


@pytest.mark.parametrize(("angle", "friction"), [(0.2, 0.1), (0.5, 0.3), (0.8, 0.6), (0.4, 0.0)])
def test_it_slides_with_the_acceleration_of_coulomb_friction(angle, friction):
    """The acceleration is that of the closed form once the start is over; sliding lifts the cube by h mu v."""
    history = rolled(angle, friction, RESTING)
    speed = np.asarray(history.state.velocity)[:, 0]
    expected = GRAVITY * (np.sin(angle) - friction * np.cos(angle))
    np.testing.assert_allclose(np.diff(speed)[25:] / TIME_STEP, expected, rtol=1e-6)
    np.testing.assert_allclose(speed[-1], 50 * TIME_STEP * expected, rtol=0.02)
    lifted = TIME_STEP * friction * speed
    np.testing.assert_allclose(history.state.position[25:, 1] - SIDE / 2, lifted[25:], atol=5e-5)
    assert np.abs(history.state.spin[25:]).max() < 1e-5


@settings(deadline=None, max_examples=15)
@given(st.floats(0.0, 0.9), st.floats(0.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-20.0, 20.0))
def test_friction_keeps_in_its_cone_and_contacts_add_no_energy(angle, friction, along, across, spin):
    """A cube thrown along the plate, spinning: mechanical energy never grows by more than the contacts hold, as soft as
    they are."""
    start = RESTING._replace(velocity=jnp.array([along, 0.0, across]), spin=jnp.array([0.0, spin, 0.0]))
    history = rolled(angle, friction, start)
    contact, state = np.asarray(history.contact), history.state
    assert contact[..., 0].min() > -1e-12
    assert np.all(np.linalg.norm(contact[..., 1:], axis=-1) <= friction * contact[..., 0] * (1 + 1e-9) + 1e-15)
    height = state.position @ -np.array([np.sin(angle), -np.cos(angle), 0.0])
    energy = np.asarray(jax.vmap(kinetic_energy)(state) + MASS * GRAVITY * height)
    first = float(kinetic_energy(start) + MASS * GRAVITY * SIDE / 2 * np.cos(angle))
    held = NORMAL_SOFTNESS * softness(corner_rows()) * (MASS * GRAVITY * TIME_STEP) ** 2
    assert np.diff(np.concatenate([[first], energy])).max() < 1e-6 * max(first, 1e-3) + held


@pytest.mark.slow
def test_drag_limits_the_speed_of_a_fall():
    """Rayleigh damping by mass alone: m g = a m v at the end."""
    start = cube_at(jnp.array([0.0, 1e3, 0.0]), 0.0, UP)
    history = rolled(0.0, 0.3, start, rayleigh_mass=50.0)
    np.testing.assert_allclose(history.state.velocity[-1], [0.0, -GRAVITY / 50.0, 0.0], rtol=1e-6, atol=1e-12)


def test_a_turning_cube_turns_about_its_axis_at_its_speed():
    spin = jnp.array([0.3, -0.4, 1.2])
    state = cube_at(jnp.zeros(3), 0.0, UP)._replace(spin=spin)
    turned = jax.jit(moved)
    for _ in range(10):
        state = turned(state, jnp.concatenate([jnp.zeros(3), spin]), TIME_STEP)
    np.testing.assert_allclose(
        rotation_matrix(state.orientation), Rotation.from_rotvec(0.1 * np.asarray(spin)).as_matrix(), atol=1e-12
    )


def test_distances_to_a_cube_by_region():
    turn = rotation_matrix(cube_at(jnp.zeros(3), 0.4, UP).orientation)
    centre = jnp.array([0.1, -0.2, 0.3])
    local = jnp.array([[1.0, 0.2, 0.1], [0.8, 0.9, 0.1], [0.6, 0.7, -1.1], [0.45, 0.1, 0.0]])
    distance, normal = jax.jit(distance_to_box)(local @ turn.T + centre, centre, turn, 1.0)
    np.testing.assert_allclose(distance, [0.5, 0.5, np.sqrt(0.01 + 0.04 + 0.36), -0.05], atol=1e-12)
    toward = np.array([[1, 0, 0], [0.6, 0.8, 0], np.array([0.1, 0.2, -0.6]) / np.sqrt(0.41), [1, 0, 0]])
    np.testing.assert_allclose(normal @ turn, toward, atol=1e-12)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6), st.floats(0.0, 1.0))
def test_the_solution_obeys_every_law_and_is_the_least_of_its_function(seed, friction):
    """Random compliances of cables, slip and contacts together: each constraint's law, and none better nearby."""
    rng = np.random.default_rng(seed)
    cables, runs, contacts = 3, 2, 4
    size = cables + runs + 3 * contacts
    factor = rng.normal(size=(size, 2 * size))
    compliance, free = factor @ factor.T, rng.normal(size=size)
    before = rng.normal(size=(contacts, 3))
    opening, limit, mobilised = rng.normal(size=contacts), rng.uniform(0.0, 0.1, runs), rng.uniform(-1.0, 1.0, runs)
    slips, touching = (
        Slips(jnp.asarray(limit), jnp.asarray(mobilised)),
        Contacts(jnp.asarray(opening), friction, jnp.asarray(before)),
    )
    found = jax.jit(solve_constraints)(
        jnp.asarray(compliance), jnp.asarray(free), jnp.zeros(cables), 0.01, slips, touching
    )
    assert bool(found.converged)
    impulse = np.asarray(found.all)
    velocity = compliance @ impulse + free
    pull = np.asarray(found.cable)
    assert pull.min() >= 0.0
    assert np.abs(pull * (velocity[:cables] + CABLE_SOFTNESS * np.diag(compliance)[:cables] * pull)).max() < 1e-9
    share = np.asarray(found.share)
    np.testing.assert_allclose(share, np.clip(mobilised - 0.01 / 1e-4 * velocity[3:5], -1.0, 1.0), atol=1e-6)
    np.testing.assert_allclose(found.slip, limit * share, atol=1e-9)
    normal, tangent = np.asarray(found.contact)[:, 0], np.asarray(found.contact)[:, 1:]
    moving = velocity[5:].reshape(-1, 3)
    mean = np.mean(np.diag(compliance)[5:].reshape(-1, 3), axis=1)
    assert normal.min() > -1e-12
    assert np.all(np.linalg.norm(tangent, axis=1) <= friction * normal * (1 + 1e-9) + 1e-12)
    # Friction takes energy from what slides, the stretch of its spring included; what touches closes its gap, or slides
    # and is lifted; what is open exerts nothing.
    moving[:, 1:] -= (TANGENT_SOFTNESS * mean)[:, None] * before[:, 1:]
    assert np.einsum("ci,ci->c", tangent, moving[:, 1:]).max() < 1e-9
    lifted = moving[:, 0] + opening - friction * np.linalg.norm(moving[:, 1:], axis=1)
    assert np.all(normal[lifted > 1e-9] < 1e-9)
    soft = NORMAL_SOFTNESS * mean * normal
    assert np.all(
        np.abs(moving[:, 0] + opening + soft)[normal > 1e-9]
        <= friction * 1.01 * np.linalg.norm(moving[:, 1:], axis=1)[normal > 1e-9]
        + friction**2 * TANGENT_SOFTNESS * (mean * normal)[normal > 1e-9]
        + 1e-9
    )


def test_spheres_of_a_mesh_follow_affine_motions():
    """Also at an end whose plane holds more nodes than a sphere follows: they say nothing of the motion across it."""
    rng = np.random.default_rng(11)
    rest = rng.uniform([-0.01, -0.01, 0.0], [0.01, 0.01, 0.2], (300, 3))
    rest[: 2 * FITTED, 2] = 0.0
    turn, shift = np.eye(3) + 0.3 * rng.normal(size=(3, 3)), rng.normal(size=3)
    spheres = mesh_spheres(rest, np.array([0.0, 0.2]), np.array([0.012, 0.005]))
    moved_nodes = (rest @ turn.T + shift)[spheres.node]
    centre = np.einsum("sk,ski->si", spheres.centre, rest[spheres.node])
    np.testing.assert_allclose(centre[:, :2], 0.0, atol=1e-12)
    assert centre[0, 2] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(
        np.einsum("sk,ski->si", spheres.centre, moved_nodes), centre @ turn.T + shift, atol=1e-12
    )
    deformation = np.einsum("ski,skj->sij", moved_nodes, spheres.gradient)
    np.testing.assert_allclose(deformation, np.broadcast_to(turn, deformation.shape), atol=1e-9)
