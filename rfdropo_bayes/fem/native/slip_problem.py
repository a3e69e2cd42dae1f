"""Cable friction of a step in every lane: what ``fem.cable_friction.tensions_with_friction`` solves.

What sticks obeys z = fixed + f (across' t - A D z), f = h / PRESLIDING, with A the compliance and D the strength of the
runs. In (f D)^(1/2) z that is symmetric and definite, and runs that slide, or have no strength, drop out. A strength a
little below zero, as differences about zero ask for, continues the same equations.
"""

from __future__ import annotations

from rfdropo_bayes.fem.cable_friction import EXCHANGES, PRESLIDING
from rfdropo_bayes.fem.native.complementarity import solve_unilateral
from rfdropo_bayes.fem.native.layered_step import mark_unsolved
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, square_root, store, where_greater


@kernel
def _factor(friction, rows, token):
    """L D L' of sign + root A root: L above the diagonal, transposed, L D below it, and the inverse of D on it."""
    one, zero = fill(1.0, friction.factor, token), fill(0.0, friction.factor, token)
    for i in range(rows):
        root = load(friction.root, i, token)
        for j in range(i + 1):
            value = root * load(friction.root, j, token) * load(friction.among, i * rows + j, token)
            if i == j:
                value = value + where_greater(zero, load(friction.strength, i, token), -one, one)
            for k in range(j):
                left, right = load(friction.factor, i * rows + k, token), load(friction.factor, k * rows + j, token)
                value = fnma(left, right, value)
            if i == j:
                store(friction.factor, i * rows + i, one / value)
            else:
                store(friction.factor, i * rows + j, value)
                store(friction.factor, j * rows + i, value * load(friction.factor, j * rows + j, token))


@kernel
def _substitute(friction, values, first, step, rows, token):
    """Solve in place for the values in every ``step``-th row from ``first`` on."""
    for i in range(rows):
        value = load(values, first + step * i, token)
        for k in range(i):
            value = fnma(load(friction.factor, k * rows + i, token), load(values, first + step * k, token), value)
        store(values, first + step * i, value)
    for i in range(rows - 1, -1, -1):
        value = load(values, first + step * i, token) * load(friction.factor, i * rows + i, token)
        for k in range(i + 1, rows):
            value = fnma(load(friction.factor, i * rows + k, token), load(values, first + step * k, token), value)
        store(values, first + step * i, value)


@kernel
def _set_sticking(friction, rows, follows, token):
    """``root`` of the runs that stick, ``share`` and ``impulse`` of those that slide."""
    zero, one = fill(0.0, friction.root, token), fill(1.0, friction.root, token)
    for i in range(rows):
        trial, strength = load(friction.trial, i, token), load(friction.strength, i, token)
        sign = where_greater(trial, zero, one, -one)
        sticks = where_greater(one, trial * sign, one, zero)
        size = where_greater(strength, zero, strength, -strength)
        store(friction.root, i, sticks * square_root(follows * size))
        store(friction.share, i, where_greater(sticks, zero, zero, sign))
        store(friction.impulse, i, where_greater(sticks, zero, zero, sign * strength))


@kernel
def _answers(friction, rows, cables, follows, token):
    """``impulse`` of the runs without tensions, and their ``answer`` to these."""
    for i in range(rows):
        fixed = load(friction.mobilised, i, token) + load(friction.slip, i, token) / PRESLIDING
        for j in range(rows):
            held = follows * load(friction.impulse, j, token)
            fixed = fnma(load(friction.among, i * rows + j, token), held, fixed)
        root = load(friction.root, i, token)
        store(friction.trial, i, root * fixed)
        for c in range(cables):
            store(friction.answer, i * cables + c, root * follows * load(friction.pull, i * cables + c, token))
    _factor(friction, rows, token)
    _substitute(friction, friction.trial, 0, 1, rows, token)
    for c in range(cables):
        _substitute(friction, friction.answer, c, cables, rows, token)
    for i in range(rows):
        root = load(friction.root, i, token) / follows
        held = load(friction.impulse, i, token)
        store(friction.impulse, i, fma(root, load(friction.trial, i, token), held))
        for c in range(cables):
            store(friction.answer, i * cables + c, root * load(friction.answer, i * cables + c, token))


@kernel
def _offset(friction, work, rows, cables, token):
    """Slack of the cables at the impulses of the runs."""
    for c in range(cables):
        value = load(work.slack, c, token)
        for i in range(rows):
            value = fnma(load(friction.pull, i * cables + c, token), load(friction.impulse, i, token), value)
        store(friction.offset, c, value)


@kernel
def _reduce(friction, work, rows, cables, token):
    """Tension problem with what sticks in it."""
    _offset(friction, work, rows, cables, token)
    for c in range(cables):
        for d in range(c + 1):
            value = load(work.compliance, c * cables + d, token)
            for i in range(rows):
                answer = load(friction.answer, i * cables + d, token)
                value = fnma(load(friction.pull, i * cables + c, token), answer, value)
            store(friction.reduced, c * cables + d, value)
            store(friction.reduced, d * cables + c, value)


@kernel
def _follow(friction, work, rows, cables, time_step, token):
    """Impulses of the runs with the tensions, and the share of friction that their slip would mobilise."""
    zero = fill(0.0, friction.trial, token)
    for i in range(rows):
        value = load(friction.impulse, i, token)
        for c in range(cables):
            tension = load(work.tension, c, token)
            tension = where_greater(tension, zero, tension, zero)
            value = fma(load(friction.answer, i * cables + c, token), tension, value)
        store(friction.impulse, i, value)
    for i in range(rows):
        speed = zero
        for c in range(cables):
            tension = load(work.tension, c, token)
            tension = where_greater(tension, zero, tension, zero)
            speed = fma(load(friction.pull, i * cables + c, token), tension, speed)
        for j in range(rows):
            speed = fnma(load(friction.among, i * rows + j, token), load(friction.impulse, j, token), speed)
        motion = fma(speed, time_step, load(friction.slip, i, token))
        trial = load(friction.mobilised, i, token) + motion / PRESLIDING
        store(friction.trial, i, trial)
        share = load(friction.share, i, token)
        store(friction.share, i, where_greater(share * share, zero, share, trial))


@kernel
def solve_slip(friction, work, rows, cables, time_step, tolerance, token):
    """Tensions of the scaled problem, and impulses and shares of the runs, at the end of a step."""
    follows, one = time_step / PRESLIDING, fill(1.0, friction.share, token)
    for i in range(rows):
        trial = load(friction.mobilised, i, token) + load(friction.slip, i, token) / PRESLIDING
        store(friction.trial, i, trial)
    for _ in range(EXCHANGES):
        _set_sticking(friction, rows, follows, token)
        _answers(friction, rows, cables, follows, token)
        _reduce(friction, work, rows, cables, token)
        solve_unilateral(
            friction.reduced, friction.offset, cables, tolerance, work.active, work.pivoting, work.tension, token
        )
        _follow(friction, work, rows, cables, time_step, token)
    for i in range(rows):
        share = load(friction.share, i, token)
        share = where_greater(share, one, one, share)
        share = where_greater(-one, share, -one, share)
        store(friction.share, i, share)
        store(friction.impulse, i, load(friction.strength, i, token) * share)
    _offset(friction, work, rows, cables, token)
    found = solve_unilateral(
        work.compliance, friction.offset, cables, tolerance, work.active, work.pivoting, work.tension, token
    )
    mark_unsolved(cables, work, found, token)
