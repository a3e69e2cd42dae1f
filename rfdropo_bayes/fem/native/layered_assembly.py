"""Layer frames, elastic forces, tangent and mass of a layered body in SIMD lanes, in the section modes of
`section_modes`.

The physics is that of ``fem.dynamics``. A time step and an iteration for static equilibrium differ in a few factors
only, held in
`Factors`.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.fem.native.simd import fill, load, store

POLAR_ITERATIONS = 6


class Samples(NamedTuple):
    """Rollout parameters of one lane block; the last axis is the lane."""

    moduli: Float[np.ndarray, "3 lanes"]  # lambda, mu, 2 lambda mu / (lambda + 2 mu) [Pa]
    density: Float[np.ndarray, "1 lanes"]
    layer_scale: Float[np.ndarray, "layers lanes"]
    point_mass: Float[np.ndarray, "stations lanes"]
    stiffness: Float[np.ndarray, "layer_entries lanes"]
    station_mass: Float[np.ndarray, "station_pairs lanes"]
    layer_mass: Float[np.ndarray, "layer_coupled lanes"]
    gravity: Float[np.ndarray, "3 lanes"]
    damping: Float[np.ndarray, "2 lanes"]  # Rayleigh, of mass and of stiffness


class Factors(NamedTuple):
    """What makes a solve a time step or a static iteration; (1, lanes) each."""

    elasticity: Float[np.ndarray, "1 lanes"]  # of K in the matrix
    inertia: Float[np.ndarray, "1 lanes"]  # of M in the matrix
    force: Float[
        np.ndarray, "1 lanes"
    ]  # of the elastic force, of the weight and of the cable slack in the right-hand side
    strain_rate: Float[np.ndarray, "1 lanes"]  # of -K v there
    drag: Float[np.ndarray, "1 lanes"]  # of -M v there


class Work(NamedTuple):
    """State and scratch of one lane block; the last axis is the lane."""

    position: Float[np.ndarray, "values lanes"]
    velocity: Float[np.ndarray, "values lanes"]
    pivot: Float[np.ndarray, "station_block lanes"]
    coupling: Float[np.ndarray, "station_block lanes"]
    border: Float[np.ndarray, "station_frame lanes"]
    condensed: Float[np.ndarray, "frame2 lanes"]
    solution: Float[np.ndarray, "values lanes"]
    field: Float[np.ndarray, "values lanes"]
    weight: Float[np.ndarray, "rows lanes"]
    axes: Float[np.ndarray, "9 lanes"]  # frame of a layer, row-major
    dyads: Float[np.ndarray, "54 lanes"]  # products of its columns
    local: Float[np.ndarray, "layer_values lanes"]
    reaction: Float[np.ndarray, "layer_values lanes"]
    slack: Float[np.ndarray, "cables lanes"]
    scale: Float[np.ndarray, "cables lanes"]
    compliance: Float[np.ndarray, "cables2 lanes"]
    active: Float[np.ndarray, "cables lanes"]
    tension: Float[np.ndarray, "cables lanes"]
    pivoting: Float[np.ndarray, "scratch lanes"]
    commanded: Float[np.ndarray, "cables lanes"]
    unsolved: Float[np.ndarray, "1 lanes"]  # 1 where the tensions were not found
    accepted: Float[np.ndarray, "1 lanes"]  # 0 where the last step was not taken
    lost: Float[np.ndarray, "1 lanes"]  # 1 once a step was not taken
    failed: Float[np.ndarray, "1 lanes"]  # 1 once tensions were not found
    points: Float[np.ndarray, "point_values lanes"]


@numba.njit(nogil=True, error_model="numpy")
def clear(array, first, last, token):
    """Zero the rows from first to last."""
    zero = fill(0.0, array, token)
    for i in range(first, last):
        store(array, i, zero)


@numba.njit(nogil=True, error_model="numpy")
def _deformation(tables, layer, position, axes, token):
    """Mean deformation gradient of a layer into ``axes``, row-major."""
    modes = len(tables.parity)
    clear(axes, 0, 9, token)
    for face in range(2):
        for m in range(modes):
            if tables.parity[m] == 3:
                continue
            column = (tables.parity[m] + 2) % 3
            slope = tables.gradient[layer, face, m]
            row = 3 * ((layer + face) * modes + m)
            for i in range(3):
                store(axes, 3 * i + column, load(axes, 3 * i + column, token) + load(position, row + i, token) * slope)


@numba.njit(inline="always")
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@numba.njit(nogil=True, error_model="numpy")
def _rotation(axes, token):
    """Rotation of the polar decomposition in place, by Newton's iteration."""
    one = fill(1.0, axes, token)
    a0, a1, a2 = load(axes, 0, token), load(axes, 1, token), load(axes, 2, token)
    b0, b1, b2 = load(axes, 3, token), load(axes, 4, token), load(axes, 5, token)
    c0, c1, c2 = load(axes, 6, token), load(axes, 7, token), load(axes, 8, token)
    for _ in range(POLAR_ITERATIONS):
        u0, u1, u2 = _cross(b0, b1, b2, c0, c1, c2)
        v0, v1, v2 = _cross(c0, c1, c2, a0, a1, a2)
        w0, w1, w2 = _cross(a0, a1, a2, b0, b1, b2)
        scale = one / (a0 * u0 + a1 * u1 + a2 * u2)
        a0, a1, a2 = 0.5 * (a0 + u0 * scale), 0.5 * (a1 + u1 * scale), 0.5 * (a2 + u2 * scale)
        b0, b1, b2 = 0.5 * (b0 + v0 * scale), 0.5 * (b1 + v1 * scale), 0.5 * (b2 + v2 * scale)
        c0, c1, c2 = 0.5 * (c0 + w0 * scale), 0.5 * (c1 + w1 * scale), 0.5 * (c2 + w2 * scale)
    store(axes, 0, a0)
    store(axes, 1, a1)
    store(axes, 2, a2)
    store(axes, 3, b0)
    store(axes, 4, b1)
    store(axes, 5, b2)
    store(axes, 6, c0)
    store(axes, 7, c1)
    store(axes, 8, c2)


