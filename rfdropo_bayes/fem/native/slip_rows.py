"""Cable friction in SIMD lanes: what ``fem.cable_friction`` makes of the shape of a body and of a step."""

from __future__ import annotations

from rfdropo_bayes.fem.cable_friction import FADING, PRESLIDING, SLACK, STRAIGHT
from rfdropo_bayes.fem.native.fields import clear, point
from rfdropo_bayes.fem.native.layered_effects import CAPSTAN, COULOMB, FRICTION
from rfdropo_bayes.fem.native.layered_records import KINDS
from rfdropo_bayes.fem.native.layered_step import pull_guide
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, load3, square_root, store, where_greater


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
            store(friction.direction, 3 * g, dx * scale, dy * scale, dz * scale)
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
            middle = 0.5 * (load(friction.segment, g, token) + load(friction.segment, g + 1, token)) + SLACK
            for k in range(kinds):
                value = middle / (middle + FADING) if kind + k == 0 else middle * _wrap_angle(friction, g, token)
                store(friction.weight, k * runs.guides + g, value)


@kernel
def _gather_run(tables, runs, friction, r, kind, border, panels, work, token):
    """Border row of a run; returns how fast the guides move along it."""
    zero, one = fill(0.0, border, token), fill(1.0, border, token)
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
        x, y, z = load3(friction.direction, 3 * g, token)
        x, y, z = before * x, before * y, before * z
        if g < tied:
            u, v, w = load3(friction.direction, 3 * g + 3, token)
            x, y, z = x - beyond * u, y - beyond * v, z - beyond * w
        moving = moving + pull_guide(tables, g, border, row, panels, x, y, z, work.velocity, token)
        before = beyond
    return moving


@kernel
def gather_slip(tables, runs, samples, factors, friction, border, panels, p, work, time_step, token):
    """Border rows of all runs, and their part of a step's problem."""
    kinds, kind = kinds_present(samples)
    _find_directions(tables, work, friction, token)
    _weigh_guides(runs, friction, kinds, kind, token)
    for k in range(kinds):
        coefficient = time_step * load(samples.effects, COULOMB if kind + k == 0 else CAPSTAN, token)
        coefficient = coefficient * load(factors.wide, 0, token)
        for r in range(runs.count):
            row = k * runs.count + r
            line = tables.cables + row
            store(p.free, line, _gather_run(tables, runs, friction, r, k, border, panels, work, token))
            limit, mobilised = coefficient * load(friction.whole, row, token), load(friction.mobilised, row, token)
            store(p.limit, line, limit)
            store(p.trial, line, mobilised)
            store(p.impulse, line, limit * mobilised)


@kernel
def start_slip(tables, runs, friction, work, token):
    """Friction that is not mobilised yet, tensions the same all along a cable."""
    clear(friction.mobilised, 0, KINDS * runs.count, token)
    for c in range(tables.cables):
        for g in range(tables.cable_first[c], tables.cable_first[c + 1]):
            store(friction.segment, g, load(work.tension, c, token))


@kernel
def sum_losses(tables, runs, samples, friction, p, token):
    """``lost``: what every cable has lost before and at each of its guides."""
    kinds, _ = kinds_present(samples)
    zero, one = fill(0.0, friction.lost, token), fill(1.0, friction.lost, token)
    for g in range(runs.guides):
        store(friction.lost, g, zero)
    for k in range(kinds):
        for r in range(runs.count):
            row = k * runs.count + r
            whole = load(friction.whole, row, token)
            share = load(p.impulse, tables.cables + row, token) / where_greater(whole, zero, whole, one)
            for g in range(runs.first[r], runs.last[r]):
                weight = load(friction.weight, k * runs.guides + g, token)
                store(friction.lost, g, fma(weight, share, load(friction.lost, g, token)))
    for c in range(tables.cables):
        before = zero
        for g in range(tables.cable_first[c], tables.cable_first[c + 1]):
            before = before + load(friction.lost, g, token)
            store(friction.lost, g, before)


@kernel
def add_friction(tables, friction, field, token):
    """Add the impulses on the guides to a field."""
    for c in range(tables.cables):
        before, tied = fill(0.0, friction.lost, token), tables.cable_first[c + 1] - 1
        for g in range(tables.cable_first[c], tied + 1):
            after = load(friction.lost, g, token)
            for k in range(tables.guide_first[g], tables.guide_first[g + 1]):
                weight = tables.guide_weight[k]
                for i in range(3):
                    row = tables.guide_place[k] + i
                    push = before * load(friction.direction, 3 * g + i, token)
                    if g < tied:
                        push = fnma(after, load(friction.direction, 3 * g + 3 + i, token), push)
                    store(field, row, fma(push, weight, load(field, row, token)))
            before = after


@kernel
def remember_slip(tables, factors, friction, p, work, rows, time_step, going, token):
    """Friction mobilised and tensions along the cables after a stage that was taken.

    ``going`` is the share of its change with which mobilised friction goes on into the next stage.
    """
    zero, one, accepted = fill(0.0, work.tension, token), fill(1.0, work.tension, token), load(work.accepted, 0, token)
    for i in range(rows):
        line, before = tables.cables + i, load(friction.mobilised, i, token)
        share = fnma(load(p.velocity, line, token), time_step / PRESLIDING, before)
        share = where_greater(share, one, one, share)
        share = where_greater(-one, share, -one, share)
        if going > 0.0:
            share = fma(share - before, going, share)
            share = where_greater(share, one, one, share)
            share = where_greater(-one, share, -one, share)
        store(friction.mobilised, i, where_greater(accepted, zero, share, before))
    for c in range(tables.cables):
        left = load(work.tension, c, token)
        for g in range(tables.cable_first[c], tables.cable_first[c + 1]):
            tension = where_greater(left, zero, left, zero)
            store(friction.segment, g, where_greater(accepted, zero, tension, load(friction.segment, g, token)))
            lost = load(friction.lost, g, token) * (1.0 / time_step) * load(factors.narrow, 0, token)
            left = load(work.tension, c, token) - lost
