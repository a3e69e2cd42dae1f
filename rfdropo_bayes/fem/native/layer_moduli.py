"""Stiffness and mass of layers in closed form, per elastic modulus and per density.

The virtual hexahedra of a layer are boxes. Reflections split the 24 degrees of freedom of a box into eight families of
three: family p (one bit for each axis) moves component i by the monomial that is odd where p is, with bit i flipped.
Strains of different families are orthogonal. The incompatible modes live in the three families of one odd axis, where
they take up all of the shear, and the enhanced stretches in those of two; in both they leave 2 lambda mu / (lambda +
2 mu) of lambda. So the stiffness is linear in three moduli, and no element has to be integrated.

With ``fem.hexahedron.sectional_elasticity`` these are E, mu and E nu / (1 - nu^2): along z there is E and nothing else,
across there are mu and 2 lambda mu / (lambda + 2 mu), which is the third; and where one of two lateral strains is
condensed, or stands alone, E or the third with mu is left of the other.
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.fem.hexahedron import CORNERS
from rfdropo_bayes.fem.layered import LayeredBody, box_maps, free_twist, virtual_box

_AXES = np.eye(3, dtype=int)


def _sectional_stretch(odd: np.ndarray, stretch: np.ndarray, share: np.ndarray) -> Float[np.ndarray, "3 boxes 3 3"]:
    """Energy of the stretches of a family of a sectional body."""
    energy = np.zeros((3, len(stretch), 3, 3))
    pull = share * stretch[:, :, None] * stretch[:, None, :]
    energy[0, :, 2, 2] = pull[:, 2, 2]
    for i in range(2):
        if odd.sum() == 1 and odd[1 - i]:  # the other lateral strain is condensed
            energy[0, :, i, i] = pull[:, i, i]
        else:
            energy[1, :, i, i], energy[2, :, i, i] = 2.0 * pull[:, i, i], pull[:, i, i]
    energy[2, :, 0, 1], energy[2, :, 1, 0] = pull[:, 0, 1], pull[:, 1, 0]
    return energy


def _family(odd: np.ndarray, half: Float[np.ndarray, "boxes 3"], sectional: bool) -> Float[np.ndarray, "3 boxes 3 3"]:
    """Energy of a family's three amplitudes per modulus."""
    volume = 8.0 * np.prod(half, axis=1)[:, None, None]
    stretch = (1 - odd) / half
    energy = np.zeros((3, len(half), 3, 3))
    condensed = 2 if odd.sum() in (1, 2) else 0
    share = volume / 3.0 ** odd.sum()
    if sectional:
        energy = _sectional_stretch(odd, stretch, share)
    else:
        energy[condensed] = share * stretch[:, :, None] * stretch[:, None, :]
        energy[1] = share * 2.0 * stretch[:, :, None] ** 2 * np.eye(3)
    if odd.sum() != 1:
        for i, j in itertools.combinations(range(3), 2):
            shear = odd[j] * _AXES[i] / half[:, j : j + 1] + odd[i] * _AXES[j] / half[:, i : i + 1]
            degree = np.sum(odd ^ _AXES[i] ^ _AXES[j])
            energy[1] += volume / 3.0**degree * shear[:, :, None] * shear[:, None, :]
    return energy


def box_moduli(half: Float[np.ndarray, "boxes 3"], sectional: bool = False) -> Float[np.ndarray, "3 boxes 8 3 8 3"]:
    """Stiffness [m] of boxes of half widths ``half`` [m] per lambda, mu and 2 lambda mu / (lambda + 2 mu), or of
    sectional ones per E, mu and E nu / (1 - nu^2); twelve modes condensed; nodes as in
    ``fem.hexahedron``."""
    stiffness = np.zeros((3, len(half), 8, 3, 8, 3))
    for family in itertools.product((0, 1), repeat=3):
        odd = np.array(family)
        amplitude = np.stack([np.prod(CORNERS ** (odd ^ axis), axis=1) for axis in _AXES], axis=1) / 8.0
        stiffness += np.einsum("ai,pxij,bj->pxaibj", amplitude, _family(odd, half, sectional), amplitude)
    return stiffness


def box_mass(half: Float[np.ndarray, "boxes 3"]) -> Float[np.ndarray, "boxes 8 8"]:
    """Consistent mass of boxes per density [m3]."""
    line = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6.0
    return 8.0 * np.prod(half, axis=1)[:, None, None] * np.kron(line, np.kron(line, line))


def _cells(body: LayeredBody, box: Float[np.ndarray, "layers 2"]) -> Float[np.ndarray, "layers 3"]:
    """Half widths of the equal hexahedra that a layer's virtual box is cut into."""
    return np.column_stack([box / (body.nodes_across - 1), np.diff(body.station) / 2.0])


def layer_moduli(body: LayeredBody) -> Float[np.ndarray, "3 layers nodes2 3 nodes2 3"]:
    """Stiffness [m] of every layer per modulus as in ``box_moduli``: what ``fem.layered.layer_stiffness``
    integrates."""
    box, factor = virtual_box(body.axial_area, body.bending_moment_area)
    maps = box_maps(body, box)
    boxes = box_moduli(_cells(body, box), body.sectional) * factor[:, None, None, None, None]
    stiffness = np.einsum("lcan,plaibj,lcbm->plnimj", maps, boxes, maps, optimize=True)
    twist = free_twist(body).reshape(len(box), -1, 3)
    reaction = np.einsum("lnimj,lmj->lni", stiffness[1], twist)
    actual = np.einsum("lni,lni->l", reaction, twist)
    change = (body.torsion_constant / np.diff(body.station) - actual) / actual**2
    stiffness[1] += np.einsum("l,lni,lmj->lnimj", change, reaction, reaction)
    return stiffness


def layer_volume(body: LayeredBody) -> Float[np.ndarray, "layers nodes2 nodes2"]:
    """Consistent mass of every layer per density [m3]: what ``fem.layered.layer_mass`` integrates."""
    box, factor = virtual_box(body.mass_area, body.mass_moment_area)
    maps = box_maps(body, box)
    boxes = box_mass(_cells(body, box)) * factor[:, None, None]
    return np.einsum("lcan,lab,lcbm->lnm", maps, boxes, maps, optimize=True)
