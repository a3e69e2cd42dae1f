"""Static equilibrium of a layered body in SIMD lanes: the iteration of ``fem.equilibrium``, in section modes."""

from __future__ import annotations

from rfdropo_bayes.fem.equilibrium import LONGEST_STEP, SMALLEST_RELAXATION
from rfdropo_bayes.fem.native.fields import clear
from rfdropo_bayes.fem.native.layered_assembly import add_layer_force, layer_frame, start_loads
from rfdropo_bayes.fem.native.layered_effects import GIVE, SURROUNDED, add_surroundings
from rfdropo_bayes.fem.native.layered_step import gather_cables, near
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, magnitude, square_root, store, where_greater

UNBOUNDED = 1e30
"""Relative force out of balance of a lane whose equilibrium was lost."""


@kernel
def _weighted_modes(modes, field, station, i, weights, first, step, token):
    """Sum of component i of a station's modes, with every so manyth weight from ``first`` on."""
    value = fill(0.0, field, token)
    for m in range(modes):
        weight = fill(weights[first + m * step], field, token)
        value = fma(load(field, 3 * (station * modes + m) + i, token), weight, value)
    return value


@kernel
def _farthest(tables, field, token):
    """Largest component of a field at any node."""
    modes, zero = tables.modes, fill(0.0, field, token)
    largest = zero
    for station in range(tables.stations):
        for node in range(modes):
            for i in range(3):
                value = _weighted_modes(modes, field, station, i, tables.shape, node * modes, 1, token)
                value = magnitude(value, zero)
                largest = where_greater(value, largest, value, largest)
    return largest


@kernel
def _node_force(tables, field, station, node, i, token):
    """Component i of the force on a node, in magnitude."""
    value = _weighted_modes(tables.modes, field, station, i, tables.inverse, node, tables.modes, token)
    return magnitude(value, fill(0.0, field, token))


@kernel
def take_increment(tables, work, token):
    """Move by part of the increment: limited in length, relaxed more when it points against the one before."""
    modes, zero, one = tables.modes, fill(0.0, work.position, token), fill(1.0, work.position, token)
    values = 3 * modes * tables.stations
    along, now, before = zero, zero, zero
    for row in range(values):
        square = fill(tables.square[row // 3 % modes], one, token)
        a, b = load(work.solution, row, token), load(work.before, row, token)
        along, now, before = fma(square * a, b, along), fma(square * a, a, now), fma(square * b, b, before)
        store(work.before, row, a)
    change = where_greater(-0.3 * square_root(now * before), along, 0.6 * one, 1.2 * one)
    relaxation = load(work.relaxation, 0, token) * change
    relaxation = where_greater(relaxation, one, one, relaxation)
    relaxation = where_greater(SMALLEST_RELAXATION * one, relaxation, SMALLEST_RELAXATION * one, relaxation)
    store(work.relaxation, 0, relaxation)
    last = 3 * (tables.stations - 1) * modes + 2
    longest = (LONGEST_STEP * (tables.rest[last] - tables.rest[2])) * one
    farthest = _farthest(tables, work.solution, token)
    scale = where_greater(relaxation * farthest, longest, longest / farthest, relaxation)
    for row in range(values):
        store(work.position, row, fma(scale, load(work.solution, row, token), load(work.position, row, token)))


@kernel
def _add_cable_forces(tables, work, token):
    """Add the pull of all cables, whose rows dl/dx are in the border, to ``field``."""
    size, panels = 3 * tables.modes, (tables.cables + 3) // 3
    for c in range(tables.cables):
        row, tension = c + 1, load(work.tension, c, token)
        for station in range(tables.stations):
            for k in range(size):
                t = 3 * size * (station * panels + row // 3) + 3 * k + row % 3
                f = station * size + k
                store(work.field, f, fnma(tension, load(work.border, t, token), load(work.field, f, token)))


@kernel
def _imbalance(tables, samples, factors, work, token):
    """Largest nodal force out of balance relative to the sum of the loads."""
    modes, zero = tables.modes, fill(0.0, work.position, token)
    panels = (tables.cables + 3) // 3
    clear(work.border, 0, 9 * tables.stations * panels * modes, token)
    gather_cables(tables, work, fill(1.0, zero, token), False, token)
    start_loads(tables, samples, factors, work, token)
    loads, largest = zero, zero
    for station in range(tables.stations):
        for node in range(modes):
            for i in range(3):
                loads = loads + _node_force(tables, work.field, station, node, i, token)
    for c in range(tables.cables):
        loads = loads + load(work.tension, c, token)
    if samples.present[SURROUNDED]:
        for station in range(tables.stations):
            add_surroundings(tables, samples, factors, station, False, work, token)
    for layer in range(tables.stations - 1):
        layer_frame(tables, layer, work, token)
        add_layer_force(tables, samples, factors, layer, work, False, token)
    _add_cable_forces(tables, work, token)
    for station in range(tables.held, tables.stations):
        for node in range(modes):
            for i in range(3):
                force = _node_force(tables, work.field, station, node, i, token)
                largest = where_greater(largest, force, largest, force)
    tiny = fill(1e-30, zero, token)
    return largest / where_greater(loads, tiny, loads, tiny)


@kernel
def start_settling(tables, samples, factors, work, token):
    """Make the solves those of a static iteration."""
    one, zero = fill(1.0, factors.force, token), fill(0.0, factors.force, token)
    store(factors.elasticity, 0, load(work.firmness, 0, token))
    store(factors.inertia, 0, zero)
    store(factors.force, 0, one)
    store(factors.strain, 0, load(work.firmness, 0, token))
    store(factors.strain_rate, 0, zero)
    store(factors.drag, 0, zero)
    store(factors.fluid, 0, zero)
    store(factors.branch, 0, zero)
    store(factors.share, 0, zero)
    store(factors.wide, 0, one)
    store(factors.narrow, 0, one)
    store(factors.give, 0, load(samples.effects, GIVE, token))
    clear(work.before, 0, 3 * tables.modes * tables.stations, token)
    store(work.relaxation, 0, one)


@kernel
def finish_settling(tables, samples, factors, work, token):
    """Measure the force out of balance; lanes that are lost go back to rest, with an imbalance beyond any tolerance."""
    values, zero = 3 * tables.modes * tables.stations, fill(0.0, work.position, token)
    imbalance = _imbalance(tables, samples, factors, work, token)
    clear(work.solution, 0, values, token)
    accepted = near(tables, work, zero, False, token)
    accepted = where_greater(UNBOUNDED + zero, imbalance, accepted, zero)
    for row in range(values):
        rest = fill(tables.rest[row], zero, token)
        store(work.position, row, where_greater(accepted, zero, load(work.position, row, token), rest))
    for c in range(tables.cables):
        store(work.tension, c, where_greater(accepted, zero, load(work.tension, c, token), zero))
    store(work.imbalance, 0, where_greater(accepted, zero, imbalance, UNBOUNDED + zero))
