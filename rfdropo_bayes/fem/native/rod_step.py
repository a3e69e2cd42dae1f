"""One linear solve for a rod in SIMD lanes, and the step it makes: a stage or a static iteration.

``stage`` is a stage of ``fem.integrators``, in seconds.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.chain_cholesky import BLOCK, PANEL, combine_border, eliminate, substitute_back
from rfdropo_bayes.fem.native.fields import clear
from rfdropo_bayes.fem.native.rod_assembly import add_going, add_station_loads, add_station_mass, assemble_element
from rfdropo_bayes.fem.native.rod_effects import GAIN, GIVE, SHARE, SURROUNDED, add_surroundings
from rfdropo_bayes.fem.native.rod_tables import FRAME, SIZE
from rfdropo_bayes.fem.native.simd import (
    fill,
    fma,
    fnma,
    kernel,
    load,
    load3,
    magnitude,
    square_root,
    store,
    where_greater,
)
from rfdropo_bayes.fem.native.vectors import added, cross, dot, minus, plus, put, scaled

LARGEST = 1e30
"""Tensions beyond this [N], and rotations beyond it [rad], are not finite."""


@kernel
def turn_station(work, station, a, token):
    """Turn a section by a rotation vector in space, accurate to fifth order in the angle."""
    t, one = 4 * station, fill(1.0, work.turn, token)
    a = scaled(a, fma(dot(a, a), 1.0 / 24.0, 0.5 * one))
    w, q = load(work.turn, t, token), load3(work.turn, t + 1, token)
    turned = plus(q, added(a, w, cross(a, q)))
    scalar = w - dot(a, q)
    scale = one / square_root(fma(scalar, scalar, dot(turned, turned)))
    store(work.turn, t, scalar * scale)
    put(work.turn, t + 1, scaled(turned, scale))


@kernel
def place_directors(work, station, token):
    """Directors of a section from its quaternion."""
    t, frame, one = 4 * station, FRAME * station + 3, fill(1.0, work.turn, token)
    w, (x, y, z) = load(work.turn, t, token), load3(work.turn, t + 1, token)
    s, xs, ys, zs = w + w, x + x, y + y, z + z
    put(work.frame, frame, (fnma(ys, y, fnma(zs, z, one)), fma(xs, y, s * z), fnma(s, y, xs * z)))
    put(work.frame, frame + 3, (fnma(s, z, xs * y), fnma(xs, x, fnma(zs, z, one)), fma(ys, z, s * x)))
    put(work.frame, frame + 6, (fma(xs, z, s * y), fnma(s, x, ys * z), fnma(xs, x, fnma(ys, y, one))))


@kernel
def set_factors(samples, factors, work, stage, wide, token):
    """Factors by which impacts lengthen a stage."""
    loss = load(work.loss, 0, token)
    length, drag = fill(stage.length, samples.damping, token) * wide, load(samples.damping, 0, token) * loss
    one, gain = fill(1.0, drag, token), load(samples.effects, GAIN, token)
    softness = load(work.softness, 0, token) * load(work.firmness, 0, token)
    damping = load(samples.damping, 1, token) * loss
    lookahead = length * (one + gain) + damping
    behind = damping if stage.predicted else lookahead
    store(factors.elasticity, 0, length * lookahead * softness)
    store(factors.held, 0, length * length)
    store(factors.inertia, 0, fma(length, drag, one))
    store(factors.force, 0, length)
    store(factors.strain, 0, length * softness)
    store(factors.strain_rate, 0, length * behind * softness)
    store(factors.drag, 0, length * drag)
    store(factors.branch, 0, length * softness * gain)
    store(factors.share, 0, load(samples.effects, SHARE, token) * (1.0 + stage.carried))
    store(factors.wide, 0, wide)
    store(factors.narrow, 0, one / wide)
    store(factors.going, 0, (one - wide) + stage.carried)
    store(factors.give, 0, load(samples.effects, GIVE, token) / (length * length))


@kernel
def _guide_point(tables, g, work, token):
    """Place of a guide; keeps the arms of its entries in space, and their sum."""
    zero = fill(0.0, work.frame, token)
    point = offset = zero, zero, zero
    for k in range(tables.guide_first[g], tables.guide_first[g + 1]):
        frame = FRAME * tables.guide_station[k]
        lever = zero, zero, zero
        for i in range(3):
            arm = tables.guide_arm[3 * k + i]
            if arm != 0.0:
                lever = added(load3(work.frame, frame + 3 + 3 * i, token), arm, lever)
        put(work.lever, 3 * k, lever)
        offset = plus(offset, lever)
        point = plus(point, added(load3(work.frame, frame, token), tables.guide_weight[k], lever))
    put(work.offset, 3 * g, offset)
    return point


@kernel
def pull_guide(tables, g, border, row, panels, pull, work, token):
    """Add a pull on a guide to a row of a border of ``panels`` panels; returns it times the guide's velocity."""
    moving, first = fill(0.0, border, token), row // 3 * PANEL + row % 3
    for k in range(tables.guide_first[g], tables.guide_first[g + 1]):
        station, push = tables.guide_station[k], scaled(pull, tables.guide_weight[k])
        moment, v = cross(load3(work.lever, 3 * k, token), pull), SIZE * station
        t = first + station * panels * PANEL
        for i in range(3):
            store(border, t + 3 * i, load(border, t + 3 * i, token) + push[i])
            store(border, t + 9 + 3 * i, load(border, t + 9 + 3 * i, token) + moment[i])
        moving = moving + dot(push, load3(work.velocity, v, token))
        moving = moving + dot(moment, load3(work.velocity, v + 3, token))
    return moving


