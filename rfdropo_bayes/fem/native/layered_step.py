"""One linear solve for a layered body in SIMD lanes, and the step it makes: a stage or a static iteration.

``stage`` is that of ``fem.integrators``, in seconds.
"""

from __future__ import annotations

from rfdropo_bayes.fem.integrators import EULER
from rfdropo_bayes.fem.native.chain_cholesky import combine_border, eliminate, substitute_back, substitute_forward
from rfdropo_bayes.fem.native.constraint_problem import soften, solve_problem
from rfdropo_bayes.fem.native.fields import clear, point
from rfdropo_bayes.fem.native.layered_assembly import (
    add_mass,
    add_momentum,
    assemble_layer,
    start_loads,
    subtract_tangent_product,
)
from rfdropo_bayes.fem.native.layered_effects import GAIN, GIVE, SHARE, SURROUNDED, add_surroundings
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, load3, square_root, store, where_greater
from rfdropo_bayes.fem.native.stiffening_kernels import resist_lateral, stiffen, sum_cable_forces

LARGEST = 1e30
"""Tensions beyond this [N] are not finite."""


@kernel
def set_factors(samples, factors, work, stage, wide, token):
    """Factors of a stage, which impacts make so much longer."""
    loss = load(work.loss, 0, token)
    length, drag = fill(stage.length, samples.damping, token) * wide, load(samples.damping, 0, token) * loss
    one, gain = fill(1.0, drag, token), load(samples.effects, GAIN, token)
    softness = load(work.softness, 0, token) * load(work.firmness, 0, token)
    damping = load(samples.damping, 1, token) * loss
    lookahead = length * (one + gain) + damping
    behind = damping if stage.predicted else lookahead
    store(factors.elasticity, 0, length * lookahead * softness)
    store(factors.inertia, 0, fma(length, drag, one))
    store(factors.force, 0, length)
    store(factors.strain, 0, length * softness)
    store(factors.strain_rate, 0, length * behind * softness)
    store(factors.drag, 0, length * drag)
    store(factors.fluid, 0, length)
    store(factors.branch, 0, length * softness * gain)
    store(factors.share, 0, load(samples.effects, SHARE, token) * (1.0 + stage.carried))
    store(factors.wide, 0, wide)
    store(factors.narrow, 0, one / wide)
    store(factors.going, 0, (one - wide) + stage.carried)
    store(factors.give, 0, load(samples.effects, GIVE, token) / (length * length))


@kernel
def pull_guide(tables, g, border, row, panels, x, y, z, velocity, token):
    """Add a pull on a guide to a row of a border of so many panels; returns it times the guide's velocity."""
    size, moving = 3 * tables.modes, fill(0.0, border, token)
    first = row // 3 * 3 * size + row % 3
    for k in range(tables.guide_first[g], tables.guide_first[g + 1]):
        place, weight = tables.guide_place[k], fill(tables.guide_weight[k], border, token)
        t = first + 3 * (tables.guide_station[k] * (panels - 1) * size + place)
        store(border, t, fma(x, weight, load(border, t, token)))
        store(border, t + 3, fma(y, weight, load(border, t + 3, token)))
        store(border, t + 6, fma(z, weight, load(border, t + 6, token)))
        along = fma(y, load(velocity, place + 1, token), z * load(velocity, place + 2, token))
        moving = fma(weight, fma(x, load(velocity, place, token), along), moving)
    return moving


