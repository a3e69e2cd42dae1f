"""Spheres of a body that pushes a cube, in SIMD lanes: their positions, and the motion of contacts on them with the
body.

A sphere of a mesh follows the affine motion of nodes around it; a sphere of a rod is bound to sections. An entry of a
sphere is a triple of the body's velocities. Entries of a rod come in pairs, translation and spin of a section.
The scene's ``gradient`` is None for a rod, and ``arm`` is None for a mesh; the compiled kernel omits parts that are
None.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.fields import weighted
from rfdropo_bayes.fem.native.rod_tables import FRAME, SIZE
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load3, store
from rfdropo_bayes.fem.native.vectors import added, cross, dot, plus, put, scaled


@kernel
def _on_sections(scene, touch, sphere, position, token):
    """Centre of a sphere of a rod; keeps its arms in space."""
    zero = fill(0.0, position, token)
    centre = zero, zero, zero
    for k in range(scene.first[sphere], scene.within[sphere], 2):
        frame, lever = FRAME * (scene.place[k] // SIZE), (zero, zero, zero)
        for i in range(3):
            lever = added(load3(position, frame + 3 + 3 * i, token), scene.arm[3 * k + i], lever)
        put(touch.lever, 3 * k, lever)
        centre = plus(centre, added(load3(position, frame, token), scene.centre[k], lever))
    return centre


@kernel
def centre_of(scene, gradient, arm, touch, sphere, position, token):
    """Centre of a sphere; ``position``: of nodes, or frames of stations."""
    zero = fill(0.0, position, token)
    centre = zero, zero, zero
    if gradient is not None:
        centre = weighted(scene.place, scene.centre, scene.first[sphere], scene.within[sphere], position, token)
    if arm is not None:
        centre = _on_sections(scene, touch, sphere, position, token)
    return centre


@kernel
def centre_velocity(scene, gradient, arm, touch, sphere, velocity, token):
    """Velocity of a sphere's centre."""
    first, last, zero = scene.first[sphere], scene.within[sphere], fill(0.0, velocity, token)
    total = zero, zero, zero
    if gradient is not None:
        total = weighted(scene.place, scene.centre, first, last, velocity, token)
    if arm is not None:
        for k in range(first, last, 2):
            total = added(load3(velocity, scene.place[k], token), scene.centre[k], total)
            total = plus(total, cross(load3(velocity, scene.place[k + 1], token), load3(touch.lever, 3 * k, token)))
    return total


@kernel
def _gradient_offset(scene, touch, slot, sphere, position, token):
    """Contact point of the sphere, from its centre in the body at rest: -radius F^-1 n with the deformation gradient
    F.
    """
    zero, one = fill(0.0, touch.cube, token), fill(1.0, touch.cube, token)
    a, b, c, d, e, f, g, h, i = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for k in range(scene.first[sphere], scene.first[sphere + 1]):
        x, y, z = load3(position, scene.place[k], token)
        u, v, w = scene.gradient[3 * k], scene.gradient[3 * k + 1], scene.gradient[3 * k + 2]
        a, b, c = fma(x, u, a), fma(x, v, b), fma(x, w, c)
        d, e, f = fma(y, u, d), fma(y, v, e), fma(y, w, f)
        g, h, i = fma(z, u, g), fma(z, v, h), fma(z, w, i)
    first = fnma(f, h, e * i), fnma(d, i, f * g), fnma(e, g, d * h)
    second = fnma(b, i, c * h), fnma(c, g, a * i), fnma(a, h, b * g)
    third = fnma(c, e, b * f), fnma(a, f, c * d), fnma(b, d, a * e)
    scale = (-scene.radius[sphere] * one) / dot((a, b, c), first)
    normal = load3(touch.frame, 9 * slot, token)
    for i in range(3):
        store(touch.offset, 3 * slot + i, scale * dot((first[i], second[i], third[i]), normal))


@kernel
def place_offset(scene, gradient, arm, touch, slot, sphere, position, token):
    """Contact point of a candidate's sphere, from its centre: in the body at rest for a mesh, in space for a rod."""
    if gradient is not None:
        _gradient_offset(scene, touch, slot, sphere, position, token)
    if arm is not None:
        back = fill(-scene.radius[sphere], touch.cube, token)
        put(touch.offset, 3 * slot, scaled(load3(touch.frame, 9 * slot, token), back))


@kernel
def _mesh_entry(scene, offset, way, centre, k, r):
    """Entry of a node."""
    if r == 0:
        return scaled(way, centre)
    x, y, z = offset
    around = fma(x, scene.gradient[3 * k], fma(y, scene.gradient[3 * k + 1], z * scene.gradient[3 * k + 2]))
    return scaled(way, around + centre)


@kernel
def _rod_entry(scene, touch, offset, way, entry, k, r, token):
    """Entry of a section: unchanged for its translation, with a lever for its spin."""
    if scene.place[k] % SIZE == 0:
        return entry
    lever = load3(touch.lever, 3 * (k - 1), token)
    if r > 0:
        lever = added(offset, scene.centre[k], lever)
    return cross(lever, way)


@kernel
def row_entry(scene, gradient, arm, touch, slot, k, r, token):
    """Derivative of the velocity along row r of a candidate by entry k of its sphere.

    Normal impulses act at the sphere's centre, friction on its surface.
    """
    way, centre = load3(touch.frame, 9 * slot + 3 * r, token), fill(scene.centre[k], touch.cube, token)
    offset, entry = load3(touch.offset, 3 * slot, token), scaled(way, centre)
    if gradient is not None:
        entry = _mesh_entry(scene, offset, way, centre, k, r)
    if arm is not None:
        entry = _rod_entry(scene, touch, offset, way, entry, k, r, token)
    return entry
