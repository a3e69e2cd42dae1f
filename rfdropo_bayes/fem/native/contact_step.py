"""Contacts of a step of a layered body in SIMD lanes: found, condensed with the factor of the step, and solved."""

from __future__ import annotations

from rfdropo_bayes.fem.contact import CABLE_CHOICES, SWEEPS
from rfdropo_bayes.fem.native.chain_cholesky import condense_rows, extend_border, substitute_back
from rfdropo_bayes.fem.native.contact_choice import (
    PATIENCE,
    choose_all,
    choose_closing,
    choose_missed,
    place_chosen,
)
from rfdropo_bayes.fem.native.contact_problem import (
    cube_compliance,
    judge_contacts,
    open_contacts,
    solve_contacts,
    stop_cube,
    sweep,
    trunk_compliance,
)
from rfdropo_bayes.fem.native.cube_motion import find_candidates
from rfdropo_bayes.fem.native.layered_assembly import clear
from rfdropo_bayes.fem.native.layered_step import find_tensions, mark_unsolved, weigh_border, weigh_rows
from rfdropo_bayes.fem.native.simd import fill, fma, kernel, load, store
from rfdropo_bayes.fem.pushing import RESTING


@kernel
def _trunk_rows(tables, scene, touch, panels, velocity, lane, lanes):
    """Rows of the trunk's contacts in one lane into ``border``."""
    size = 3 * tables.modes
    for panel in range(panels):
        contact, p = RESTING + panel, int(touch.point[panel * lanes + lane])
        if p < 0:
            continue
        for k in range(scene.first[p], scene.first[p + 1]):
            row, weight = scene.place[k], scene.weight[k]
            station, column = row // size, row % size
            t = ((station * panels + panel) * size + column) * 3
            for r in range(3):
                f, moving = 3 * (3 * contact + r), 0.0
                for i in range(3):
                    share = weight * touch.frame[(f + i) * lanes + lane]
                    touch.border[(t + 3 * i + r) * lanes + lane] += share
                    moving += share * velocity[(row + i) * lanes + lane]
                touch.moving[(3 * contact + r) * lanes + lane] += moving


@kernel
def _gather_contacts(tables, scene, touch, panels, velocity, token):
    """``border`` and ``moving`` of all lanes; returns the topmost station that is not zero."""
    lanes, top = len(token), 0
    for lane in range(lanes):
        for panel in range(panels):
            p = int(touch.point[panel * lanes + lane])
            if p >= 0:
                top = max(top, scene.place[scene.first[p + 1] - 1] // (3 * tables.modes))
    clear(touch.border, 0, 9 * (top + 1) * panels * tables.modes, token)
    clear(touch.moving, 0, 3 * (RESTING + panels), token)
    for lane in range(lanes):
        _trunk_rows(tables, scene, touch, panels, velocity, lane, lanes)
    return top


@kernel
def _condense_contacts(tables, touch, work, panels, top, token):
    """Rows of the contacts times A^-1 times each other, the cables and the right-hand side."""
    modes, held, size, cables = tables.modes, tables.held, 3 * tables.modes, tables.cables
    others = (cables + 3) // 3
    extend_border(work.pivot, work.coupling, touch.border, held, top, modes, panels, token)
    condense_rows(touch.own, touch.border, panels, touch.border, panels, held, top, size, token)
    condense_rows(touch.across, touch.border, panels, work.border, others, held, top, size, token)
    for i in range(3 * panels):
        t, row = 9 * (i // 3 * others) + i % 3, 3 * RESTING + i
        store(touch.moving, row, load(touch.moving, row, token) - load(touch.across, t, token))
        for c in range(cables):
            entry = load(touch.across, t + 9 * ((c + 1) // 3) + 3 * ((c + 1) % 3), token)
            store(touch.pull, row * cables + c, entry * load(work.scale, c, token))


@kernel
def _add_impulses(tables, touch, work, panels, top, token):
    """Add the contacts' impulses to what the back substitution starts from."""
    size = 3 * tables.modes
    for station in range(tables.held, top + 1 if panels > 0 else tables.held):
        for c in range(size):
            value = load(work.solution, station * size + c, token)
            for i in range(3 * panels):
                t = ((station * panels + i // 3) * size + c) * 3 + i % 3
                value = fma(load(touch.impulse, 3 * RESTING + i, token), load(touch.border, t, token), value)
            store(work.solution, station * size + c, value)


@kernel
def add_forces(scene, touch, panels, field, lane, lanes):
    """Add the contacts' impulses of one lane to a field."""
    for panel in range(panels):
        contact, p = RESTING + panel, int(touch.point[panel * lanes + lane])
        if p < 0:
            continue
        for k in range(scene.first[p], scene.first[p + 1]):
            row, weight = scene.place[k], scene.weight[k]
            for r in range(3):
                impulse = weight * touch.impulse[(3 * contact + r) * lanes + lane]
                for i in range(3):
                    field[(row + i) * lanes + lane] += impulse * touch.frame[(3 * (3 * contact + r) + i) * lanes + lane]


@kernel
def start_contacts(scene, samples, touch, work, cables, time_step, token):
    """Candidates of a step, and the first choice among them; returns how many there are."""
    lanes = len(token)
    candidates = find_candidates(scene, work.position, samples.gravity, samples.damping, touch, time_step, token)
    for lane in range(lanes):
        choose_closing(scene, touch, candidates, work.velocity, time_step, lane, lanes)
    for c in range(cables):
        store(touch.first, c, load(work.active, c, token))
    return candidates


@kernel
def press(tables, scene, touch, work, candidates, schedule, settled, token):
    """Tensions, impulses and solution of a step whose matrix is factorised; returns how many of the chosen contacts the
    trunk takes part in."""
    cables, rate, tolerance = tables.cables, 1.0 / schedule.time_step, schedule.tolerance
    panels = place_chosen(touch, candidates, schedule.time_step, len(token))
    contacts = RESTING + panels
    top = _gather_contacts(tables, scene, touch, panels, work.velocity, token)
    for c in range(cables):
        store(work.active, c, load(touch.first, c, token))
    if panels > 0:
        _condense_contacts(tables, touch, work, panels, top, token)
    cube_compliance(touch, contacts, token)
    trunk_compliance(touch, contacts, -1.0, token)
    open_contacts(touch, contacts, token)
    if panels == 0:
        find_tensions(cables, work, tolerance, token)
        store(touch.going, 0, fill(1.0, touch.cube, token))
        sweep(touch, touch.matrix, touch.free, contacts, CABLE_CHOICES * SWEEPS, settled, token)
    else:
        found = solve_contacts(touch, work, cables, contacts, tolerance, settled, token)
        mark_unsolved(cables, work, found, token)
    judge_contacts(touch, work, cables, contacts, token)
    stop_cube(touch, contacts, token)
    weigh_border(cables, work, rate, token)
    weigh_rows(tables, work, token)
    _add_impulses(tables, touch, work, panels, top, token)
    substitute_back(work.pivot, work.coupling, work.solution, tables.held, tables.stations, tables.modes, token)
    return panels


@kernel
def add_missed(scene, touch, work, candidates, solves, time_step, tolerance, lanes):
    """Choose what the solution of a step goes through; returns whether it is to be solved again."""
    again = False
    for lane in range(lanes):
        if choose_missed(scene, touch, candidates, work.velocity, work.solution, time_step, tolerance, lane, lanes):
            again = True
            if solves >= PATIENCE:
                choose_all(touch, candidates, lane, lanes)
    return again