@kernel
def _pull_cable(tables, g, c, work, x, y, z, token):
    """As `pull_guide`, by cable c; the pull is kept."""
    store(work.pull, 3 * g, x, y, z)
    return pull_guide(tables, g, work.border, c + 1, (tables.cables + 3) // 3, x, y, z, work.velocity, token)


@kernel
def _gather_cable(tables, c, work, token):
    """Border row dl/dx of a cable; returns how much shorter than at rest it is, and dl/dt."""
    x, one = work.position, fill(1.0, work.position, token)
    px, py, pz = (
        fill(tables.anchor[3 * c], x, token),
        fill(tables.anchor[3 * c + 1], x, token),
        fill(tables.anchor[3 * c + 2], x, token),
    )
    bx, by, bz = fill(0.0, x, token), fill(0.0, x, token), fill(0.0, x, token)
    shorter, growth = fill(tables.rest_length[c], x, token), fill(0.0, x, token)
    first, last = tables.cable_first[c], tables.cable_first[c + 1]
    for g in range(first, last):
        gx, gy, gz = point(tables.guide_first, tables.guide_place, tables.guide_weight, g, x, token)
        dx, dy, dz = gx - px, gy - py, gz - pz
        segment = square_root(fma(dx, dx, fma(dy, dy, dz * dz)))
        shorter = shorter - segment
        scale = one / segment
        dx, dy, dz = dx * scale, dy * scale, dz * scale
        if g > first:
            growth = growth + _pull_cable(tables, g - 1, c, work, bx - dx, by - dy, bz - dz, token)
        px, py, pz, bx, by, bz = gx, gy, gz, dx, dy, dz
    return shorter, growth + _pull_cable(tables, last - 1, c, work, bx, by, bz, token)


@kernel
def gather_cables(tables, work, rate, predicted, token):
    """Border rows dl/dx of all cables; ``slack`` = rate * (commanded length - length) - dl/dt, the last one where it
    is not ``predicted`` already."""
    for c in range(tables.cables):
        shorter, growth = _gather_cable(tables, c, work, token)
        slack = (shorter - load(work.commanded, c, token)) * rate
        if not predicted:
            slack = slack - growth
        store(work.slack, c, slack)


@kernel
def _condensed_entry(condensed, i, j, panels, token):
    """Entry i >= j of b_i' A^-1 b_j, from its negative in tiles."""
    return -load(condensed, 9 * (i // 3 * panels + j // 3) + 3 * (j % 3) + i % 3, token)


@kernel
def start_problem(tables, factors, work, p, n, rate, token):
    """The cables' part of a problem of ``n`` rows: their tensions before, W, and the velocities without impulses."""
    cables, panels = tables.cables, (tables.cables + 3) // 3
    give, wide = load(factors.give, 0, token), load(factors.wide, 0, token)
    for c in range(cables):
        store(p.impulse, c, load(work.tension, c, token) * (1.0 / rate) * wide)
        store(p.free, c, load(work.slack, c, token) - _condensed_entry(work.condensed, c + 1, 0, panels, token))
        for d in range(c + 1):
            value = _condensed_entry(work.condensed, c + 1, d + 1, panels, token)
            store(p.matrix, c * n + d, value + give if c == d else value)
            store(p.matrix, d * n + c, load(p.matrix, c * n + d, token))


@kernel
def weigh_border(cables, work, p, token):
    """The weights of the border rows in ``weight``, and lanes left unsolved."""
    zero = fill(0.0, work.weight, token)
    store(work.weight, 0, fill(1.0, work.weight, token))
    store(work.unsolved, 0, load(p.going, 0, token))
    for c in range(cables):
        impulse = load(p.impulse, c, token)
        impulse = where_greater(zero, impulse, zero, impulse)
        store(work.weight, c + 1, -impulse)


@kernel
def take_tensions(cables, factors, work, rate, token):
    """Tensions [N] from the impulses in ``weight``."""
    for c in range(cables):
        store(work.tension, c, -rate * load(work.weight, c + 1, token) * load(factors.narrow, 0, token))


@kernel
def _go_on(tables, samples, factors, work, token):
    """Add to ``field`` a share of what the stage before did, without the impacts in it."""
    zero, share = fill(0.0, work.field, token), load(factors.going, 0, token)
    add_momentum(tables, samples, zero, -share, work.before, work.field, token)
    for row in range(3 * tables.modes * tables.stations):
        store(work.field, row, fnma(load(work.sudden, row, token), share, load(work.field, row, token)))


@kernel
def condense_increment(tables, samples, factors, work, stage, token):
    """Assemble and eliminate the matrix station by station."""
    rate, predicted = 1.0 / stage.length, stage.predicted
    wide, narrow = load(factors.wide, 0, token), load(factors.narrow, 0, token)
    square = fill(1.0 / (rate * rate), wide, token) * (wide * wide)
    tiles, stations, cables, held = tables.modes, tables.stations, tables.cables, tables.held
    size, panels = 3 * tiles, (cables + 3) // 3
    frame, block = 3 * panels * size, 3 * tiles * size
    inertia = load(factors.inertia, 0, token)
    clear(work.border, 0, stations * frame, token)
    clear(work.condensed, 0, 9 * panels * panels, token)
    clear(work.pivot, (stations - 1) * block, stations * block, token)
    gather_cables(tables, work, fill(rate, wide, token) * narrow, predicted, token)
    start_loads(tables, samples, factors, work, token)
    if stage.carried > 0.0:
        _go_on(tables, samples, factors, work, token)
    sum_cable_forces(tables, work, token)
    for station in range(stations - 1, held - 1, -1):
        last = station == held
        if station > 0:
            assemble_layer(tables, samples, factors, station - 1, square, predicted, work, not last, token)
            stiffen(tables, factors, station - 1, rate, work, not last, token)
            if not predicted:
                resist_lateral(tables, station - 1, work.velocity, work.field, work, token)
        entry, t = station * tables.pairs, station * block
        add_mass(tables.parity, tiles, work.pivot, t, samples.station_mass, entry, inertia, True, token)
        if not last:
            entry = (station - 1) * tables.coupled
            add_mass(tables.parity, tiles, work.coupling, t, samples.layer_mass, entry, inertia, False, token)
        if samples.present[SURROUNDED]:
            add_surroundings(tables, samples, factors, station, predicted, work, token)
        for k in range(size):
            t = station * frame + 3 * k
            store(work.border, t, load(work.border, t, token) + load(work.field, station * size + k, token))
        eliminate(work.pivot, work.coupling, work.border, work.condensed, station, last, tiles, panels, token)


@kernel
def weigh_rows(tables, work, token):
    """``solution`` = the weighted sum of the border rows, where the back substitution starts."""
    size, stations, panels = 3 * tables.modes, tables.stations, (tables.cables + 3) // 3
    combine_border(work.border, work.weight, work.solution, tables.held, stations, size, panels, token)


@kernel
def substitute_increment(tables, work, token):
    """``solution`` = A^-1 times what it is."""
    substitute_back(work.pivot, work.coupling, work.solution, tables.held, tables.stations, tables.modes, token)


@kernel
def solve_statics(tables, samples, factors, work, p, schedule, token):
    """``solution`` = A^-1 (r - J' T) and the tensions, of a body at rest that nothing but cables holds."""
    condense_increment(tables, samples, factors, work, EULER, token)
    start_problem(tables, factors, work, p, tables.cables, 1.0, token)
    soften(p, tables.cables, 0, 0, 1.0, schedule.softness, token)
    solve_problem(p, tables.cables, 0, 0, schedule.settled, False, token)
    weigh_border(tables.cables, work, p, token)
    take_tensions(tables.cables, factors, work, 1.0, token)
    weigh_rows(tables, work, token)
    substitute_increment(tables, work, token)


@kernel
def _subtract_cables(tables, work, field, token):
    """Subtract J' T h from a field, after the tensions are known."""
    for c in range(tables.cables):
        impulse = load(work.weight, c + 1, token)
        for g in range(tables.cable_first[c], tables.cable_first[c + 1]):
            x, y, z = load3(work.pull, 3 * g, token)
            for k in range(tables.guide_first[g], tables.guide_first[g + 1]):
                row, w = tables.guide_place[k], impulse * tables.guide_weight[k]
                store(field, row, fma(x, w, load(field, row, token)), fma(y, w, load(field, row + 1, token)))
                store(field, row + 2, fma(z, w, load(field, row + 2, token)))


@kernel
def refine_increment(tables, samples, factors, work, token):
    """Improve ``solution`` by what the layers leave of its right-hand side, at the tensions found.

    A sum of stiff layers, nearly incompressible ones above all, drowns in its rounding the small stiffness with which
    the whole body bends. The product of each layer on its own does not.
    """
    size, first = 3 * tables.modes, 3 * tables.modes * tables.held
    last = size * tables.stations
    for row in range(last):
        store(work.correction, row, load(work.field, row, token))
    _subtract_cables(tables, work, work.correction, token)
    subtract_tangent_product(tables, samples, factors, work.solution, work.correction, work, token)
    substitute_forward(work.pivot, work.coupling, work.correction, tables.held, tables.stations, tables.modes, token)
    substitute_back(work.pivot, work.coupling, work.correction, tables.held, tables.stations, tables.modes, token)
    for row in range(first, last):
        store(work.solution, row, load(work.solution, row, token) + load(work.correction, row, token))


@kernel
def _move(work, row, length, predicted, token):
    """Position after a stage; the step length may be zero."""
    x, d = load(work.position, row, token), load(work.solution, row, token)
    if predicted:
        return fma(length, d, x)
    return fma(length, load(work.velocity, row, token) + d, x)


@kernel
def _away(tables, work, row, length, predicted, token):
    """How far a stage leads from the place at rest."""
    away, d = load(work.position, row, token) - tables.rest[row], load(work.solution, row, token)
    if predicted:
        return fma(length, d, away)
    return fma(length, load(work.velocity, row, token) + d, away)


@kernel
def near(tables, work, length, predicted, token):
    """One in the lanes whose stage is finite and leaves every node near its place at rest, zero elsewhere."""
    modes, one, zero = tables.modes, fill(1.0, work.position, token), fill(0.0, work.position, token)
    accepted, reach = one, fill(tables.reach, work.position, token)
    for station in range(tables.stations):
        base = 3 * station * modes
        for node in range(modes):
            for i in range(3):
                away = zero
                for m in range(modes):
                    row = base + 3 * m + i
                    moved = _away(tables, work, row, length, predicted, token)
                    away = fma(moved, fill(tables.shape[node * modes + m], one, token), away)
                away = where_greater(away, zero, away, -away)
                accepted = where_greater(reach, away, accepted, zero)
    for c in range(tables.cables):
        accepted = where_greater(zero + LARGEST, load(work.tension, c, token), accepted, zero)
    return accepted


@kernel
def take_stage(tables, factors, work, stage, token):
    """Take the stage: velocity + solution, and where that leads; where it is lost, stay in place at rest without
    tension. ``before`` is the change of velocity."""
    zero = fill(0.0, work.position, token)
    length = fill(stage.length, work.position, token) * load(factors.wide, 0, token)
    accepted = near(tables, work, length, stage.predicted, token)
    store(work.accepted, 0, accepted)
    for row in range(3 * tables.modes * tables.stations):
        x, moved = load(work.position, row, token), _move(work, row, length, stage.predicted, token)
        old, change = load(work.velocity, row, token), load(work.solution, row, token)
        if stage.predicted:
            x = fnma(old, stage.elapsed, x)
            store(work.before, row, where_greater(accepted, zero, change, zero))
        store(work.velocity, row, where_greater(accepted, zero, old + change, zero))
        store(work.position, row, where_greater(accepted, zero, moved, x))
    for c in range(tables.cables):
        store(work.tension, c, where_greater(accepted, zero, load(work.tension, c, token), zero))
    store(work.lost, 0, where_greater(accepted, zero, load(work.lost, 0, token), fill(1.0, zero, token)))
    failed = where_greater(accepted, zero, load(work.unsolved, 0, token), zero)
    store(work.failed, 0, where_greater(failed, zero, failed, load(work.failed, 0, token)))
