"""Rows of cable friction in SIMD lanes: what ``fem.cable_friction.slip_problem`` makes of the shape of a body."""

from __future__ import annotations

from rfdropo_bayes.fem.cable_friction import FADING, STRAIGHT
from rfdropo_bayes.fem.native.chain_cholesky import condense_rows, extend_border
from rfdropo_bayes.fem.native.layered_assembly import clear
from rfdropo_bayes.fem.native.layered_effects import CAPSTAN, COULOMB, FRICTION
from rfdropo_bayes.fem.native.layered_step import point
from rfdropo_bayes.fem.native.simd import fill, fma, kernel, load, square_root, store, where_greater


@kernel
def kinds_present(samples):
    """How many kinds of friction a batch has, and the first of them."""
    coulomb, capstan = samples.present[FRICTION], samples.present[FRICTION + 1]
    return coulomb + capstan, 0 if coulomb else 1


@kernel
def _find_directions(tables, work, friction, token):
    """Unit vectors from the point before to every guide."""
    one = fill(1.0, work.position, token)
    for c in range(tables.cables):
        x, y, z = one * tables.anchor[3 * c], one * tables.anchor[3 * c + 1], one * tables.anchor[3 * c + 2]
        for g in range(tables.cable_first[c], tables.cable_first[c + 1]):
            px, py, pz = point(tables.guide_first, tables.guide_place, tables.guide_weight, g, work.position, token)
            dx, dy, dz = px - x, py - y, pz - z
            scale = one / square_root(fma(dx, dx, fma(dy, dy, dz * dz)))
            store(friction.direction, 3 * g, dx * scale)
            store(friction.direction, 3 * g + 1, dy * scale)
            store(friction.direction, 3 * g + 2, dz * scale)
            x, y, z = px, py, pz


@kernel
def _wrap_angle(friction, g, token):
    """Angle by which a cable turns at a guide, as ``fem.cable_friction.wrap_angles``."""
    square = fill(STRAIGHT * STRAIGHT, friction.direction, token)
    for i in range(3):
        turn = load(friction.direction, 3 * g + 3 + i, token) - load(friction.direction, 3 * g + i, token)
        square = fma(turn, turn, square)
    one = fill(1.0, friction.direction, token)
    series = fma(square, one * (35.0 / 294912.0), one * (5.0 / 7168.0))
    series = fma(square, series, one * (3.0 / 640.0))
    series = fma(square, series, one * (1.0 / 24.0))
    return square_root(square) * fma(square, series, one)


@kernel
def _weigh_guides(runs, friction, kinds, kind, token):
    """Friction of every guide per coefficient."""
    for r in range(runs.count):
        for g in range(runs.first[r], runs.last[r]):
            middle = 0.5 * (load(friction.segment, g, token) + load(friction.segment, g + 1, token))
            for k in range(kinds):
                value = middle / (middle + FADING) if kind + k == 0 else middle * _wrap_angle(friction, g, token)
                store(friction.weight, k * runs.guides + g, value)


@kernel
def _pull_guide(tables, friction, g, row, panels, x, y, z, work, token):
    """Add a pull on a guide to a border row; returns it times the guide's velocity."""
    border, size = friction.border, 3 * tables.modes
    moving = fill(0.0, border, token)
    for k in range(tables.guide_first[g], tables.guide_first[g + 1]):
        place, weight = tables.guide_place[k], fill(tables.guide_weight[k], border, token)
        t = ((place // size * panels + row // 3) * size + place % size) * 3 + row % 3
        store(border, t, fma(x, weight, load(border, t, token)))
        store(border, t + 3, fma(y, weight, load(border, t + 3, token)))
        store(border, t + 6, fma(z, weight, load(border, t + 6, token)))
        along = fma(y, load(work.velocity, place + 1, token), z * load(work.velocity, place + 2, token))
        moving = fma(weight, fma(x, load(work.velocity, place, token), along), moving)
    return moving


@kernel
def _gather_run(tables, runs, friction, r, kind, panels, work, token):
    """Border row of a run; returns how fast the guides move along it."""
    zero, one = fill(0.0, friction.border, token), fill(1.0, friction.border, token)
    row, whole = kind * runs.count + r, zero
    for g in range(runs.first[r], runs.last[r]):
        whole = whole + load(friction.weight, kind * runs.guides + g, token)
    store(friction.whole, row, whole)
    inverse = one / where_greater(whole, zero, whole, one)
    before, moving, tied = zero, zero, tables.cable_first[runs.cable[r] + 1] - 1
    for g in range(runs.first[r], tied + 1):
        beyond = before
        if g < runs.last[r]:
            beyond = fma(load(friction.weight, kind * runs.guides + g, token), inverse, before)
        x, y, z = (
            before * load(friction.direction, 3 * g, token),
            before * load(friction.direction, 3 * g + 1, token),
            before * load(friction.direction, 3 * g + 2, token),
        )
        if g < tied:
            x = x - beyond * load(friction.direction, 3 * g + 3, token)
            y = y - beyond * load(friction.direction, 3 * g + 4, token)
            z = z - beyond * load(friction.direction, 3 * g + 5, token)
        moving = moving + _pull_guide(tables, friction, g, row, panels, x, y, z, work, token)
        before = beyond
    return moving


@kernel
def gather_slip(tables, runs, samples, friction, work, time_step, token):
    """Rows, strength and free slip of all runs, condensed with the factor of the step; returns how many there are."""
    modes, held, stations, cables = tables.modes, tables.held, tables.stations, tables.cables
    kinds, kind = kinds_present(samples)
    rows, others, size = kinds * runs.count, (cables + 3) // 3, 3 * modes
    panels = (rows + 2) // 3
    clear(friction.border, 0, 9 * stations * panels * modes, token)
    _find_directions(tables, work, friction, token)
    _weigh_guides(runs, friction, kinds, kind, token)
    for k in range(kinds):
        coefficient = time_step * load(samples.effects, COULOMB if kind + k == 0 else CAPSTAN, token)
        for r in range(runs.count):
            row = k * runs.count + r
            store(friction.slip, row, -time_step * _gather_run(tables, runs, friction, r, k, panels, work, token))
            store(friction.strength, row, coefficient * load(friction.whole, row, token))
    extend_border(work.pivot, work.coupling, friction.border, held, stations - 1, modes, panels, token)
    condense_rows(friction.own, friction.border, panels, friction.border, panels, held, stations - 1, size, token)
    condense_rows(friction.across, friction.border, panels, work.border, others, held, stations - 1, size, token)
    for i in range(rows):
        t = 9 * (i // 3 * others) + i % 3
        moved = load(friction.across, t, token)
        store(friction.slip, i, load(friction.slip, i, token) + time_step * moved)
        for c in range(cables):
            entry = load(friction.across, t + 9 * ((c + 1) // 3) + 3 * ((c + 1) % 3), token)
            store(friction.pull, i * cables + c, -(entry * load(work.scale, c, token)))
        for j in range(i + 1):
            entry = -load(friction.own, 9 * (i // 3 * panels + j // 3) + 3 * (j % 3) + i % 3, token)
            store(friction.among, i * rows + j, entry)
            store(friction.among, j * rows + i, entry)
    return rows
