"""Geometrically exact rod elements between two stations: strains, their rates, forces and tangent.

Strains are Simo and Reissner's in the frame half-way between both sections, (R_m' d / h - e3) and 2 q_v / h with q_v
the vector part of the quaternion from one section to the other (Simo and Vu-Quoc 1986, Comput. Methods Appl. Mech.
Engng 58:79-116). Forces are the exact derivatives of their energy. The tangent neglects the rotation of the forces. The
forces of guided cables rotate with the rod's: the sum of both is the stiffness of taut strings between sections, which
depends on the strains alone (``cables.taut_cables``).

An arc is longer than its chord: the stretch of an element is its chord's plus h^2 / 24 times its squared curvature.
Without this term an axially compressed element would be too stiff in bending.

Arrays have their components first, then stations or elements, see ``components``. A field of 6 components is force and
moment, or velocity and spin, in space.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.fem.cables import TautCables
from rfdropo_bayes.fem.components import (
    Matrix,
    Quaternion,
    Vector,
    cross,
    diagonal,
    dot,
    normalised,
    product,
    rotation,
    skew,
    times,
    transposed,
    transposed_times,
)
from rfdropo_bayes.fem.effects import Scalar

Six = Float[Array, "6 ..."]


class Elements(NamedTuple):
    """Shape of all elements."""

    length: Float[Array, "..."]  # at rest [m]
    frame: Matrix  # half-way between both sections
    way: Vector  # from station to station [m]
    bend: Vector  # vector part of the quaternion from section to section, in space
    share: Float[Array, "..."]  # 1 / (1 + scalar part)
    strain: Six  # shear (2), stretch; curvature (2), twist [1/m]


class Stiffness(NamedTuple):
    """Tangent stiffness of all elements, in blocks of 3 x 3.

    With translations and rotations of both stations it is [[c, -a], [-a', aa]] at the first, [[c, b], [b', bb]] at the
    second and [[-c, a], [-b', ba]] between them, rows of the second.
    """

    c: Matrix
    a: Matrix
    b: Matrix
    aa: Matrix
    bb: Matrix
    ba: Matrix


def shape(length: Float[Array, "..."], position: Vector, orientation: Quaternion) -> Elements:
    """Shape of the elements between neighbouring stations."""
    first, second = orientation[:, :-1], orientation[:, 1:]
    scalar = dot(first, second)
    sign = jnp.where(scalar < 0.0, -1.0, 1.0)
    scalar, second = sign * scalar, sign * second
    # Vector parts of second o conj(first) in space, and of conj(first) o second in the frames.
    across = cross(first[1:], second[1:])
    straight = first[0] * second[1:] - second[0] * first[1:]
    frame = rotation(normalised(first + second))
    way = position[:, 1:] - position[:, :-1]
    stretch = transposed_times(frame, way) / length
    curvature = 2.0 * (straight - across) / length
    longer = length**2 * dot(curvature[:2], curvature[:2]) / 24.0 - 1.0
    strain = jnp.concatenate([stretch[:2], stretch[2:] + longer, curvature])
    return Elements(length, frame, way, straight + across, 1.0 / (1.0 + scalar), strain)


def _less_turn(elements: Elements, vector: Vector) -> Vector:
    """W times a vector: W (da_b - da_a) is h times the change of curvature, in space."""
    return vector - elements.bend * (elements.share * dot(elements.bend, vector))


def _bow(elements: Elements) -> Float[Array, "2 ..."]:
    """Derivative of the stretch by the curvature [m]."""
    return elements.length**2 / 12.0 * elements.strain[3:5]


def strain_rates(elements: Elements, twist: Six) -> Six:
    """Rates of the strains from the velocities and spins of all stations."""
    relative = twist[:, 1:] - twist[:, :-1]
    spin = twist[3:]
    lean = elements.share * elements.bend
    middle = 0.5 * (spin[:, 1:] + spin[:, :-1]) - 0.5 * cross(lean, relative[3:])
    stretching = transposed_times(elements.frame, relative[:3] + cross(elements.way, middle))
    bending = transposed_times(elements.frame, _less_turn(elements, relative[3:]))
    longer = dot(_bow(elements), bending[:2])
    return jnp.concatenate([stretching[:2], stretching[2:] + longer, bending]) / elements.length


def station_forces(elements: Elements, resultant: Six) -> Six:
    """Forces and moments on all stations from the sections' forces and moments in the elements' frames."""
    force = times(elements.frame, resultant[:3])
    bowed = jnp.concatenate([resultant[3:5] + _bow(elements) * resultant[2], resultant[5:]])
    moment = _less_turn(elements, times(elements.frame, bowed))
    lever = cross(elements.way, force)
    half, lean = 0.5 * lever, 0.5 * cross(elements.share * elements.bend, lever)
    first = jnp.concatenate([force, moment + half - lean])
    second = jnp.concatenate([-force, half + lean - moment])
    none = jnp.zeros_like(first[:, :1])
    return jnp.concatenate([first, none], axis=1) + jnp.concatenate([none, second], axis=1)


def taut_resultant(elements: Elements, taut: TautCables, rates: Six) -> Six:
    """Forces and moments of the sections in the elements' frames, of cables that hold them against strain rates."""
    stretching, bending = (elements.length * times(elements.frame, part) for part in (rates[:3], rates[3:]))
    force = times(taut.force, stretching) + times(taut.mixed, bending)
    moment = transposed_times(taut.mixed, stretching) + times(taut.moment, bending)
    return jnp.concatenate([transposed_times(elements.frame, force), transposed_times(elements.frame, moment)])


def turning(elements: Elements, stiffness: Stiffness, resultant: Six, pull: Six, share: Scalar) -> Stiffness:
    """The stiffness with a share of the geometric term: forces of sections and of cables turn with the elements. The
    term is of leading order and symmetric.

    Args:
        elements: shape of all elements.
        stiffness: stiffness of the elements without this term.
        resultant: forces and moments of the sections in the elements' frames.
        pull: forces and moments of the cables in space.
        share: share of this term, 1 for the whole.
    """
    force = 0.5 * share * (pull[:3] + times(elements.frame, resultant[:3]))
    moment = 0.5 * share * (pull[3:] + times(elements.frame, resultant[3:]))
    lean = force[:, None] * elements.way[None]
    swing = 0.25 * (lean + transposed(lean)) - 0.5 * diagonal(jnp.stack([dot(force, elements.way)] * 3))
    tilt, roll = skew(force), skew(moment)
    c, a, b, aa, bb, ba = stiffness
    return Stiffness(c, a - tilt, b - tilt, aa + swing, bb + swing, ba + swing - roll)


def tangent(elements: Elements, stretch: Vector, bending: Vector | Matrix, taut: TautCables | None = None) -> Stiffness:
    """Stiffness of the elements, from the stiffness of the sections, a diagonal and a diagonal or a matrix, and of the
    cables that hold them."""
    frame, way = elements.frame, elements.way
    c = product(frame * (stretch / elements.length)[None], transposed(frame))
    turned = frame * bending[None] if bending.ndim == stretch.ndim else product(frame, bending)
    bent = product(turned / elements.length, transposed(frame))
    if taut is not None:
        c, bent = c + taut.force, bent + taut.moment
    for _ in range(2):  # W from the left, then, as the matrix is symmetric, from the right
        row = transposed_times(bent, elements.bend)
        bent = transposed(bent - elements.bend[:, None] * (elements.share * row)[None])
    lean = elements.share * elements.bend
    turn, fold = 0.5 * skew(way), 0.5 * (lean[:, None] * way[None] - diagonal(jnp.stack([dot(lean, way)] * 3)))
    bow = _less_turn(elements, times(frame[:, :2], _bow(elements)))
    fold = fold - frame[:, 2][:, None] * bow[None]
    lever_a, lever_b = turn + fold, turn - fold
    a, b = product(c, lever_a), product(c, lever_b)
    back_a, back_b = transposed(lever_a), transposed(lever_b)
    if taut is None:
        return Stiffness(c, a, b, product(back_a, a) + bent, product(back_b, b) + bent, product(back_b, a) - bent)
    mixed = taut.mixed - (elements.share * times(taut.mixed, elements.bend))[:, None] * elements.bend[None]
    more = transposed(mixed)
    turning_a, turning_b = bent - product(more, lever_a), bent + product(more, lever_b)
    a, b = a - mixed, b + mixed
    return Stiffness(
        c, a, b, product(back_a, a) + turning_a, product(back_b, b) + turning_b,
        product(back_b, a) + product(more, lever_a) - bent,
    )  # fmt: skip