@numba.njit(nogil=True, error_model="numpy")
def _local_field(tables, layer, factors, work, token):
    """``local`` = force * (R' x - X) + strain_rate * R' v, all relative to the lower section's mean: K does not see
    the difference."""
    modes = len(tables.parity)
    x, v, axes = work.position, work.velocity, work.axes
    force, rate = load(factors.force, 0, token), load(factors.strain_rate, 0, token)
    base = 3 * layer * modes
    above = base + 3 * modes
    for k in range(2 * modes):
        row = base + 3 * k
        x0, x1, x2 = load(x, row, token), load(x, row + 1, token), load(x, row + 2, token)
        v0, v1, v2 = load(v, row, token), load(v, row + 1, token), load(v, row + 2, token)
        r0, r1, r2 = tables.rest[row], tables.rest[row + 1], tables.rest[row + 2]
        if row == base or row == above:  # noqa: SIM109 (Numba would build a tuple)
            x0, x1, x2 = x0 - load(x, base, token), x1 - load(x, base + 1, token), x2 - load(x, base + 2, token)
            v0, v1, v2 = v0 - load(v, base, token), v1 - load(v, base + 1, token), v2 - load(v, base + 2, token)
            r0, r1, r2 = r0 - tables.rest[base], r1 - tables.rest[base + 1], r2 - tables.rest[base + 2]
        for i in range(3):
            a, b, c = load(axes, i, token), load(axes, 3 + i, token), load(axes, 6 + i, token)
            rest = r0 if i == 0 else (r1 if i == 1 else r2)
            strain = a * x0 + b * x1 + c * x2 - rest
            store(work.local, 3 * k + i, force * strain + rate * (a * v0 + b * v1 + c * v2))


@numba.njit(nogil=True, error_model="numpy")
def _couple(stiffness, e, kind, work, row, column, twice, token):
    """Add one block of K times ``local`` to ``reaction``, and its transpose if ``twice``; returns the next entry."""
    u, f = work.local, work.reaction
    if kind == 0:
        i0, j0, i1, j1, count = 0, 0, 1, 1, 3
    elif kind == 1:
        i0, j0, i1, j1, count = 0, 2, 2, 0, 2
    elif kind == 2:
        i0, j0, i1, j1, count = 1, 2, 2, 1, 2
    else:
        i0, j0, i1, j1, count = 0, 1, 1, 0, 2
    for n in range(count):
        i = i0 if n == 0 else (i1 if n == 1 else 2)
        j = j0 if n == 0 else (j1 if n == 1 else 2)
        k = load(stiffness, e + n, token)
        store(f, row + i, load(f, row + i, token) + k * load(u, column + j, token))
        if twice:
            store(f, column + j, load(f, column + j, token) + k * load(u, row + i, token))
    return e + count


