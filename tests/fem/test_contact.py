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

from rfdropo_bayes.fem.contact import contact_error, contact_frame, distance_to_box, gauss_seidel, solve_constraints
from rfdropo_bayes.fem.rigid_body import (
    CORNERS,
    Cube,
    CubeState,
    cube_at,
    free_twist,
    inverse_inertia,
    kinetic_energy,
    moved,
    rotation_matrix,
    solid_gyration_radius,
)

MASS, SIDE, TIME_STEP, GRAVITY = 0.05, 0.035, 0.01, 9.81
UP = np.array([0.0, 1.0, 0.0])
CUBE = Cube(jnp.asarray(MASS), jnp.asarray(SIDE), solid_gyration_radius(SIDE))


class History(NamedTuple):
    state: CubeState
    contact: jax.Array  # (steps, corners, 3) [N s]
    converged: jax.Array


def on_plate(angle, friction, start: CubeState, rayleigh_mass=0.0) -> History:
    """A cube above a plate y = 0 that is tilted by ``angle``: gravity turns instead."""
    gravity = GRAVITY * jnp.array([jnp.sin(angle), -jnp.cos(angle), 0.0])
    frame = contact_frame(jnp.tile(jnp.asarray(UP), (8, 1)))

    def step(state, _):
        arm = (CORNERS * CUBE.side) @ rotation_matrix(state.orientation).T
        rows = jnp.concatenate([frame, jnp.cross(arm[:, None, :], frame)], axis=2).reshape(24, 6)
        twist = free_twist(state, gravity, rayleigh_mass, TIME_STEP)
        gap = state.position[1] + arm[:, 1]
        free = rows @ twist + jnp.zeros((8, 3)).at[:, 0].set(gap / TIME_STEP).ravel()
        compliance = (rows * inverse_inertia(CUBE)) @ rows.T
        found = solve_constraints(compliance, free, 0, friction, jnp.zeros(0))
        state = moved(state, twist + inverse_inertia(CUBE) * (rows.T @ found.contact.ravel()), TIME_STEP)
        return state, (state, found.contact, found.converged)

    return History(*jax.lax.scan(step, start, None, length=50)[1])


rolled = jax.jit(on_plate)
RESTING = cube_at(jnp.array([0.0, SIDE / 2, 0.0]), 0.3, UP)


def test_a_falling_cube_comes_to_rest_where_it_touches():
    """It falls freely at first, and the plate stops it without a rebound."""
    drop = cube_at(jnp.array([0.0, SIDE / 2 + 0.02, 0.0]), 0.0, UP)
    history = rolled(0.0, 0.3, drop)
    count = np.arange(1, 5)
    expected = 0.02 - GRAVITY * TIME_STEP**2 * count * (count + 1) / 2
    np.testing.assert_allclose(history.state.position[:4, 1] - SIDE / 2, expected, atol=1e-12)
    np.testing.assert_allclose(history.state.position[-1], [0.0, SIDE / 2, 0.0], atol=1e-12)
    np.testing.assert_allclose(history.contact[-1].sum(axis=0)[0], MASS * GRAVITY * TIME_STEP, rtol=1e-9)
    assert np.asarray(history.converged).all()


@pytest.mark.parametrize("friction", [0.1, 0.3, 0.7])
def test_it_slides_exactly_when_the_slope_exceeds_the_friction(friction):
    critical = np.arctan(friction)
    below, above = rolled(critical - 0.005, friction, RESTING), rolled(critical + 0.005, friction, RESTING)
    assert np.abs(below.state.velocity[-1]).max() < 1e-5
    assert float(above.state.velocity[-1, 0]) > 1e-3


@pytest.mark.parametrize(("angle", "friction"), [(0.2, 0.1), (0.5, 0.3), (0.8, 0.6), (0.4, 0.0)])
def test_it_slides_with_the_acceleration_of_coulomb_friction(angle, friction):
    history = rolled(angle, friction, RESTING)
    expected = GRAVITY * (np.sin(angle) - friction * np.cos(angle)) * TIME_STEP * np.arange(1, 51)
    np.testing.assert_allclose(history.state.velocity[:, 0], expected, rtol=1e-6)
    np.testing.assert_allclose(history.state.position[:, 1], SIDE / 2, atol=1e-9)
    assert np.abs(history.state.spin).max() < 1e-6


@settings(deadline=None, max_examples=15)
@given(st.floats(0.0, 0.9), st.floats(0.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-20.0, 20.0))
def test_friction_keeps_in_its_cone_and_contacts_add_no_energy(angle, friction, along, across, spin):
    """A cube thrown along the plate, spinning: mechanical energy never grows."""
    start = RESTING._replace(velocity=jnp.array([along, 0.0, across]), spin=jnp.array([0.0, spin, 0.0]))
    history = rolled(angle, friction, start)
    contact, state = np.asarray(history.contact), history.state
    assert contact[..., 0].min() >= 0.0
    assert np.all(np.linalg.norm(contact[..., 1:], axis=-1) <= friction * contact[..., 0] * (1 + 1e-9) + 1e-15)
    height = state.position @ -np.array([np.sin(angle), -np.cos(angle), 0.0])
    energy = np.asarray(jax.vmap(lambda s: kinetic_energy(CUBE, s))(state) + MASS * GRAVITY * height)
    first = float(kinetic_energy(CUBE, start) + MASS * GRAVITY * SIDE / 2 * np.cos(angle))
    assert np.diff(np.concatenate([[first], energy])).max() < 1e-6 * max(first, 1e-3)


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
def test_the_solution_obeys_the_contact_law(seed, friction):
    """Random compliances of cables and contacts together: complementarity, cone, and dissipation."""
    rng = np.random.default_rng(seed)
    cables, contacts = 3, 4
    size = cables + 3 * contacts
    factor = rng.normal(size=(size, 2 * size))
    compliance, free = jnp.asarray(factor @ factor.T), jnp.asarray(rng.normal(size=size))
    found = constraints(compliance, free, cables, friction, jnp.zeros(cables))
    assert bool(found.converged)
    assert bool(found.cables_converged)
    impulse = np.concatenate([found.cable, np.ravel(found.contact)])
    velocity = np.asarray(compliance) @ impulse + np.asarray(free)
    normal, opening = np.asarray(found.contact)[:, 0], velocity[cables::3]
    assert opening.min() > -1e-3
    assert np.abs(normal * opening).max() < 1e-3
    assert velocity[:cables].min() > -1e-6
    assert np.abs(found.cable * velocity[:cables]).max() < 1e-6
    tangent, sliding = np.asarray(found.contact)[:, 1:], velocity[cables:].reshape(-1, 3)[:, 1:]
    assert np.all(np.linalg.norm(tangent, axis=1) <= friction * normal * (1 + 1e-9) + 1e-15)
    assert np.einsum("ci,ci->c", tangent, sliding).max() < 1e-3


constraints = jax.jit(solve_constraints, static_argnums=2)


def test_too_few_sweeps_are_noticed():
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(12, 13))
    compliance, free = jnp.asarray(factor @ factor.T), -jnp.ones(12)
    few, many = (gauss_seidel(compliance, free, jnp.zeros(12), 0.3, sweeps) for sweeps in (1, 2000))
    assert float(contact_error(compliance, free, few, 0.3)) > 1e-2
    assert float(contact_error(compliance, free, many, 0.3)) < 1e-6
