"""One linear solve for a layered body in SIMD lanes, and the step it makes: time step or static iteration."""

from __future__ import annotations

import numba

from rfdropo_bayes.fem.native.chain_cholesky import back_substitute, eliminate
from rfdropo_bayes.fem.native.complementarity import solve_unilateral
from rfdropo_bayes.fem.native.layered_assembly import (
    add_layer_mass,
    add_station_mass,
    assemble_layer,
    clear,
    start_loads,
)
from rfdropo_bayes.fem.native.simd import fill, load, square_root, store, where_greater

LARGEST = 1e30
"""Tensions beyond this [N] are not finite."""


@numba.njit(nogil=True, error_model="numpy")
def _point(first, place, weight, p, field, token):
    """Point p of a sparse list."""
    x, y, z = fill(0.0, field, token), fill(0.0, field, token), fill(0.0, field, token)
    for k in range(first[p], first[p + 1]):
        row, w = place[k], weight[k]
        x = x + load(field, row, token) * w
        y = y + load(field, row + 1, token) * w
        z = z + load(field, row + 2, token) * w
    return x, y, z


@numba.njit(nogil=True, error_model="numpy")
def _pull(tables, g, offset, work, x, y, z, token):
    """Add a pull on guide g to the border row at ``offset`` of every station; returns the pull times the guide's
    velocity."""
    growth = fill(0.0, work.border, token)
    v = work.velocity
    for k in range(tables.guide_first[g], tables.guide_first[g + 1]):
        row, w = tables.guide_place[k], tables.guide_weight[k]
        t = tables.guide_slot[k] + offset
        a, b, c = x * w, y * w, z * w
        store(work.border, t, load(work.border, t, token) + a)
        store(work.border, t + 3, load(work.border, t + 3, token) + b)
        store(work.border, t + 6, load(work.border, t + 6, token) + c)
        growth = growth + (a * load(v, row, token) + b * load(v, row + 1, token) + c * load(v, row + 2, token))
    return growth


@numba.njit(nogil=True, error_model="numpy")
def gather_cables(tables, work, rate, size, token):
    """Border rows dl/dx of all cables; ``slack`` = rate * (commanded length - length) - dl/dt."""
    one, zero = fill(1.0, work.position, token), fill(0.0, work.position, token)
    for c in range(len(tables.rest_length)):
        row = c + 1
        offset = row // 3 * 3 * size + row % 3
        x, y, z = zero + tables.anchor[c, 0], zero + tables.anchor[c, 1], zero + tables.anchor[c, 2]
        bx, by, bz = zero, zero, zero
        length, growth = zero, zero
        first, last = tables.cable_first[c], tables.cable_first[c + 1]
        for g in range(first, last):
            px, py, pz = _point(tables.guide_first, tables.guide_place, tables.guide_weight, g, work.position, token)
            dx, dy, dz = px - x, py - y, pz - z
            segment = square_root(dx * dx + dy * dy + dz * dz)
            length = length + segment
            scale = one / segment
            dx, dy, dz = dx * scale, dy * scale, dz * scale
            if g > first:
                growth = growth + _pull(tables, g - 1, offset, work, bx - dx, by - dy, bz - dz, token)
            x, y, z, bx, by, bz = px, py, pz, dx, dy, dz
        growth = growth + _pull(tables, last - 1, offset, work, bx, by, bz, token)
        shorter = tables.rest_length[c] - length
        store(work.slack, c, (shorter - load(work.commanded, c, token)) * rate - growth)