@numba.njit(nogil=True, error_model="numpy")
def _layer_reaction(tables, samples, entry, work, token):
    """``reaction`` = K ``local`` for the layer whose stiffness starts at ``entry``."""
    modes = len(tables.parity)
    clear(work.reaction, 0, 6 * modes, token)
    e = entry
    for face in range(2):
        for m in range(modes):
            for n in range(m + 1):
                kind = tables.parity[m] ^ tables.parity[n]
                row, column = 3 * (face * modes + m), 3 * (face * modes + n)
                e = _couple(samples.stiffness, e, kind, work, row, column, m != n, token)
    for m in range(modes):
        for n in range(modes):
            kind = tables.parity[m] ^ tables.parity[n]
            e = _couple(samples.stiffness, e, kind, work, 3 * m, 3 * (modes + n), True, token)


@numba.njit(nogil=True, error_model="numpy")
def _axis_products(factors, work, token):
    """``dyads``: r_i r_i' by columns (00, 11, 22), then r_0 r_2', r_1 r_2', r_0 r_1', all times the elasticity
    factor."""
    axes, dyads = work.axes, work.dyads
    scale = load(factors.elasticity, 0, token)
    for n in range(6):
        i = (0, 1, 2, 0, 1, 0)[n]
        j = (0, 1, 2, 2, 2, 1)[n]
        for c in range(3):
            factor = scale * load(axes, 3 * c + j, token)
            for r in range(3):
                store(dyads, 9 * n + 3 * c + r, load(axes, 3 * r + i, token) * factor)


@numba.njit(nogil=True, error_model="numpy")
def _add_block(target, t, stiffness, e, kind, dyads, add, token):
    """Write a turned block of K as the tile at ``t``, or add it; returns the next entry."""
    zero = fill(0.0, target, token)
    first, second = load(stiffness, e, token), load(stiffness, e + 1, token)
    third = load(stiffness, e + 2, token) if kind == 0 else zero
    for c in range(3):
        for r in range(3):
            k, mirrored = 3 * c + r, 3 * r + c
            if kind == 0:
                value = (
                    first * load(dyads, k, token)
                    + second * load(dyads, 9 + k, token)
                    + third * load(dyads, 18 + k, token)
                )
            else:
                d = 18 + 9 * kind
                value = first * load(dyads, d + k, token) + second * load(dyads, d + mirrored, token)
            if add:
                value = value + load(target, t + k, token)
            store(target, t + k, value)
    return e + 3 if kind == 0 else e + 2


@numba.njit(nogil=True, error_model="numpy")
def _layer_tangent(tables, samples, entry, layer, work, whole, token):
    """Add the tangent of a layer to the pivot of its upper station; ``whole``: set the coupling and start the lower
    station's pivot."""
    modes = len(tables.parity)
    panel = 9 * modes
    block = modes * panel
    upper = (layer + 1) * block
    e = entry
    for face in range(2):
        for m in range(modes):
            for n in range(m + 1):
                kind = tables.parity[m] ^ tables.parity[n]
                if face == 1:
                    e = _add_block(
                        work.pivot, upper + m * panel + 9 * n, samples.stiffness, e, kind, work.dyads, True, token
                    )
                elif whole:
                    t = upper - block + m * panel + 9 * n
                    e = _add_block(work.pivot, t, samples.stiffness, e, kind, work.dyads, False, token)
                else:
                    e += 3 if kind == 0 else 2
    if whole:
        for m in range(modes):
            for n in range(modes):
                kind = tables.parity[m] ^ tables.parity[n]
                t = upper + m * panel + 9 * n
                e = _add_block(work.coupling, t, samples.stiffness, e, kind, work.dyads, False, token)


@numba.njit(nogil=True, error_model="numpy")
def add_station_mass(tables, samples, factors, station, work, token):
    """Add the inertia of a station to its pivot."""
    modes = len(tables.parity)
    inertia = load(factors.inertia, 0, token)
    entry = station * tables.station_mass.shape[1]
    for m in range(modes):
        for n in range(m + 1):
            if tables.parity[m] == tables.parity[n]:
                value = inertia * load(samples.station_mass, entry, token)
                for i in range(3):
                    t = ((station * modes + m) * 3 * modes + 3 * n + i) * 3 + i
                    store(work.pivot, t, load(work.pivot, t, token) + value)
                entry += 1


