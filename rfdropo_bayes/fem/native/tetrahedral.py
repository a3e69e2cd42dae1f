"""Kernels of a body of corotational tetrahedra in SIMD lanes: frames, forces, and the matrix of a stage.

The physics follows ``fem.tetrahedra`` and ``fem.tetrahedral_dynamics``, with samples in lanes. Nodes are numbered in
elimination order, held nodes after the free nodes. Block storage beyond the factor's is a dump for blocks of held
nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.fem.native.simd import (
    fill,
    fma,
    fnma,
    load,
    load3,
    mesh_inlined,
    mesh_part,
    mesh_pasted,
    square_root,
    store,
)
from rfdropo_bayes.fem.tetrahedra import POLAR_ITERATIONS


class Mesh(NamedTuple):
    """Static element data, in elimination numbering; each element's nodes ascend."""

    node: Int[np.ndarray, "elements 4"]
    frame_node: Int[np.ndarray, "elements 3"]  # that span the frame from edges, in the mesh's own order
    gradient: Float[np.ndarray, "elements 4 3"]  # in the element's frame at rest [1/m]
    edge: Float[np.ndarray, "elements 3 3"]  # from the first node to the others, in the element's frame at rest [m]
    volume: Float[np.ndarray, " elements"]
    slot: Int[np.ndarray, "elements 6"]  # blocks (1,0) (2,0) (3,0) (2,1) (3,1) (3,2)
    free: int
    polar: bool


class TetrahedralSamples(NamedTuple):
    """Parameters of the rollouts of one lane block; the last axis is the lane."""

    first_lame: Float[np.ndarray, "1 lanes"]
    shear_modulus: Float[np.ndarray, "1 lanes"]
    element_scale: Float[np.ndarray, "elements lanes"]
    mass: Float[np.ndarray, "nodes lanes"]
    rayleigh_mass: Float[np.ndarray, "1 lanes"]
    rayleigh_stiffness: Float[np.ndarray, "1 lanes"]
    gravity: Float[np.ndarray, "3 lanes"]


class TetrahedralWork(NamedTuple):
    """State and scratch of one lane block; the last axis is the lane."""

    position: Float[np.ndarray, "nodes3 lanes"]
    velocity: Float[np.ndarray, "nodes3 lanes"]
    begun: Float[np.ndarray, "nodes3 lanes"]  # velocity at the start of the stage
    moving: Float[np.ndarray, "nodes3 lanes"]  # velocity that carries the forces to the end of the stage
    before: Float[np.ndarray, "nodes3 lanes"]  # change of velocity in the stage before
    sudden: Float[np.ndarray, "nodes3 lanes"]  # impulses of contacts that began in it
    force: Float[np.ndarray, "nodes3 lanes"]
    pivot: Float[np.ndarray, "nodes6 lanes"]
    lower: Float[np.ndarray, "blocks9 lanes"]
    solution: Float[np.ndarray, "free3 lanes"]
    condensed: Float[np.ndarray, "rows2 lanes"]
    weight: Float[np.ndarray, "rows lanes"]
    slack: Float[np.ndarray, "cables lanes"]
    tension: Float[np.ndarray, "cables lanes"]
    measured: Float[np.ndarray, "cables lanes"]
    load: Float[np.ndarray, "border9 lanes"]
    commanded: Float[np.ndarray, "cables lanes"]
    target: Float[np.ndarray, "cables lanes"]
    accepted: Float[np.ndarray, "1 lanes"]
    lost: Float[np.ndarray, "1 lanes"]
    unsolved: Float[np.ndarray, "1 lanes"]
    wide: Float[np.ndarray, "1 lanes"]  # length of the stage for its impacts, in units of the other stage's
    narrow: Float[np.ndarray, "1 lanes"]  # its inverse
    going: Float[np.ndarray, "1 lanes"]  # share of the change of velocity in the stage before that is carried on
    axes: Float[np.ndarray, "9 lanes"]
    turned: Float[np.ndarray, "12 lanes"]


@mesh_pasted
def _cross(ax, ay, az, bx, by, bz):
    return fnma(az, by, ay * bz), fnma(ax, bz, az * bx), fnma(ay, bx, ax * by)


