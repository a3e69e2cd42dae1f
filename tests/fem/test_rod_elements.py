"""Rod elements: energy, forces, rates and tangent agree, with all laws; rigid motions strain nothing."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfdropo_bayes import fem  # noqa: F401  (double precision)
from rfdropo_bayes.fem import rod_elements, sections
from rfdropo_bayes.fem.cables import TautCables
from rfdropo_bayes.fem.components import cross, rotation, turned

STATIONS = 4
LENGTH = jnp.full(STATIONS - 1, 0.1)
INNER = sections.Inner(jnp.array(-2.0), jnp.array([[0.3], [0.2]]), jnp.array([[-0.1], [-0.2]]))


def bent(seed: int) -> tuple[jax.Array, jax.Array]:
    """Places and quaternions of a rod that is bent, sheared and twisted a lot; one quaternion has the other sign."""
    rng = np.random.default_rng(seed)
    straight = np.stack([np.zeros(STATIONS), np.zeros(STATIONS), 0.1 * np.arange(STATIONS)])
    quaternion = 0.3 * rng.normal(size=(4, STATIONS)) + np.eye(4)[:, :1]
    quaternion /= np.linalg.norm(quaternion, axis=0)
    quaternion[:, 2] *= -1.0
    return jnp.asarray(straight + 0.02 * rng.normal(size=(3, STATIONS))), jnp.asarray(quaternion)


def lawful(fibre: float) -> sections.Sections:
    """Sections with a coupled bending law."""
    rng = np.random.default_rng(1)
    root = rng.uniform(0.2, 1.0, (3, STATIONS - 1))
    bending = root[:, None] * root[None] + np.eye(3)[:, :, None]
    stretch = rng.uniform(1.0, 2.0, (3, STATIONS - 1))
    return sections.Sections(jnp.asarray(stretch), jnp.asarray(bending), INNER, jnp.asarray(fibre))


def taut() -> TautCables:
    """Cables that hold elements, at random."""
    rng = np.random.default_rng(4)
    force, mixed, moment = rng.normal(size=(3, 3, 3, STATIONS - 1))
    force, moment = force + np.swapaxes(force, 0, 1), moment + np.swapaxes(moment, 0, 1)
    return TautCables(*(jnp.asarray(part) for part in (force, mixed, moment)))


@jax.jit
def compared(position, quaternion, motion, section, held):
    """What should agree, in pairs: forces, rates, tangent by blocks."""

    def strain(change):
        return rod_elements.shape(LENGTH, position + change[:3], turned(quaternion, change[3:]), INNER).strain

    none, elements = jnp.zeros((6, STATIONS)), rod_elements.shape(LENGTH, position, quaternion, INNER)
    leant = partial(rod_elements.leant, elements)
    force = rod_elements.station_forces(elements, leant(sections.answer(section, elements.strain)))
    slope = jax.grad(lambda change: jnp.sum(LENGTH * sections.energy(section, strain(change))))(none)
    rates = rod_elements.strain_rates(elements, motion)
    moved = jax.jvp(strain, (none,), (motion,))[1]
    resultant = leant(sections.linear(section, rates)) + rod_elements.taut_resultant(elements, held, rates)
    stiff = -rod_elements.station_forces(elements, resultant)
    k = rod_elements.tangent(elements, section.stretch, section.bending, held)

    def apply(block, vector):
        return jnp.einsum("ijn,jn->in", block, vector)

    def back(block, vector):
        return jnp.einsum("jin,jn->in", block, vector)

    (ra, aa), (rb, ab) = ((motion[:3, part], motion[3:, part]) for part in (slice(0, -1), slice(1, None)))
    first = jnp.concatenate(
        [apply(k.c, ra - rb) - apply(k.a, aa) - apply(k.b, ab), back(k.a, rb - ra) + apply(k.aa, aa) + back(k.ba, ab)]
    )
    second = jnp.concatenate(
        [apply(k.c, rb - ra) + apply(k.a, aa) + apply(k.b, ab), back(k.b, rb - ra) + apply(k.ba, aa) + apply(k.bb, ab)]
    )
    blocks = jnp.pad(first, ((0, 0), (0, 1))) + jnp.pad(second, ((0, 0), (1, 0)))
    return (force, -slope), (rates, moved), (blocks, stiff)


@pytest.mark.parametrize("fibre", [0.0, 0.4])
def test_forces_rates_and_tangent_follow_from_the_energy(fibre):
    motion = jnp.asarray(np.random.default_rng(2).normal(size=(6, STATIONS)))
    for found, expected in compared(*bent(0), motion, lawful(fibre), taut()):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11 * float(jnp.abs(expected).max()))


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6))
def test_rigid_motions_strain_nothing(motion):
    position, quaternion = bent(3)
    shift, angle = np.array(motion[:3])[:, None], np.array(motion[3:])
    turn = turned(jnp.eye(4)[:, :1], jnp.asarray(0.3 * angle)[:, None])
    matrix = rotation(turn)[..., 0]
    scalar, vector, own = turn[0], turn[1:], quaternion[1:]
    after = jnp.concatenate(
        [
            (scalar * quaternion[0] - jnp.sum(vector * own, axis=0))[None],
            scalar * own + quaternion[0] * vector + cross(vector + 0.0 * own, own),
        ]
    )
    before = rod_elements.shape(LENGTH, position, quaternion, INNER)
    moved = rod_elements.shape(LENGTH, matrix @ position + shift, after, INNER)
    np.testing.assert_allclose(moved.strain, before.strain, atol=1e-12)
    twist = jnp.concatenate(
        [
            jnp.asarray(shift) + cross(jnp.asarray(angle)[:, None] + 0.0 * position, position),
            jnp.asarray(angle)[:, None] + 0.0 * position,
        ]
    )
    np.testing.assert_allclose(rod_elements.strain_rates(before, twist), 0.0, atol=1e-10)


def test_an_element_bent_to_an_arc_is_not_stretched():
    """A circle through both stations, its normals along the sections: the stretch is of fourth order in the angle."""
    stretches, still = [], INNER._replace(arc=jnp.zeros(()))
    for angle in (0.2, 0.4):
        radius = 0.1 / angle
        place = np.array([[0.0, radius * (1 - np.cos(angle))], [0.0, 0.0], [0.0, radius * np.sin(angle)]])
        turn = np.array([[1.0, np.cos(angle / 2)], [0.0, 0.0], [0.0, np.sin(angle / 2)], [0.0, 0.0]])
        stretches.append(
            float(rod_elements.shape(jnp.array([0.1]), jnp.asarray(place), jnp.asarray(turn), still).strain[2, 0])
        )
    assert abs(stretches[1]) < 0.4**4 / 300
    assert stretches[1] / stretches[0] == pytest.approx(16.0, rel=0.05)


def test_a_rotation_without_trigonometry_errs_by_the_fifth_power_of_its_angle():
    """2 atan(a / 2 + a^3 / 24) = a - a^5 / 120 + ..."""
    for angle in (0.1, 0.2):
        quaternion = turned(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, angle, 0.0]))
        error = angle - 2.0 * np.arctan2(float(quaternion[2]), float(quaternion[0]))
        assert error == pytest.approx(angle**5 / 120.0, rel=0.02)
