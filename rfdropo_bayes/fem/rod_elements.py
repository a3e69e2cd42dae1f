"""Geometrically exact rod elements between two stations: strains, their rates, forces and tangent.

Strains are Simo and Reissner's in the frame half-way between both sections, (R_m' d / h - e3) and 2 q_v / h with q_v
the vector part of the quaternion from one section to the other (Simo and Vu-Quoc 1986, Comput. Methods Appl. Mech.
Engng 58:79-116). Forces are the exact derivatives of their energy. The tangent neglects the rotation of the forces. The
forces of guided cables rotate with the rod's: the sum of both is the stiffness of taut strings between sections, which
depends on the strains alone (``cables.taut_cables``).

An element bends within itself as the forces at its ends let it, up to the second order in its length. Its flexibility
in shear is 1 / k G A + h^2 / 12 E I: the second part is bending to the shape of an S. Its stretch is

    Gamma_3 + (h^2 / 24) (1 + a e) K^2 + sum over x and y of (c + c' e) Gamma_i^2,   e = Gamma_3 / (1 + 4 Gamma_3^2)

with Gamma of the chord, K the curvature, a = 1 - E A / k G A, f = k G A h^2 / 12 E I, g = k G A / E A, and
c = ((1 - g) f + 3/5 f^2) / (1 + f)^2, c' = (1 - g) a f / 2 (1 + f)^2. An arc and an S are longer than their chords. The
terms follow from the energy for a constant force in space, of which the rotation within the element is a minimum.
Without them a pressed element is too stiff, and the error of a body is several times larger. The bound on e keeps steps
of bodies whose cables press them to a fraction of their length.

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
from rfdropo_bayes.fem.sections import Inner

Six = Float[Array, "6 ..."]


class Elements(NamedTuple):
    """Shape of all elements."""

    length: Float[Array, "..."]  # at rest [m]
    frame: Matrix  # half-way between both sections
    way: Vector  # from station to station [m]
    bend: Vector  # vector part of the quaternion from section to section, in space
    share: Float[Array, "..."]  # 1 / (1 + scalar part)
    strain: Six  # shear (2), stretch; curvature (2), twist [1/m]
    lean: Vector  # derivative of the stretch by shear (2) and by the chord's stretch
    bow: Float[Array, "2 ..."]  # and by the curvature [m], over the last


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


def shape(length: Float[Array, "..."], position: Vector, orientation: Quaternion, inner: Inner) -> Elements:
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
    chord = transposed_times(frame, way) / length
    shear, along, curvature = chord[:2], chord[2] - 1.0, 2.0 * (straight - across) / length
    less = 1.0 / (1.0 + 4.0 * along**2)
    bounded, rise = less * along, (2.0 * less - 1.0) * less
    arc, wide = length**2 * dot(curvature[:2], curvature[:2]) / 24.0, 1.0 + inner.arc * bounded
    slope = (inner.shear + inner.pressed * bounded) * shear
    stretch = along + arc * wide + dot(slope, shear)
    steep = 1.0 + rise * (inner.arc * arc + dot(inner.pressed * shear, shear))
    strain = jnp.concatenate([shear, stretch[None], curvature])
    lean, bow = jnp.concatenate([2.0 * slope, steep[None]]), length**2 / 12.0 * wide / steep * curvature[:2]
    return Elements(length, frame, way, straight + across, 1.0 / (1.0 + scalar), strain, lean, bow)


def _less_turn(elements: Elements, vector: Vector) -> Vector:
    """W times a vector: W (da_b - da_a) is h times the change of curvature, in space."""
    return vector - elements.bend * (elements.share * dot(elements.bend, vector))


def strain_rates(elements: Elements, twist: Six) -> Six:
    """Rates of the strains from the velocities and spins of all stations."""
    relative = twist[:, 1:] - twist[:, :-1]
    spin = twist[3:]
    lean = elements.share * elements.bend
    middle = 0.5 * (spin[:, 1:] + spin[:, :-1]) - 0.5 * cross(lean, relative[3:])
    stretching = transposed_times(elements.frame, relative[:3] + cross(elements.way, middle))
    bending = transposed_times(elements.frame, _less_turn(elements, relative[3:]))
    along = stretching[2] + dot(elements.bow, bending[:2])
    longer = dot(elements.lean, jnp.concatenate([stretching[:2], along[None]]))
    return jnp.concatenate([stretching[:2], longer[None], bending]) / elements.length


def leant(elements: Elements, resultant: Six) -> Six:
    """Forces and moments between the stations in the elements' frames, from the sections' own."""
    force = elements.lean * resultant[2]
    return jnp.concatenate([resultant[:2] + force[:2], force[2:], resultant[3:]])


def station_forces(elements: Elements, resultant: Six) -> Six:
    """Forces and moments on all stations from those between them, see ``leant``."""
    force = times(elements.frame, resultant[:3])
    bowed = jnp.concatenate([resultant[3:5] + elements.bow * resultant[2], resultant[5:]])
    moment = _less_turn(elements, times(elements.frame, bowed))
    lever = cross(elements.way, force)
    half, lean = 0.5 * lever, 0.5 * cross(elements.share * elements.bend, lever)
    first = jnp.concatenate([force, moment + half - lean])
    second = jnp.concatenate([-force, half + lean - moment])
    none = jnp.zeros_like(first[:, :1])
    return jnp.concatenate([first, none], axis=1) + jnp.concatenate([none, second], axis=1)


def taut_resultant(elements: Elements, taut: TautCables, rates: Six) -> Six:
    """Forces and moments between the stations in the elements' frames, of cables that resist strain rates."""
    along = (rates[2] - dot(elements.lean[:2], rates[:2])) / elements.lean[2]
    rates = jnp.concatenate([rates[:2], along[None], rates[3:]])
    stretching, bending = (elements.length * times(elements.frame, part) for part in (rates[:3], rates[3:]))
    force = times(taut.force, stretching) + times(taut.mixed, bending)
    moment = transposed_times(taut.mixed, stretching) + times(taut.moment, bending)
    return jnp.concatenate([transposed_times(elements.frame, force), transposed_times(elements.frame, moment)])