@mesh_inlined
def _edge_frame(mesh, e, x, axes, token):
    """Rows of ``axes``: along edge 0-1, across it in the face 0-1-2, normal to the face."""
    one = fill(1.0, x, token)
    a, b, c = 3 * mesh.frame_node[e, 0], 3 * mesh.frame_node[e, 1], 3 * mesh.frame_node[e, 2]
    ox, oy, oz = load3(x, a, token)
    ex, ey, ez = load(x, b, token) - ox, load(x, b + 1, token) - oy, load(x, b + 2, token) - oz
    fx, fy, fz = load(x, c, token) - ox, load(x, c + 1, token) - oy, load(x, c + 2, token) - oz
    scale = one / square_root(fma(ex, ex, fma(ey, ey, ez * ez)))
    ex, ey, ez = ex * scale, ey * scale, ez * scale
    nx, ny, nz = _cross(ex, ey, ez, fx, fy, fz)
    scale = one / square_root(fma(nx, nx, fma(ny, ny, nz * nz)))
    nx, ny, nz = nx * scale, ny * scale, nz * scale
    tx, ty, tz = _cross(nx, ny, nz, ex, ey, ez)
    store(axes, 0, ex, ey, ez, tx, ty, tz, nx, ny, nz)


@mesh_inlined
def _polar_frame(mesh, e, x, axes, token):
    """``axes`` = transposed rotation of the polar decomposition of the deformation gradient, by Newton's iteration."""
    for i in range(3):
        origin = load(x, 3 * mesh.node[e, 0] + i, token)
        for j in range(3):
            total = fill(0.0, x, token)
            for a in range(1, 4):
                total = fma(load(x, 3 * mesh.node[e, a] + i, token) - origin, mesh.gradient[e, a, j], total)
            store(axes, 3 * j + i, total)
    for _ in range(POLAR_ITERATIONS):
        a0, a1, a2 = load3(axes, 0, token)
        b0, b1, b2 = load3(axes, 3, token)
        c0, c1, c2 = load3(axes, 6, token)
        u0, u1, u2 = _cross(b0, b1, b2, c0, c1, c2)
        v0, v1, v2 = _cross(c0, c1, c2, a0, a1, a2)
        w0, w1, w2 = _cross(a0, a1, a2, b0, b1, b2)
        scale = fill(1.0, x, token) / (fma(a0, u0, fma(a1, u1, a2 * u2)))
        store(axes, 0, 0.5 * (a0 + u0 * scale), 0.5 * (a1 + u1 * scale), 0.5 * (a2 + u2 * scale))
        store(axes, 3, 0.5 * (b0 + v0 * scale), 0.5 * (b1 + v1 * scale), 0.5 * (b2 + v2 * scale))
        store(axes, 6, 0.5 * (c0 + w0 * scale), 0.5 * (c1 + w1 * scale), 0.5 * (c2 + w2 * scale))


@mesh_pasted
def _rotate(axes, x, y, z, token):
    """From space to the element's frame."""
    return (
        fma(load(axes, 0, token), x, fma(load(axes, 1, token), y, load(axes, 2, token) * z)),
        fma(load(axes, 3, token), x, fma(load(axes, 4, token), y, load(axes, 5, token) * z)),
        fma(load(axes, 6, token), x, fma(load(axes, 7, token), y, load(axes, 8, token) * z)),
    )


@mesh_pasted
def _rotate_back(axes, x, y, z, token):
    """From the element's frame to space."""
    return (
        fma(x, load(axes, 0, token), fma(y, load(axes, 3, token), z * load(axes, 6, token))),
        fma(x, load(axes, 1, token), fma(y, load(axes, 4, token), z * load(axes, 7, token))),
        fma(x, load(axes, 2, token), fma(y, load(axes, 5, token), z * load(axes, 8, token))),
    )