@numba.njit(nogil=True, error_model="numpy")
def _condensed_entry(work, i, j, panels, token):
    """Entry i >= j of b_i' A^-1 b_j, from its negative in tiles."""
    t = 9 * (i // 3 * panels + j // 3) + 3 * (j % 3) + i % 3
    return -load(work.condensed, t, token)


@numba.njit(nogil=True, error_model="numpy")
def _tensions(cables, panels, work, rate, tolerance, regularisation, token):
    """Unilateral tensions; leaves the weights of the border rows in ``weight`` and failed lanes in ``unsolved``."""
    one, zero = fill(1.0, work.weight, token), fill(0.0, work.weight, token)
    largest = zero
    for c in range(cables):
        diagonal = _condensed_entry(work, c + 1, c + 1, panels, token)
        largest = where_greater(diagonal, largest, diagonal, largest)
    for c in range(cables):
        diagonal = _condensed_entry(work, c + 1, c + 1, panels, token)
        usable = where_greater(diagonal, 1e-12 * largest, one, zero)
        scale = usable / square_root(where_greater(usable, zero, diagonal, one))
        store(work.scale, c, scale)
        remaining = load(work.slack, c, token) - _condensed_entry(work, c + 1, 0, panels, token)
        store(work.slack, c, remaining * scale)
        for d in range(c + 1):
            value = _condensed_entry(work, c + 1, d + 1, panels, token) * scale * load(work.scale, d, token)
            if c == d:
                value = value + regularisation
            store(work.compliance, c * cables + d, value)
            store(work.compliance, d * cables + c, value)
        store(work.active, c, usable * where_greater(load(work.tension, c, token), zero, one, zero))
    store(work.unsolved, 0, zero)
    if not solve_unilateral(
        work.compliance, work.slack, cables, tolerance, work.active, work.pivoting, work.tension, token
    ):
        for c in range(cables):
            bad = load(work.pivoting, cables * cables + c, token)
            store(work.unsolved, 0, where_greater(bad, zero, one, load(work.unsolved, 0, token)))
    store(work.weight, 0, one)
    for c in range(cables):
        impulse = load(work.scale, c, token) * load(work.tension, c, token)
        impulse = where_greater(zero, impulse, zero, impulse)
        store(work.weight, c + 1, -impulse)
        store(work.tension, c, impulse * rate)


@numba.njit(nogil=True, error_model="numpy")
def solve_increment(tables, samples, factors, work, rate, tolerance, regularisation, token):
    """``solution`` = A^-1 (r - J' T) and the tensions; the matrix is assembled and eliminated station by station from
    the tip."""
    tiles, stations, cables = len(tables.parity), tables.station_mass.shape[0], len(tables.rest_length)
    size, panels = 3 * tiles, (cables + 3) // 3
    frame, block = 3 * panels * size, 3 * tiles * size
    held = tables.held
    clear(work.border, 0, stations * frame, token)
    clear(work.condensed, 0, 9 * panels * panels, token)
    clear(work.pivot, (stations - 1) * block, stations * block, token)
    gather_cables(tables, work, rate, size, token)
    start_loads(tables, samples, factors, work, token)
    for station in range(stations - 1, held - 1, -1):
        if station > 0:
            assemble_layer(tables, samples, factors, station - 1, work, station > held, token)
        add_station_mass(tables, samples, factors, station, work, token)
        if station > held:
            add_layer_mass(tables, samples, factors, station - 1, work, token)
        for k in range(size):
            t = station * frame + 3 * k
            store(work.border, t, load(work.border, t, token) + load(work.field, station * size + k, token))
        eliminate(
            work.pivot, work.coupling, work.border, work.condensed, station, station == held, tiles, panels, token
        )
    _tensions(cables, panels, work, rate, tolerance, regularisation, token)
    back_substitute(
        work.pivot,
        work.coupling,
        work.border,
        work.weight,
        cables + 1,
        work.solution,
        held,
        stations,
        tiles,
        panels,
        token,
    )


@numba.njit(nogil=True, error_model="numpy")
def _near(tables, work, time_step, token):
    """``accepted`` = 1 in the lanes whose step is finite and leaves every node near its place at rest."""
    modes, stations = len(tables.parity), tables.station_mass.shape[0]
    one, zero = fill(1.0, work.position, token), fill(0.0, work.position, token)
    accepted = one
    reach = zero + tables.reach[0]
    for station in range(stations):
        for node in range(modes):
            for i in range(3):
                away = zero
                for m in range(modes):
                    row = 3 * (station * modes + m) + i
                    moved = load(work.position, row, token) - tables.rest[row]
                    moved = moved + time_step * (load(work.velocity, row, token) + load(work.solution, row, token))
                    away = away + moved * tables.shape[node, m]
                away = where_greater(away, zero, away, -away)
                accepted = where_greater(reach, away, accepted, zero)
    for c in range(len(tables.rest_length)):
        accepted = where_greater(zero + LARGEST, load(work.tension, c, token), accepted, zero)
    store(work.accepted, 0, accepted)


@numba.njit(nogil=True, error_model="numpy")
def accept(tables, work, time_step, token):
    """Take the step x += h (v + solution); where it is lost, stay in place at rest without tension."""
    _near(tables, work, time_step, token)
    zero = fill(0.0, work.position, token)
    accepted = load(work.accepted, 0, token)
    for row in range(work.position.shape[0]):
        x = load(work.position, row, token)
        v = load(work.velocity, row, token) + load(work.solution, row, token)
        store(work.velocity, row, where_greater(accepted, zero, v, zero))
        store(work.position, row, where_greater(accepted, zero, x + time_step * v, x))
    for c in range(len(tables.rest_length)):
        store(work.tension, c, where_greater(accepted, zero, load(work.tension, c, token), zero))
    store(work.unsolved, 0, where_greater(accepted, zero, load(work.unsolved, 0, token), zero))