@kernel
def _measure_way(near, g, distance, work, token):
    """Length of the way to a guide at a distance from the point before, and its derivative over the distance."""
    one, limit = fill(1.0, work.frame, token), fill(near, work.frame, token)
    share = distance * (1.0 / near)
    square, far = share * share, one / distance
    length = fma(square, fma(square, -0.125 * one, 0.75 * one), 0.375 * one) * near
    inverse = fma(square, -0.5 * one, 1.5 * one) * (1.0 / near)
    sharp = one / (inverse * inverse * (near * near * near))
    length = where_greater(distance, limit, distance, length)
    inverse = where_greater(distance, limit, far, inverse)
    store(work.course, g, length)
    store(work.inverse, g, inverse)
    store(work.sharp, g, where_greater(distance, limit, far, sharp))
    return length, inverse


@kernel
def _gather_cable(tables, c, work, token):
    """Border row dl/dx of a cable; returns how much shorter than at rest it is, and dl/dt."""
    x, zero = work.frame, fill(0.0, work.frame, token)
    point = fill(tables.anchor[3 * c], x, token), fill(tables.anchor[3 * c + 1], x, token), zero
    point = point[0], point[1], fill(tables.anchor[3 * c + 2], x, token)
    shorter, growth, before, row = fill(tables.rest_length[c], x, token), zero, (zero, zero, zero), tables.row[c]
    first, last = tables.cable_first[c], tables.cable_first[c + 1]
    for g in range(first, last):
        here = _guide_point(tables, g, work, token)
        way = minus(here, point)
        length, inverse = _measure_way(tables.near[g], g, square_root(dot(way, way)), work, token)
        shorter = shorter - length
        way = scaled(way, inverse)
        put(work.direction, 3 * g, way)
        if g > first:
            pull = minus(before, way)
            growth = growth + pull_guide(tables, g - 1, work.border, row, tables.panels, pull, work, token)
        point, before = here, way
    growth = growth + pull_guide(tables, last - 1, work.border, row, tables.panels, before, work, token)
    return shorter, growth


@kernel
def gather_cables(tables, work, rate, predicted, token):
    """Border rows dl/dx of all cables; ``slack`` = rate * (commanded length - length) - dl/dt, the last term only if it
    is not ``predicted`` already.
    """
    clear(work.border, 0, tables.stations * tables.panels * PANEL, token)
    for c in range(tables.cables):
        shorter, growth = _gather_cable(tables, c, work, token)
        slack = (shorter - load(work.commanded, c, token)) * rate
        if not predicted:
            slack = slack - growth
        store(work.slack, c, slack)