@mesh_inlined
def _element_force(mesh, e, work, v, lame, shear, lookahead, token):
    """Add an element's force at the positions x + lookahead v, in the frame of x, to ``work.force``; fill
    ``work.turned``."""
    x, axes = work.position, work.axes
    zero = fill(0.0, x, token)
    h00, h01, h02, h10, h11, h12, h20, h21, h22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    o = 3 * mesh.node[e, 0]
    ox = fma(lookahead, load(v, o, token), load(x, o, token))
    oy = fma(lookahead, load(v, o + 1, token), load(x, o + 1, token))
    oz = fma(lookahead, load(v, o + 2, token), load(x, o + 2, token))
    for a in range(1, 4):
        n = 3 * mesh.node[e, a]
        dx = fma(lookahead, load(v, n, token), load(x, n, token)) - ox
        dy = fma(lookahead, load(v, n + 1, token), load(x, n + 1, token)) - oy
        dz = fma(lookahead, load(v, n + 2, token), load(x, n + 2, token)) - oz
        u, w, t = _rotate(axes, dx, dy, dz, token)
        u, w, t = u - mesh.edge[e, a - 1, 0], w - mesh.edge[e, a - 1, 1], t - mesh.edge[e, a - 1, 2]
        gx, gy, gz = mesh.gradient[e, a, 0], mesh.gradient[e, a, 1], mesh.gradient[e, a, 2]
        h00, h01, h02 = fma(u, gx, h00), fma(u, gy, h01), fma(u, gz, h02)
        h10, h11, h12 = fma(w, gx, h10), fma(w, gy, h11), fma(w, gz, h12)
        h20, h21, h22 = fma(t, gx, h20), fma(t, gy, h21), fma(t, gz, h22)
    pressure = lame * (h00 + h11 + h22)
    double = shear + shear
    s00, s11, s22 = fma(double, h00, pressure), fma(double, h11, pressure), fma(double, h22, pressure)
    s01, s02, s12 = shear * (h01 + h10), shear * (h02 + h20), shear * (h12 + h21)
    sx, sy, sz = zero, zero, zero
    for a in range(3, -1, -1):
        gx, gy, gz = mesh.gradient[e, a, 0], mesh.gradient[e, a, 1], mesh.gradient[e, a, 2]
        n = 3 * mesh.node[e, a]
        if a > 0:
            fx, fy, fz = _rotate_back(
                axes,
                fma(s00, gx, fma(s01, gy, s02 * gz)),
                fma(s01, gx, fma(s11, gy, s12 * gz)),
                fma(s02, gx, fma(s12, gy, s22 * gz)),
                token,
            )
            sx, sy, sz = sx + fx, sy + fy, sz + fz
        else:
            fx, fy, fz = -sx, -sy, -sz
        store(work.force, n, load(work.force, n, token) - fx, load(work.force, n + 1, token) - fy)
        store(work.force, n + 2, load(work.force, n + 2, token) - fz)
        tx = fma(load(axes, 0, token), gx, fma(load(axes, 3, token), gy, load(axes, 6, token) * gz))
        ty = fma(load(axes, 1, token), gx, fma(load(axes, 4, token), gy, load(axes, 7, token) * gz))
        tz = fma(load(axes, 2, token), gx, fma(load(axes, 5, token), gy, load(axes, 8, token) * gz))
        store(work.turned, 3 * a, tx, ty, tz)


@mesh_inlined
def _element_tangent(mesh, e, work, lame, shear, token):
    """Add an element's scaled tangent to the pivots and blocks of the matrix."""
    turned, pivot, lower = work.turned, work.pivot, work.lower
    both = lame + shear
    for a in range(4):
        gx, gy, gz = load3(turned, 3 * a, token)
        p = 6 * mesh.node[e, a]
        bx, by, bz = both * gx, both * gy, both * gz
        size = shear * fma(gx, gx, fma(gy, gy, gz * gz))
        store(pivot, p, fma(bx, gx, load(pivot, p, token) + size), fma(by, gx, load(pivot, p + 1, token)))
        store(pivot, p + 2, fma(by, gy, load(pivot, p + 2, token) + size), fma(bz, gx, load(pivot, p + 3, token)))
        store(pivot, p + 4, fma(bz, gy, load(pivot, p + 4, token)), fma(bz, gz, load(pivot, p + 5, token) + size))
    pair = 0
    for b in range(3):
        cx, cy, cz = load3(turned, 3 * b, token)
        lx, ly, lz = lame * cx, lame * cy, lame * cz
        sx, sy, sz = shear * cx, shear * cy, shear * cz
        for a in range(b + 1, 4):
            gx, gy, gz = load3(turned, 3 * a, token)
            t = 9 * mesh.slot[e, pair]
            dot = fma(gx, sx, fma(gy, sy, gz * sz))
            store(lower, t, fma(gx, lx, fma(sx, gx, load(lower, t, token) + dot)))
            store(lower, t + 1, fma(gx, ly, fma(sx, gy, load(lower, t + 1, token))))
            store(lower, t + 2, fma(gx, lz, fma(sx, gz, load(lower, t + 2, token))))
            store(lower, t + 3, fma(gy, lx, fma(sy, gx, load(lower, t + 3, token))))
            store(lower, t + 4, fma(gy, ly, fma(sy, gy, load(lower, t + 4, token) + dot)))
            store(lower, t + 5, fma(gy, lz, fma(sy, gz, load(lower, t + 5, token))))
            store(lower, t + 6, fma(gz, lx, fma(sz, gx, load(lower, t + 6, token))))
            store(lower, t + 7, fma(gz, ly, fma(sz, gy, load(lower, t + 7, token))))
            store(lower, t + 8, fma(gz, lz, fma(sz, gz, load(lower, t + 8, token) + dot)))
            pair += 1


