"""Kernels of a body of corotational tetrahedra in SIMD lanes: assembly, cables, and the implicit Euler step.

The physics is that of ``fem.tetrahedra`` and ``fem.tetrahedral_dynamics``; this is the same step with samples in
lanes. Nodes are numbered in elimination order, held nodes after the free ones. Block storage beyond that of the factor
is a dump for blocks of held nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.fem.native.block_cholesky import back_substitute, condense, factor
from rfdropo_bayes.fem.native.complementarity import solve_unilateral
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, load, square_root, store, where_greater

POLAR_ITERATIONS = 6


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


class Cables(NamedTuple):
    """Static cable data; the points of cable c are ``first[c]:first[c + 1]``, the first of them fixed in space."""

    first: Int[np.ndarray, " cables_1"]
    node: Int[np.ndarray, "points weights"]
    weight: Float[np.ndarray, "points weights"]
    anchor: Float[np.ndarray, "cables 3"]
    rest_length: Float[np.ndarray, " cables"]
    limit: Float[np.ndarray, " cables"]  # largest displacement [m]
    rate: float  # largest change of the displacement in a step, against the one measured a step before [m]


class Samples(NamedTuple):
    """Parameters of the rollouts of one lane block; the last axis is the lane."""

    first_lame: Float[np.ndarray, "1 lanes"]
    shear_modulus: Float[np.ndarray, "1 lanes"]
    element_scale: Float[np.ndarray, "elements lanes"]
    mass: Float[np.ndarray, "nodes lanes"]
    rayleigh_mass: Float[np.ndarray, "1 lanes"]
    rayleigh_stiffness: Float[np.ndarray, "1 lanes"]
    gravity: Float[np.ndarray, "3 lanes"]


class Work(NamedTuple):
    """State and scratch of one lane block; the last axis is the lane."""

    position: Float[np.ndarray, "nodes3 lanes"]
    velocity: Float[np.ndarray, "nodes3 lanes"]
    force: Float[np.ndarray, "nodes3 lanes"]
    pivot: Float[np.ndarray, "nodes6 lanes"]
    lower: Float[np.ndarray, "blocks9 lanes"]
    solution: Float[np.ndarray, "free3 lanes"]
    condensed: Float[np.ndarray, "rows2 lanes"]
    weight: Float[np.ndarray, "rows lanes"]
    compliance: Float[np.ndarray, "cables2 lanes"]
    slack: Float[np.ndarray, "cables lanes"]
    active: Float[np.ndarray, "cables lanes"]
    tension: Float[np.ndarray, "cables lanes"]
    measured: Float[np.ndarray, "cables lanes"]
    pivoting: Float[np.ndarray, "scratch lanes"]
    axes: Float[np.ndarray, "9 lanes"]
    turned: Float[np.ndarray, "12 lanes"]


@numba.njit(inline="always")
def _cross(ax, ay, az, bx, by, bz):
    return fnma(az, by, ay * bz), fnma(ax, bz, az * bx), fnma(ay, bx, ax * by)


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _edge_frame(mesh, e, x, axes, token):
    """Rows of ``axes``: along edge 0-1, across it in the face 0-1-2, normal to the face."""
    one = fill(1.0, x, token)
    a, b, c = 3 * mesh.frame_node[e, 0], 3 * mesh.frame_node[e, 1], 3 * mesh.frame_node[e, 2]
    ox, oy, oz = load(x, a, token), load(x, a + 1, token), load(x, a + 2, token)
    ex, ey, ez = load(x, b, token) - ox, load(x, b + 1, token) - oy, load(x, b + 2, token) - oz
    fx, fy, fz = load(x, c, token) - ox, load(x, c + 1, token) - oy, load(x, c + 2, token) - oz
    scale = one / square_root(fma(ex, ex, fma(ey, ey, ez * ez)))
    ex, ey, ez = ex * scale, ey * scale, ez * scale
    nx, ny, nz = _cross(ex, ey, ez, fx, fy, fz)
    scale = one / square_root(fma(nx, nx, fma(ny, ny, nz * nz)))
    nx, ny, nz = nx * scale, ny * scale, nz * scale
    tx, ty, tz = _cross(nx, ny, nz, ex, ey, ez)
    store(axes, 0, ex)
    store(axes, 1, ey)
    store(axes, 2, ez)
    store(axes, 3, tx)
    store(axes, 4, ty)
    store(axes, 5, tz)
    store(axes, 6, nx)
    store(axes, 7, ny)
    store(axes, 8, nz)


@numba.njit(cache=True, forceinline=True, error_model="numpy")
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
        a0, a1, a2 = load(axes, 0, token), load(axes, 1, token), load(axes, 2, token)
        b0, b1, b2 = load(axes, 3, token), load(axes, 4, token), load(axes, 5, token)
        c0, c1, c2 = load(axes, 6, token), load(axes, 7, token), load(axes, 8, token)
        u0, u1, u2 = _cross(b0, b1, b2, c0, c1, c2)
        v0, v1, v2 = _cross(c0, c1, c2, a0, a1, a2)
        w0, w1, w2 = _cross(a0, a1, a2, b0, b1, b2)
        scale = fill(1.0, x, token) / (fma(a0, u0, fma(a1, u1, a2 * u2)))
        store(axes, 0, 0.5 * (a0 + u0 * scale))
        store(axes, 1, 0.5 * (a1 + u1 * scale))
        store(axes, 2, 0.5 * (a2 + u2 * scale))
        store(axes, 3, 0.5 * (b0 + v0 * scale))
        store(axes, 4, 0.5 * (b1 + v1 * scale))
        store(axes, 5, 0.5 * (b2 + v2 * scale))
        store(axes, 6, 0.5 * (c0 + w0 * scale))
        store(axes, 7, 0.5 * (c1 + w1 * scale))
        store(axes, 8, 0.5 * (c2 + w2 * scale))


@numba.njit(inline="always")
def _rotate_back(axes, x, y, z, token):
    """From the element's frame to space."""
    return (
        fma(x, load(axes, 0, token), fma(y, load(axes, 3, token), z * load(axes, 6, token))),
        fma(x, load(axes, 1, token), fma(y, load(axes, 4, token), z * load(axes, 7, token))),
        fma(x, load(axes, 2, token), fma(y, load(axes, 5, token), z * load(axes, 8, token))),
    )


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _element_force(mesh, e, work, lame, shear, lookahead, token):
    """Add an element's force at the positions x + lookahead v, in the frame of x, to ``work.force``; fill
    ``work.turned``."""
    x, v, axes = work.position, work.velocity, work.axes
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
        u = (
            fma(load(axes, 0, token), dx, fma(load(axes, 1, token), dy, load(axes, 2, token) * dz))
            - mesh.edge[e, a - 1, 0]
        )
        w = (
            fma(load(axes, 3, token), dx, fma(load(axes, 4, token), dy, load(axes, 5, token) * dz))
            - mesh.edge[e, a - 1, 1]
        )
        t = (
            fma(load(axes, 6, token), dx, fma(load(axes, 7, token), dy, load(axes, 8, token) * dz))
            - mesh.edge[e, a - 1, 2]
        )
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
        store(work.force, n, load(work.force, n, token) - fx)
        store(work.force, n + 1, load(work.force, n + 1, token) - fy)
        store(work.force, n + 2, load(work.force, n + 2, token) - fz)
        tx = fma(load(axes, 0, token), gx, fma(load(axes, 3, token), gy, load(axes, 6, token) * gz))
        ty = fma(load(axes, 1, token), gx, fma(load(axes, 4, token), gy, load(axes, 7, token) * gz))
        tz = fma(load(axes, 2, token), gx, fma(load(axes, 5, token), gy, load(axes, 8, token) * gz))
        store(work.turned, 3 * a, tx)
        store(work.turned, 3 * a + 1, ty)
        store(work.turned, 3 * a + 2, tz)


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _element_tangent(mesh, e, work, lame, shear, token):
    """Add an element's scaled tangent to the pivots and blocks of the matrix."""
    turned, pivot, lower = work.turned, work.pivot, work.lower
    both = lame + shear
    for a in range(4):
        gx, gy, gz = load(turned, 3 * a, token), load(turned, 3 * a + 1, token), load(turned, 3 * a + 2, token)
        p = 6 * mesh.node[e, a]
        bx, by, bz = both * gx, both * gy, both * gz
        size = shear * fma(gx, gx, fma(gy, gy, gz * gz))
        store(pivot, p, fma(bx, gx, load(pivot, p, token) + size))
        store(pivot, p + 1, fma(by, gx, load(pivot, p + 1, token)))
        store(pivot, p + 2, fma(by, gy, load(pivot, p + 2, token) + size))
        store(pivot, p + 3, fma(bz, gx, load(pivot, p + 3, token)))
        store(pivot, p + 4, fma(bz, gy, load(pivot, p + 4, token)))
        store(pivot, p + 5, fma(bz, gz, load(pivot, p + 5, token) + size))
    pair = 0
    for b in range(3):
        cx, cy, cz = load(turned, 3 * b, token), load(turned, 3 * b + 1, token), load(turned, 3 * b + 2, token)
        lx, ly, lz = lame * cx, lame * cy, lame * cz
        sx, sy, sz = shear * cx, shear * cy, shear * cz
        for a in range(b + 1, 4):
            gx, gy, gz = load(turned, 3 * a, token), load(turned, 3 * a + 1, token), load(turned, 3 * a + 2, token)
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


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _clear(array, token):
    zero = fill(0.0, array, token)
    for i in range(array.shape[0]):
        store(array, i, zero)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def assemble(pattern, mesh, samples, work, time_step, token):
    """Matrix (1 + h a) M + h (h + b) K and, as border row 0, the right-hand side h (f + M g - (h + b) K v - a M v)."""
    _clear(work.pivot, token)
    _clear(work.lower, token)
    _clear(work.force, token)
    lookahead = load(samples.rayleigh_stiffness, 0, token) + time_step
    for e in range(mesh.node.shape[0]):
        if mesh.polar:
            _polar_frame(mesh, e, work.position, work.axes, token)
        else:
            _edge_frame(mesh, e, work.position, work.axes, token)
        scale = load(samples.element_scale, e, token) * mesh.volume[e]
        lame, shear = scale * load(samples.first_lame, 0, token), scale * load(samples.shear_modulus, 0, token)
        _element_force(mesh, e, work, lame, shear, lookahead, token)
        scale = time_step * lookahead
        _element_tangent(mesh, e, work, lame * scale, shear * scale, token)
    drag = load(samples.rayleigh_mass, 0, token)
    inertia = 1.0 + time_step * drag
    for node in range(mesh.free):
        mass = load(samples.mass, node, token)
        for i in range(3):
            p = 6 * node + (i * (i + 3)) // 2
            store(work.pivot, p, load(work.pivot, p, token) + inertia * mass)
            acceleration = load(samples.gravity, i, token) - drag * load(work.velocity, 3 * node + i, token)
            right = time_step * (load(work.force, 3 * node + i, token) + mass * acceleration)
            store(work.lower, 9 * (pattern.first[node + 1] - pattern.border) + i, right)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _point(cables, p, c, field, fixed, token):
    """Position or velocity of a cable's point; the anchor's is ``fixed``."""
    if p == cables.first[c]:
        zero = fill(0.0, field, token)
        return (
            zero + cables.anchor[c, 0] * fixed,
            zero + cables.anchor[c, 1] * fixed,
            zero + cables.anchor[c, 2] * fixed,
        )
    x, y, z = fill(0.0, field, token), fill(0.0, field, token), fill(0.0, field, token)
    for k in range(cables.node.shape[1]):
        n, w = 3 * cables.node[p, k], cables.weight[p, k]
        x = x + load(field, n, token) * w
        y = y + load(field, n + 1, token) * w
        z = z + load(field, n + 2, token) * w
    return x, y, z


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _pull(pattern, mesh, cables, p, row, work, x, y, z, token):
    """Add a force on a cable's point to the cable's border row."""
    for k in range(cables.node.shape[1]):
        node, w = cables.node[p, k], cables.weight[p, k]
        if node < mesh.free and w != 0.0:
            t = 9 * (pattern.first[node + 1] - pattern.border + row // 3) + 3 * (row % 3)
            store(work.lower, t, load(work.lower, t, token) + x * w)
            store(work.lower, t + 1, load(work.lower, t + 1, token) + y * w)
            store(work.lower, t + 2, load(work.lower, t + 2, token) + z * w)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def gather_cables(pattern, mesh, cables, commanded, work, time_step, token):
    """Border rows -dl/dx of all cables, and their slack [m] at the end of the step if nothing changed the velocity.

    The commanded displacement may differ from the one measured a step before by no more than ``rate``, and never
    exceeds the limit.
    """
    one = fill(1.0, work.position, token)
    for c in range(len(cables.rest_length)):
        row = c + 1
        x, y, z = _point(cables, cables.first[c], c, work.position, 1.0, token)
        vx, vy, vz = _point(cables, cables.first[c], c, work.velocity, 0.0, token)
        length, growth = fill(0.0, work.position, token), fill(0.0, work.position, token)
        for p in range(cables.first[c] + 1, cables.first[c + 1]):
            px, py, pz = _point(cables, p, c, work.position, 1.0, token)
            wx, wy, wz = _point(cables, p, c, work.velocity, 0.0, token)
            dx, dy, dz = px - x, py - y, pz - z
            segment = square_root(fma(dx, dx, fma(dy, dy, dz * dz)))
            length = length + segment
            scale = one / segment
            dx, dy, dz = dx * scale, dy * scale, dz * scale
            growth = growth + (dx * (wx - vx) + dy * (wy - vy) + dz * (wz - vz))
            _pull(pattern, mesh, cables, p, row, work, -dx, -dy, -dz, token)
            if p - 1 > cables.first[c]:
                _pull(pattern, mesh, cables, p - 1, row, work, dx, dy, dz, token)
            x, y, z, vx, vy, vz = px, py, pz, wx, wy, wz
        target, before = load(commanded, c, token), load(work.measured, c, token)
        target = where_greater(target, before + cables.rate, before + cables.rate, target)
        target = where_greater(before - cables.rate, target, before - cables.rate, target)
        limit = one * cables.limit[c]
        target = where_greater(target, limit, limit, target)
        shortening = cables.rest_length[c] - length
        store(work.measured, c, shortening)
        store(work.slack, c, shortening - time_step * growth - target)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def solve_step(pattern, mesh, cables, commanded, samples, work, time_step, tolerance, token):
    """One implicit Euler step; returns False if a lane's cable tensions were not found."""
    count = len(cables.rest_length)
    assemble(pattern, mesh, samples, work, time_step, token)
    gather_cables(pattern, mesh, cables, commanded, work, time_step, token)
    factor(pattern, work.pivot, work.lower, token)
    condense(pattern, work.lower, work.condensed, token)
    rows = 3 * pattern.border
    square = time_step * time_step
    for i in range(count):
        free = load(work.slack, i, token) + time_step * load(work.condensed, (i + 1) * rows, token)
        store(work.slack, i, free)
        for j in range(count):
            store(work.compliance, i * count + j, square * load(work.condensed, (i + 1) * rows + j + 1, token))
    solved = solve_unilateral(
        work.compliance, work.slack, count, tolerance, work.active, work.pivoting, work.tension, token
    )
    _clear(work.weight, token)
    store(work.weight, 0, fill(1.0, work.weight, token))
    for i in range(count):
        store(work.weight, i + 1, time_step * load(work.tension, i, token))
    back_substitute(pattern, work.pivot, work.lower, work.weight, work.solution, token)
    for i in range(3 * mesh.free):
        velocity = load(work.velocity, i, token) + load(work.solution, i, token)
        store(work.velocity, i, velocity)
        store(work.position, i, load(work.position, i, token) + time_step * velocity)
    return solved


@numba.njit(nogil=True, cache=True, error_model="numpy")
def rollout(
    pattern, mesh, cables, commands, samples, work, points, weights, stride, time_step, tolerance, seen, pulls, token
):
    """Steps through ``commands`` (steps, cables, lanes), recording points and tensions after every ``stride`` steps.

    ``seen`` is (rows, points, 3, lanes), ``pulls`` (rows, cables, lanes).
    """
    solved = True
    for step in range(commands.shape[0]):
        solved &= solve_step(pattern, mesh, cables, commands[step], samples, work, time_step, tolerance, token)
        if (step + 1) % stride == 0:
            row = (step + 1) // stride - 1
            for p in range(points.shape[0]):
                for i in range(3):
                    total = fill(0.0, work.position, token)
                    for k in range(points.shape[1]):
                        total = total + load(work.position, 3 * points[p, k] + i, token) * weights[p, k]
                    store(seen[row, p], i, total)
            for c in range(len(cables.rest_length)):
                store(pulls[row], c, load(work.tension, c, token))
    return solved
