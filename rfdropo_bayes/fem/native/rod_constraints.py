"""A stage of a rod in SIMD lanes with everything that holds it: cables, slip at their guides, and contacts.

Slip and contacts are further border rows of the factor that the step has already. None stands for an absent part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.fem.native.chain_cholesky import PANEL, condense_rows, extend_border
from rfdropo_bayes.fem.native.constraint_problem import soften, solve_problem
from rfdropo_bayes.fem.native.contact_geometry import (
    add_missed,
    choose_closing,
    find_candidates,
    list_contacts,
    sphere_of,
)
from rfdropo_bayes.fem.native.cube_motion import (
    add_cube,
    carry_cube,
    find_impacts,
    remember_impulses,
    stop_cube,
    take_cube_stage,
)
from rfdropo_bayes.fem.native.fields import clear
from rfdropo_bayes.fem.native.rod_step import (
    condense_increment,
    set_factors,
    start_problem,
    substitute_increment,
    take_stage,
    take_tensions,
    weigh_border,
    weigh_rows,
)
from rfdropo_bayes.fem.native.rod_tables import SIZE
from rfdropo_bayes.fem.native.simd import aligned_zeros, fill, fma, kernel, load, store, where_greater
from rfdropo_bayes.fem.native.slip_rows import (
    gather_slip,
    kinds_present,
    remember_slip,
    start_sliding,
    sum_losses,
    weigh_guides,
)
from rfdropo_bayes.fem.native.sphere_maps import row_entry
from rfdropo_bayes.fem.native.vectors import added


class Rows(NamedTuple):
    """Border rows of slip, then of contacts, three to a panel; laid out as the engine's own border is."""

    border: Float[np.ndarray, "values lanes"]
    own: Float[np.ndarray, "tiles lanes"]  # minus their condensed products
    across: Float[np.ndarray, "tiles lanes"]  # and products with the engine's border


def row_storage(station_values: int, panels: int, others: int, lanes: int, dtype: type) -> Rows:
    """Zeroed, aligned storage of one lane block: ``panels`` beside ``others`` of the engine, each with
    ``station_values`` values over all stations.
    """
    sizes = 3 * station_values * panels, 9 * panels**2, 9 * panels * others
    return Rows(*(aligned_zeros((max(size, 1), lanes), dtype) for size in sizes))