@mesh_part
def clear(array, token):
    """Fill with zeros."""
    zero = fill(0.0, array, token)
    for i in range(array.shape[0]):
        store(array, i, zero)


@mesh_inlined
def _element(mesh, e, samples, work, velocity, lookahead, token):
    """Frame and force of an element; returns its Lame constants times its volume."""
    if mesh.polar:
        _polar_frame(mesh, e, work.position, work.axes, token)
    else:
        _edge_frame(mesh, e, work.position, work.axes, token)
    scale = load(samples.element_scale, e, token) * mesh.volume[e]
    lame, shear = scale * load(samples.first_lame, 0, token), scale * load(samples.shear_modulus, 0, token)
    _element_force(mesh, e, work, velocity, lame, shear, lookahead, token)
    return lame, shear


@mesh_part
def elastic_forces(mesh, samples, work, stage, token):
    """``work.force`` at the positions of the end of the stage, and for its velocity, in the frames of x."""
    clear(work.force, token)
    damping = load(samples.rayleigh_stiffness, 0, token)
    length = stage.length * load(work.wide, 0, token)
    lookahead = damping + length
    moved = length / lookahead if stage.predicted else fill(0.0, work.force, token)
    for i in range(work.moving.shape[0]):
        store(work.moving, i, fnma(moved, load(work.begun, i, token), load(work.velocity, i, token)))
    for e in range(mesh.node.shape[0]):
        _element(mesh, e, samples, work, work.moving, lookahead, token)


@mesh_part
def gone_on(samples, work, node, i, token):
    """Component i of the impulse with which a node continues from the earlier stage."""
    going = load(samples.mass, node, token) * load(work.before, 3 * node + i, token)
    return (going - load(work.sudden, 3 * node + i, token)) * load(work.going, 0, token)


@mesh_part
def assemble(pattern, mesh, samples, work, stage, token):
    """Matrix (1 + q a) M + q (q + b) K and, as border row 0, the right-hand side q (f + M g - (r + b) K v - a M v); see
    ``fem.dynamics``."""
    clear(work.pivot, token)
    clear(work.lower, token)
    clear(work.force, token)
    length, damping = stage.length * load(work.wide, 0, token), load(samples.rayleigh_stiffness, 0, token)
    lookahead = damping + length
    scale = length * lookahead
    behind = damping if stage.predicted else lookahead
    for e in range(mesh.node.shape[0]):
        lame, shear = _element(mesh, e, samples, work, work.velocity, behind, token)
        _element_tangent(mesh, e, work, lame * scale, shear * scale, token)
    drag = load(samples.rayleigh_mass, 0, token)
    inertia = 1.0 + length * drag
    for node in range(mesh.free):
        mass = load(samples.mass, node, token)
        for i in range(3):
            p = 6 * node + (i * (i + 3)) // 2
            store(work.pivot, p, load(work.pivot, p, token) + inertia * mass)
            acceleration = load(samples.gravity, i, token) - drag * load(work.velocity, 3 * node + i, token)
            right = length * (load(work.force, 3 * node + i, token) + mass * acceleration)
            if stage.carried > 0.0:
                right = right + gone_on(samples, work, node, i, token)
            store(work.lower, 9 * (pattern.first[node + 1] - pattern.border) + i, right)
