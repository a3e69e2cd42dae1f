"""Rollouts of a layered body whose cables rub in their guides: ``layered_rollout`` with ``fem.cable_friction``."""

from __future__ import annotations

from collections.abc import Callable

from rfdropo_bayes.fem.native.layered_assembly import clear
from rfdropo_bayes.fem.native.layered_rollout import begin_step, finish_rollouts, settle
from rfdropo_bayes.fem.native.layered_step import (
    condense_increment,
    refine_increment,
    substitute_increment,
    take_step,
    weigh_border,
)
from rfdropo_bayes.fem.native.simd import addresses, fill, fma, fnma, kernel, load, store, where_greater, whole
from rfdropo_bayes.fem.native.slip_problem import solve_slip
from rfdropo_bayes.fem.native.slip_records import KINDS
from rfdropo_bayes.fem.native.slip_rows import gather_slip, kinds_present


@kernel
def _start_slip(tables, runs, friction, work, token):
    """Friction that is not mobilised yet, tensions the same all along a cable."""
    clear(friction.mobilised, 0, KINDS * runs.count, token)
    for c in range(tables.cables):
        for g in range(tables.cable_first[c], tables.cable_first[c + 1]):
            store(friction.segment, g, load(work.tension, c, token))


@kernel
def _add_friction(tables, friction, work, rows, token):
    """Add the impulses of the runs to the right-hand side of the back substitution."""
    size, frame, panels = 3 * tables.modes, 9 * ((tables.cables + 3) // 3) * tables.modes, (rows + 2) // 3
    for station in range(tables.held, tables.stations):
        for c in range(size):
            value = load(work.border, station * frame + 3 * c, token)
            for i in range(rows):
                t = ((station * panels + i // 3) * size + c) * 3 + i % 3
                value = fma(load(friction.impulse, i, token), load(friction.border, t, token), value)
            store(work.border, station * frame + 3 * c, value)


@kernel
def _sum_losses(runs, samples, friction, token):
    """``lost``: what every cable has lost before and at each of its guides."""
    kinds, _ = kinds_present(samples)
    zero, one = fill(0.0, friction.lost, token), fill(1.0, friction.lost, token)
    for g in range(runs.guides):
        store(friction.lost, g, zero)
    for k in range(kinds):
        for r in range(runs.count):
            row = k * runs.count + r
            whole = load(friction.whole, row, token)
            share = load(friction.impulse, row, token) / where_greater(whole, zero, whole, one)
            for g in range(runs.first[r], runs.last[r]):
                weight = load(friction.weight, k * runs.guides + g, token)
                store(friction.lost, g, fma(weight, share, load(friction.lost, g, token)))


@kernel
def _add_forces(tables, friction, work, token):
    """Sum up ``lost`` along the cables, and add the impulses on the guides to ``field``."""
    for c in range(tables.cables):
        before, tied = fill(0.0, friction.lost, token), tables.cable_first[c + 1] - 1
        for g in range(tables.cable_first[c], tied + 1):
            after = before + load(friction.lost, g, token)
            store(friction.lost, g, after)
            for k in range(tables.guide_first[g], tables.guide_first[g + 1]):
                weight = tables.guide_weight[k]
                for i in range(3):
                    row = tables.guide_place[k] + i
                    push = before * load(friction.direction, 3 * g + i, token)
                    if g < tied:
                        push = fnma(after, load(friction.direction, 3 * g + 3 + i, token), push)
                    store(work.field, row, fma(push, weight, load(work.field, row, token)))
            before = after


@kernel
def _remember(tables, friction, work, rows, rate, token):
    """Friction mobilised and tensions along the cables after a step that was taken."""
    zero, accepted = fill(0.0, work.tension, token), load(work.accepted, 0, token)
    for i in range(rows):
        share, before = load(friction.share, i, token), load(friction.mobilised, i, token)
        store(friction.mobilised, i, where_greater(accepted, zero, share, before))
    for c in range(tables.cables):
        left = load(work.tension, c, token)
        for g in range(tables.cable_first[c], tables.cable_first[c + 1]):
            tension = where_greater(left, zero, left, zero)
            store(friction.segment, g, where_greater(accepted, zero, tension, load(friction.segment, g, token)))
            left = load(work.tension, c, token) - rate * load(friction.lost, g, token)


@kernel
def _rub(tables, runs, samples, friction, work, rate, schedule, token):
    """Tensions and friction between the factorisation and the back substitution; returns the number of runs."""
    rows = gather_slip(tables, runs, samples, friction, work, schedule.time_step, token)
    solve_slip(friction, work, rows, tables.cables, schedule.time_step, schedule.tolerance, token)
    _add_friction(tables, friction, work, rows, token)
    _sum_losses(runs, samples, friction, token)
    _add_forces(tables, friction, work, token)
    return rows


def compile_rollout(sources: str) -> Callable:
    """The kernel of one lane block; ``sources``, a digest of the kernels' sources, is part of the key it is cached
    under."""

    @whole
    def rollout(tables, batch, samples, factors, work, runs, friction, schedule, output, first, token):
        _ = sources
        tables, batch, output, runs = addresses(tables), addresses(batch), addresses(output), addresses(runs)
        samples, factors, work = addresses(samples), addresses(factors), addresses(work)
        friction = addresses(friction)
        rate = 1.0 / schedule.time_step
        settle(tables, batch, samples, factors, work, schedule, first, token)
        if not schedule.resumed:
            _start_slip(tables, runs, friction, work, token)
        step = 0
        while begin_step(tables, batch, samples, factors, work, schedule, output, step, first, token):
            condense_increment(tables, samples, factors, work, rate, schedule, token)
            rows = _rub(tables, runs, samples, friction, work, rate, schedule, token)
            weigh_border(tables.cables, work, rate, token)
            substitute_increment(tables, work, token)
            for _ in range(schedule.refinements):
                refine_increment(tables, samples, factors, work, token)
            take_step(tables, work, schedule.time_step, token)
            _remember(tables, friction, work, rows, rate, token)
            step += 1
        finish_rollouts(work, output, first, batch.count, token)

    return rollout