@kernel
def _condensed_entry(condensed, i, j, panels, token):
    """Entry (i, j) of b_i' A^-1 b_j, from the lower half of its negative in tiles."""
    if i < j:
        i, j = j, i
    return -load(condensed, 9 * (i // 3 * panels + j // 3) + 3 * (j % 3) + i % 3, token)


@kernel
def start_problem(tables, factors, work, p, n, rate, token):
    """The cables' part of a problem of ``n`` rows: their tensions before, W, and the velocities without impulses."""
    panels, give, wide = tables.panels, load(factors.give, 0, token), load(factors.wide, 0, token)
    for c in range(tables.cables):
        row = tables.row[c]
        store(p.impulse, c, load(work.tension, c, token) * (1.0 / rate) * wide)
        store(p.free, c, load(work.slack, c, token) - _condensed_entry(work.condensed, row, 0, panels, token))
        for d in range(c + 1):
            value = _condensed_entry(work.condensed, row, tables.row[d], panels, token)
            store(p.matrix, c * n + d, value + give if c == d else value)
            store(p.matrix, d * n + c, load(p.matrix, c * n + d, token))


@kernel
def weigh_border(tables, work, p, token):
    """The weights of the border rows in ``weight``, and lanes left unsolved."""
    zero = fill(0.0, work.weight, token)
    store(work.weight, 0, fill(1.0, work.weight, token))
    store(work.unsolved, 0, load(p.going, 0, token))
    for c in range(tables.cables):
        impulse = load(p.impulse, c, token)
        impulse = where_greater(zero, impulse, zero, impulse)
        store(work.weight, tables.row[c], -impulse)


@kernel
def take_tensions(tables, factors, work, rate, token):
    """Tensions [N] from the impulses in ``weight``."""
    for c in range(tables.cables):
        impulse = load(work.weight, tables.row[c], token)
        store(work.tension, c, -rate * impulse * load(factors.narrow, 0, token))


@kernel
def condense_increment(tables, samples, factors, work, stage, still, token):
    """Assemble and eliminate the matrix station by station."""
    rate, predicted = 1.0 / stage.length, stage.predicted
    stations, panels, held, going = tables.stations, tables.panels, tables.held, load(factors.going, 0, token)
    clear(work.condensed, 0, 9 * panels * panels, token)
    clear(work.pivot, (stations - 1) * BLOCK, stations * BLOCK, token)
    clear(work.field, 0, SIZE * stations, token)
    gather_cables(tables, work, fill(rate, work.frame, token) * load(factors.narrow, 0, token), predicted, token)
    for station in range(stations - 1, held - 1, -1):
        last = station == held
        if station > 0:
            assemble_element(tables, samples, factors, station - 1, work, not last, predicted, still, token)
        add_station_mass(tables, samples, factors, station, work, token)
        add_station_loads(tables, samples, factors, station, work, token)
        if stage.carried > 0.0:
            add_going(tables, samples, going, station, work, token)
        if samples.present[SURROUNDED]:
            add_surroundings(tables, samples, factors, station, predicted, work, token)
        for k in range(SIZE):
            t = station * panels * PANEL + 3 * k
            store(work.border, t, load(work.border, t, token) + load(work.field, station * SIZE + k, token))
        eliminate(
            work.pivot, work.coupling, work.border, work.condensed, station, last, panels, tables.active[station], token
        )


@kernel
def weigh_rows(tables, work, token):
    """``solution`` = the weighted sum of the border rows, the start of the back substitution."""
    combine_border(
        work.border, work.weight, work.solution, tables.held, tables.stations, tables.panels, tables.active, token
    )


@kernel
def substitute_increment(tables, work, token):
    """``solution`` = A^-1 ``solution``."""
    substitute_back(work.pivot, work.coupling, work.solution, tables.held, tables.stations, token)


@kernel
def _step_of(work, row, length, predicted, token):
    """Further change of the three values of a row by a stage, from the point at which its forces are taken."""
    change = load3(work.solution, row, token)
    if not predicted:
        change = plus(change, load3(work.velocity, row, token))
    return scaled(change, length)


@kernel
def near(tables, work, length, predicted, token):
    """One in the lanes whose stage is finite and leaves every station near its place at rest, zero elsewhere."""
    accepted, zero = fill(1.0, work.frame, token), fill(0.0, work.frame, token)
    reach, largest = fill(tables.reach, work.frame, token), fill(LARGEST, work.frame, token)
    for station in range(tables.stations):
        there = plus(
            load3(work.frame, FRAME * station, token), _step_of(work, SIZE * station, length, predicted, token)
        )
        turn = _step_of(work, SIZE * station + 3, length, predicted, token)
        rest = zero, zero, fill(tables.rest[station], work.frame, token)
        for i in range(3):
            away = magnitude(there[i] - rest[i], zero)
            accepted = where_greater(reach, away, accepted, zero)
            accepted = where_greater(largest, magnitude(turn[i], zero), accepted, zero)
        accepted = where_greater(largest, magnitude(load(work.turn, 4 * station, token), zero), accepted, zero)
    for c in range(tables.cables):
        accepted = where_greater(largest, load(work.tension, c, token), accepted, zero)
    return accepted


@kernel
def chosen(accepted, a, b):
    """Vector a in the lanes that are accepted, b elsewhere."""
    zero = accepted - accepted
    return (
        where_greater(accepted, zero, a[0], b[0]),
        where_greater(accepted, zero, a[1], b[1]),
        where_greater(accepted, zero, a[2], b[2]),
    )


@kernel
def move_stations(tables, accepted, work, token):
    """Move and turn all stations by ``solution`` in the lanes that are accepted; others keep every bit."""
    zero = fill(0.0, work.frame, token)
    for station in range(tables.held, tables.stations):
        frame, row, t = FRAME * station, SIZE * station, 4 * station
        here, scalar, vector = (
            load3(work.frame, frame, token),
            load(work.turn, t, token),
            load3(work.turn, t + 1, token),
        )
        put(work.frame, frame, chosen(accepted, plus(load3(work.solution, row, token), here), here))
        turn_station(work, station, load3(work.solution, row + 3, token), token)
        store(work.turn, t, where_greater(accepted, zero, load(work.turn, t, token), scalar))
        put(work.turn, t + 1, chosen(accepted, load3(work.turn, t + 1, token), vector))
        place_directors(work, station, token)


@kernel
def predict_stations(tables, time, work, token):
    """Move the stations with their velocity and spin."""
    for station in range(tables.held, tables.stations):
        frame, row = FRAME * station, SIZE * station
        there = added(load3(work.velocity, row, token), time, load3(work.frame, frame, token))
        put(work.frame, frame, there)
        turn_station(work, station, scaled(load3(work.velocity, row + 3, token), time), token)
        place_directors(work, station, token)


@kernel
def take_stage(tables, factors, work, stage, token):
    """Take the stage: velocity + solution, and the resulting position; a failed lane stays in place, at rest without
    tension. ``before`` is the change of velocity.
    """
    zero = fill(0.0, work.frame, token)
    nothing = zero, zero, zero
    length = fill(stage.length, work.frame, token) * load(factors.wide, 0, token)
    accepted = near(tables, work, length, stage.predicted, token)
    store(work.accepted, 0, accepted)
    for station in range(tables.held, tables.stations):
        frame, row = FRAME * station, SIZE * station
        step = _step_of(work, row, length, stage.predicted, token)
        turn = _step_of(work, row + 3, length, stage.predicted, token)
        back, turned = nothing, nothing
        if stage.predicted:
            back = scaled(load3(work.velocity, row, token), -stage.elapsed)
            turned = scaled(load3(work.velocity, row + 3, token), -stage.elapsed)
        put(work.frame, frame, plus(load3(work.frame, frame, token), chosen(accepted, step, back)))
        turn_station(work, station, chosen(accepted, turn, turned), token)
        place_directors(work, station, token)
        for k in range(row, row + SIZE, 3):
            old, change = load3(work.velocity, k, token), load3(work.solution, k, token)
            if stage.predicted:
                put(work.before, k, chosen(accepted, change, nothing))
            put(work.velocity, k, chosen(accepted, plus(old, change), nothing))
    for c in range(tables.cables):
        store(work.tension, c, where_greater(accepted, zero, load(work.tension, c, token), zero))
    store(work.lost, 0, where_greater(accepted, zero, load(work.lost, 0, token), fill(1.0, work.frame, token)))
    failed = where_greater(accepted, zero, load(work.unsolved, 0, token), zero)
    store(work.failed, 0, where_greater(failed, zero, failed, load(work.failed, 0, token)))
