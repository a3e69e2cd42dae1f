"""Cable friction in SIMD lanes: the model of ``fem.cable_friction`` for the shape of a body and for a step."""

from __future__ import annotations

from rfdropo_bayes.fem.cable_friction import FADING, PRESLIDING, SLACK, STRAIGHT
from rfdropo_bayes.fem.native.fields import clear
from rfdropo_bayes.fem.native.rod_effects import CAPSTAN, COULOMB, FRICTION
from rfdropo_bayes.fem.native.rod_records import KINDS
from rfdropo_bayes.fem.native.rod_step import pull_guide
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, load3, square_root, store, where_greater
from rfdropo_bayes.fem.native.vectors import added, scaled


@kernel
def _bounded(share):
    """A share between -1 and 1."""
    one = share - share + 1.0
    share = where_greater(share, one, one, share)
    return where_greater(-one, share, -one, share)


@kernel
def kinds_present(samples):
    """Number of kinds of friction in a batch, and the first kind."""
    coulomb, capstan = samples.present[FRICTION], samples.present[FRICTION + 1]
    return coulomb + capstan, 0 if coulomb else 1


@kernel
def _wrap_angle(direction, g, token):
    """Angle by which a cable turns at a guide, as ``fem.cable_friction.wrap_angles``."""
    square = fill(STRAIGHT * STRAIGHT, direction, token)
    for i in range(3):
        turn = load(direction, 3 * g + 3 + i, token) - load(direction, 3 * g + i, token)
        square = fma(turn, turn, square)
    one = fill(1.0, direction, token)
    series = fma(square, one * (35.0 / 294912.0), one * (5.0 / 7168.0))
    series = fma(square, series, one * (3.0 / 640.0))
    series = fma(square, series, one * (1.0 / 24.0))
    return square_root(square) * fma(square, series, one)


@kernel
def weigh_guides(runs, samples, friction, direction, token):
    """Friction of every guide per coefficient, and of every run."""
    kinds, kind = kinds_present(samples)
    for k in range(kinds):
        for r in range(runs.count):
            whole = fill(0.0, friction.weight, token)
            for g in range(runs.first[r], runs.last[r]):
                middle = 0.5 * (load(friction.segment, g, token) + load(friction.segment, g + 1, token)) + SLACK
                value = middle / (middle + FADING) if kind + k == 0 else middle * _wrap_angle(direction, g, token)
                store(friction.weight, k * runs.guides + g, value)
                whole = whole + value
            store(friction.whole, k * runs.count + r, whole)


@kernel
def _inverse(friction, row, token):
    """One over the friction of a run, or one if there is none."""
    zero, one, whole = (
        fill(0.0, friction.whole, token),
        fill(1.0, friction.whole, token),
        load(friction.whole, row, token),
    )
    return one / where_greater(whole, zero, whole, one)


@kernel
def _gather_run(tables, runs, friction, r, kind, border, panels, work, token):
    """Border row of a run; returns the speed of the guides along it."""
    zero, row = fill(0.0, border, token), kind * runs.count + r
    inverse = _inverse(friction, row, token)
    before, moving, tied = zero, zero, tables.cable_first[runs.cable[r] + 1] - 1
    for g in range(runs.first[r], tied + 1):
        beyond = before
        if g < runs.last[r]:
            beyond = fma(load(friction.weight, kind * runs.guides + g, token), inverse, before)
        pull = scaled(load3(work.direction, 3 * g, token), before)
        if g < tied:
            pull = added(load3(work.direction, 3 * g + 3, token), -beyond, pull)
        moving = moving + pull_guide(tables, g, border, row, panels, pull, work, token)
        before = beyond
    return moving


@kernel
def gather_slip(tables, runs, samples, factors, friction, border, panels, p, work, time_step, token):
    """Border rows of all runs, and their part of a step's problem: friction continues from ``trial``."""
    kinds, kind = kinds_present(samples)
    for k in range(kinds):
        coefficient = time_step * load(samples.effects, COULOMB if kind + k == 0 else CAPSTAN, token)
        coefficient = coefficient * load(factors.wide, 0, token)
        for r in range(runs.count):
            row = k * runs.count + r
            line = tables.cables + row
            store(p.free, line, _gather_run(tables, runs, friction, r, k, border, panels, work, token))
            limit, trial = coefficient * load(friction.whole, row, token), load(friction.trial, row, token)
            store(p.limit, line, limit)
            store(p.trial, line, trial)
            store(p.impulse, line, limit * _bounded(trial))