@kernel
def _contact_panel(scene, touch, slot, border, panel, panels, token):
    """Border rows of a contact of the trunk."""
    sphere = sphere_of(scene, touch.pair[slot])
    for k in range(scene.first[sphere], scene.first[sphere + 1]):
        place = scene.place[k]
        t = ((place // SIZE * panels + panel) * SIZE + place % SIZE) * 3
        for r in range(3):
            entry = row_entry(scene, scene.gradient, scene.arm, touch, slot, k, r, token)
            for i in range(3):
                store(border, t + 3 * i + r, load(border, t + 3 * i + r, token) + entry[i])


@kernel
def _top_station(scene, touch, contacts):
    """The topmost station that a contact reaches."""
    top = 0
    for c in range(touch.count[3], contacts):
        sphere = sphere_of(scene, touch.pair[touch.contact[c]])
        top = max(top, scene.place[scene.first[sphere + 1] - 1] // SIZE)
    return top


@kernel
def _gather_contacts(scene, touch, rows, p, lines, contacts, first, panels, token):
    """Border rows of the contacts from panel ``first`` on, and the contribution of the body's velocity to the
    problem.
    """
    for c in range(contacts):
        slot, i = touch.contact[c], lines + 3 * c
        for r in range(3):
            store(p.free, i + r, load(touch.rate, 3 * slot + r, token))
        if c >= touch.count[3]:
            _contact_panel(scene, touch, slot, rows.border, first + c - touch.count[3], panels, token)


@kernel
def _row_of(i, slips, corners, lines, cables):
    """Row of the problem that row i of the extra border is; negative for one that fills a panel."""
    slip_rows = (slips + 2) // 3 * 3
    if i >= slip_rows:
        return lines + 3 * corners + i - slip_rows
    return cables + i if i < slips else -1


@kernel
def _condense(tables, rows, work, p, n, panels, slips, corners, top, token):
    """Add the extra rows to the problem: products with each other, with cable rows and with the right-hand side."""
    held, cables, others = tables.held, tables.cables, tables.panels
    lines = cables + slips
    extend_border(work.pivot, work.coupling, rows.border, held, top, panels, token)
    condense_rows(rows.own, rows.border, panels, rows.border, panels, True, held, top, token)
    condense_rows(rows.across, rows.border, panels, work.border, others, False, held, top, token)
    for i in range(3 * panels):
        row = _row_of(i, slips, corners, lines, cables)
        if row < 0:
            continue
        t = 9 * (i // 3 * others) + i % 3
        store(p.free, row, load(p.free, row, token) - load(rows.across, t, token))
        for c in range(cables):
            beside = tables.row[c]
            value = load(rows.across, t + 9 * (beside // 3) + 3 * (beside % 3), token)
            store(p.matrix, row * n + c, value)
            store(p.matrix, c * n + row, value)
        for j in range(i + 1):
            column = _row_of(j, slips, corners, lines, cables)
            if column >= 0:
                value = -load(rows.own, 9 * (i // 3 * panels + j // 3) + 3 * (j % 3) + i % 3, token)
                store(p.matrix, row * n + column, value)
                store(p.matrix, column * n + row, value)


@kernel
def hold(
    tables, runs, scene, samples, factors, work, friction, touch, rows, p, slips, contacts, length, schedule, token
):  # fmt: skip
    """Impulses of all constraints, and the solution of the stage with them; friction goes on from ``trial``."""
    cables = tables.cables
    lines, slip_panels, corners, top = cables + slips, (slips + 2) // 3, 0, 0
    n, rate = lines + 3 * contacts, 1.0 / length
    clear(p.matrix, 0, n * n, token)
    start_problem(tables, factors, work, p, n, rate, token)
    if scene is not None:
        corners, top = touch.count[3], _top_station(scene, touch, contacts)
    panels = slip_panels + contacts - corners
    if runs is not None:
        top = tables.stations - 1
    if runs is not None or scene is not None:
        clear(rows.border, 0, (top + 1) * panels * PANEL if panels > 0 else 0, token)
        if runs is not None and slips > 0:
            gather_slip(tables, runs, samples, factors, friction, rows.border, panels, p, work, length, token)
        if scene is not None:
            _gather_contacts(scene, touch, rows, p, lines, contacts, slip_panels, panels, token)
        if panels > 0:
            _condense(tables, rows, work, p, n, panels, slips, corners, top, token)
        if scene is not None:
            wide, narrow = load(factors.wide, 0, token), load(factors.narrow, 0, token)
            add_cube(touch, p, lines, contacts, length, wide, narrow, token)
    soften(p, cables, slips, contacts, length, schedule.softness, token)
    solve_problem(p, cables, slips, contacts, schedule.settled, schedule.stages[0].predicted, token)
    weigh_border(tables, work, p, token)
    weigh_rows(tables, work, token)
    if panels > 0:
        _add_rows(tables, rows, work, p, panels, slips, corners, top, token)
    substitute_increment(tables, work, token)


@kernel
def _add_rows(tables, rows, work, p, panels, slips, corners, top, token):
    """Add the impulses of the extra rows to the start of the back substitution."""
    cables = tables.cables
    for station in range(tables.held, top + 1):
        for c in range(SIZE):
            value = load(work.solution, station * SIZE + c, token)
            for i in range(3 * panels):
                row = _row_of(i, slips, corners, cables + slips, cables)
                if row >= 0:
                    t = ((station * panels + i // 3) * SIZE + c) * 3 + i % 3
                    value = fma(load(p.impulse, row, token), load(rows.border, t, token), value)
            store(work.solution, station * SIZE + c, value)


@kernel
def _add_forces(scene, touch, impulses, lines, contacts, accepted, field, token):
    """Add the contacts' impulses to a field, in the lanes that are accepted."""
    zero = fill(0.0, field, token)
    for c in range(touch.count[3], contacts):
        slot, i = touch.contact[c], lines + 3 * c
        sphere = sphere_of(scene, touch.pair[slot])
        for k in range(scene.first[sphere], scene.first[sphere + 1]):
            push = zero, zero, zero
            for r in range(3):
                entry = row_entry(scene, scene.gradient, scene.arm, touch, slot, k, r, token)
                push = added(entry, load(impulses, i + r, token), push)
            for j in range(3):
                row = scene.place[k] + j
                old = load(field, row, token)
                store(field, row, where_greater(accepted, zero, old + push[j], old))


@kernel
def _carry_contacts(tables, scene, touch, work, p, lines, contacts, later, token):
    """The contacts' change that the next stage carries on, without impacts."""
    find_impacts(touch, p, lines, contacts, token)
    carry_cube(touch, p, lines, contacts, later, work.accepted, token)
    if later > 0.0:
        clear(work.sudden, 0, SIZE * tables.stations, token)
        accepted = load(work.accepted, 0, token)
        _add_forces(scene, touch, p.before, lines, contacts, accepted, work.sudden, token)


@kernel
def constrained_stage(tables, runs, scene, samples, factors, work, friction, touch, rows, p, schedule, number, token):
    """One stage of a body, its cables' friction and its cube."""
    stage, slips, contacts, cables = schedule.stages[number], 0, 0, tables.cables
    length, later = stage.length, schedule.stages[number + 1].carried if number + 1 < schedule.count else 0.0
    if scene is not None:
        wide = find_candidates(scene, work.frame, work.velocity, touch, stage, token)
        if stage.carried > 0.0:
            set_factors(samples, factors, work, stage, wide, token)
        going, narrow = load(factors.going, 0, token), load(factors.narrow, 0, token)
        choose_closing(touch, samples.gravity, samples.damping, stage, wide, narrow, going, token)
    condense_increment(tables, samples, factors, work, stage, False, token)
    if runs is not None:
        slips = kinds_present(samples)[0] * runs.count
        start_sliding(friction, slips, token)
        weigh_guides(runs, samples, friction, work.direction, token)
    again = True
    while again:
        again = False
        if scene is not None:
            contacts = list_contacts(touch, token)
        hold(
            tables, runs, scene, samples, factors, work, friction, touch, rows, p, slips, contacts, length, schedule,
            token,
        )  # fmt: skip
        if scene is not None:
            stop_cube(touch, p, cables + slips, contacts, token)
            again = add_missed(scene, touch, work.solution, length, narrow, schedule.missed, token)
    take_tensions(tables, factors, work, 1.0 / length, token)
    if runs is not None:
        sum_losses(tables, runs, samples, friction, p, token)
    take_stage(tables, factors, work, stage, token)
    if runs is not None:
        remember_slip(tables, factors, friction, p, work, slips, length, later, token)
    if scene is not None:
        if schedule.count > 1:
            _carry_contacts(tables, scene, touch, work, p, cables + slips, contacts, later, token)
        remember_impulses(scene, touch, p, cables + slips, contacts, narrow, work.accepted, token)
        take_cube_stage(touch, work.accepted, work.lost, length, factors.wide, stage.predicted, token)