def turning(elements: Elements, stiffness: Stiffness, resultant: Six, pull: Six) -> Stiffness:
    """The stiffness with the geometric term: forces of sections and of cables turn with the elements. The term is of
    leading order and symmetric.

    Args:
        elements: shape of all elements.
        stiffness: stiffness of the elements without this term.
        resultant: forces and moments between the stations in the elements' frames.
        pull: forces and moments of the cables in space.
    """
    force = 0.5 * (pull[:3] + times(elements.frame, resultant[:3]))
    moment = 0.5 * (pull[3:] + times(elements.frame, resultant[3:]))
    lean = force[:, None] * elements.way[None]
    swing = 0.25 * (lean + transposed(lean)) - 0.5 * diagonal(jnp.stack([dot(force, elements.way)] * 3))
    tilt, roll = skew(force), skew(moment)
    c, a, b, aa, bb, ba = stiffness
    return Stiffness(c, a - tilt, b - tilt, aa + swing, bb + swing, ba + swing - roll)


def tangent(elements: Elements, stretch: Vector, bending: Vector | Matrix, taut: TautCables | None = None) -> Stiffness:
    """Stiffness of the elements, from the stiffness of the sections, a diagonal and a diagonal or a matrix, and of the
    cables that hold them."""
    frame, way = elements.frame, elements.way
    axes = jnp.concatenate([frame[:, :2], times(frame, elements.lean)[:, None]], axis=1)
    c = product(axes * (stretch / elements.length)[None], transposed(axes))
    turned = frame * bending[None] if bending.ndim == stretch.ndim else product(frame, bending)
    bent = product(turned / elements.length, transposed(frame))
    if taut is not None:
        c, bent = c + taut.force, bent + taut.moment
    for _ in range(2):  # W from the left, then, as the matrix is symmetric, from the right
        row = transposed_times(bent, elements.bend)
        bent = transposed(bent - elements.bend[:, None] * (elements.share * row)[None])
    lean = elements.share * elements.bend
    turn, fold = 0.5 * skew(way), 0.5 * (lean[:, None] * way[None] - diagonal(jnp.stack([dot(lean, way)] * 3)))
    bow = _less_turn(elements, times(frame[:, :2], elements.bow))
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