@kernel
def start_slip(tables, runs, friction, work, token):
    """Friction that is not mobilised yet, tensions the same all along a cable."""
    clear(friction.mobilised, 0, KINDS * runs.count, token)
    for c in range(tables.cables):
        for g in range(tables.cable_first[c], tables.cable_first[c + 1]):
            store(friction.segment, g, load(work.tension, c, token))


@kernel
def sum_losses(tables, runs, samples, friction, p, token):
    """``lost``: tension lost by every cable before and at each of its guides."""
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
def remember_slip(tables, factors, friction, p, work, rows, time_step, going, token):
    """Friction mobilised and tensions along the cables after a stage that was taken.

    ``going`` is the share of its change with which mobilised friction continues in the next stage.
    """
    zero, accepted = fill(0.0, work.tension, token), load(work.accepted, 0, token)
    for i in range(rows):
        line, before = tables.cables + i, load(friction.mobilised, i, token)
        share = fnma(load(p.velocity, line, token), time_step / PRESLIDING, before)
        share = _bounded(share)
        if going > 0.0:
            share = _bounded(fma(share - before, going, share))
        store(friction.mobilised, i, where_greater(accepted, zero, share, before))
    remember_segments(tables, factors, friction, work, 1.0 / time_step, accepted, token)


@kernel
def remember_segments(tables, factors, friction, work, rate, accepted, token):
    """Tensions along the cables from the impulses that they have lost, in the lanes that are accepted."""
    zero = fill(0.0, work.tension, token)
    for c in range(tables.cables):
        left = load(work.tension, c, token)
        for g in range(tables.cable_first[c], tables.cable_first[c + 1]):
            tension = where_greater(left, zero, left, zero)
            store(friction.segment, g, where_greater(accepted, zero, tension, load(friction.segment, g, token)))
            lost = load(friction.lost, g, token) * rate * load(factors.narrow, 0, token)
            left = load(work.tension, c, token) - lost


@kernel
def start_sliding(friction, rows, token):
    """Begin a stage with the friction that is mobilised."""
    for i in range(rows):
        store(friction.trial, i, load(friction.mobilised, i, token))


@kernel
def start_row(tables, runs, samples, friction, work, token):
    """Begin a row at rest: its friction and the ways of its cables, which were gathered."""
    weigh_guides(runs, samples, friction, work.direction, token)
    for g in range(runs.guides):
        store(friction.begun, g, load(work.course, g, token))


@kernel
def slide(tables, runs, friction, rows, work, token):
    """Trial share of mobilised friction at the body's state, without sliding, into ``trial``."""
    for i in range(rows):
        r, k = i % runs.count, i // runs.count
        slip, before = fill(0.0, work.course, token), fill(0.0, work.course, token)
        inverse = _inverse(friction, i, token)
        for g in range(runs.first[r], tables.cable_first[runs.cable[r] + 1]):
            longer = load(work.course, g, token) - load(friction.begun, g, token)
            slip = fma(before, longer, slip)
            if g < runs.last[r]:
                before = fma(load(friction.weight, k * runs.guides + g, token), inverse, before)
        store(friction.trial, i, fnma(slip, 1.0 / PRESLIDING, load(friction.mobilised, i, token)))


@kernel
def keep_row(tables, factors, friction, p, work, rows, moving, token):
    """Keep the friction that an iteration mobilises, and the tensions along the cables, in the
    lanes that move."""
    zero = fill(0.0, work.tension, token)
    for i in range(rows):
        slip = load(p.velocity, tables.cables + i, token)
        there = _bounded(fnma(slip, 1.0 / PRESLIDING, load(friction.trial, i, token)))
        store(friction.ended, i, where_greater(moving, zero, there, load(friction.ended, i, token)))
    remember_segments(tables, factors, friction, work, 1.0, moving, token)


@kernel
def end_row(friction, rows, token):
    """The friction that is mobilised after a row at rest."""
    for i in range(rows):
        store(friction.mobilised, i, load(friction.ended, i, token))