@numba.njit(nogil=True, error_model="numpy")
def add_layer_mass(tables, samples, factors, layer, work, token):
    """Add the inertia that couples the stations of a layer."""
    modes = len(tables.parity)
    inertia = load(factors.inertia, 0, token)
    entry = layer * tables.layer_mass.shape[1]
    for m in range(modes):
        for n in range(modes):
            if tables.parity[m] == tables.parity[n]:
                value = inertia * load(samples.layer_mass, entry, token)
                for i in range(3):
                    t = (((layer + 1) * modes + m) * 3 * modes + 3 * n + i) * 3 + i
                    store(work.coupling, t, load(work.coupling, t, token) + value)
                entry += 1


@numba.njit(nogil=True, error_model="numpy")
def assemble_layer(tables, samples, factors, layer, work, whole, token):
    """Force of a layer on its stations, and its part of the matrix; see `_layer_tangent` for ``whole``."""
    modes = len(tables.parity)
    entry = layer * tables.stiffness.shape[1]
    _deformation(tables, layer, work.position, work.axes, token)
    _rotation(work.axes, token)
    _local_field(tables, layer, factors, work, token)
    _layer_reaction(tables, samples, entry, work, token)
    for k in range(2 * modes):
        x, y, z = (
            load(work.reaction, 3 * k, token),
            load(work.reaction, 3 * k + 1, token),
            load(work.reaction, 3 * k + 2, token),
        )
        row = 3 * (layer * modes + k)
        for i in range(3):
            a, b, c = (
                load(work.axes, 3 * i, token),
                load(work.axes, 3 * i + 1, token),
                load(work.axes, 3 * i + 2, token),
            )
            store(work.field, row + i, load(work.field, row + i, token) - (a * x + b * y + c * z))
    _axis_products(factors, work, token)
    _layer_tangent(tables, samples, entry, layer, work, whole, token)


@numba.njit(nogil=True, error_model="numpy")
def _body_acceleration(samples, factors, work, row, mode, token):
    """Gravity less Rayleigh drag, times their factors, for one mode of one station: three components."""
    v, g = work.velocity, samples.gravity
    drag = load(factors.drag, 0, token)
    x, y, z = -drag * load(v, row, token), -drag * load(v, row + 1, token), -drag * load(v, row + 2, token)
    if mode == 0:
        force = load(factors.force, 0, token)
        x, y, z = x + force * load(g, 0, token), y + force * load(g, 1, token), z + force * load(g, 2, token)
    return x, y, z


@numba.njit(inline="always")
def _add_to_field(field, row, mass, x, y, z, token):
    store(field, row, load(field, row, token) + mass * x)
    store(field, row + 1, load(field, row + 1, token) + mass * y)
    store(field, row + 2, load(field, row + 2, token) + mass * z)


@numba.njit(nogil=True, error_model="numpy")
def start_loads(tables, samples, factors, work, token):
    """``field`` = M (gravity - drag v): the right-hand side without the elastic forces."""
    modes, stations = len(tables.parity), tables.station_mass.shape[0]
    clear(work.field, 0, 3 * modes * stations, token)
    entry, coupled = 0, 0
    for station in range(stations):
        base = 3 * station * modes
        for m in range(modes):
            for n in range(m + 1):
                if tables.parity[m] == tables.parity[n]:
                    row, column = base + 3 * m, base + 3 * n
                    mass = load(samples.station_mass, entry, token)
                    x, y, z = _body_acceleration(samples, factors, work, column, n, token)
                    _add_to_field(work.field, row, mass, x, y, z, token)
                    if m != n:
                        x, y, z = _body_acceleration(samples, factors, work, row, m, token)
                        _add_to_field(work.field, column, mass, x, y, z, token)
                    entry += 1
        if station + 1 == stations:
            break
        for m in range(modes):
            for n in range(modes):
                if tables.parity[m] == tables.parity[n]:
                    row, column = base + 3 * m, base + 3 * (modes + n)
                    mass = load(samples.layer_mass, coupled, token)
                    x, y, z = _body_acceleration(samples, factors, work, column, n, token)
                    _add_to_field(work.field, row, mass, x, y, z, token)
                    x, y, z = _body_acceleration(samples, factors, work, row, m, token)
                    _add_to_field(work.field, column, mass, x, y, z, token)
                    coupled += 1
