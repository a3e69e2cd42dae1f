"""Cables and contacts of a step of a tetrahedral body in SIMD lanes, between its factorisation and its substitution.

Border row 0 of the factor is the right-hand side, the following rows are -dl/dx of the cables. Contacts are further
rows. A body without a cube has no scene: None stands for an absent part.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.block_cholesky import condense_rows, extend_border
from rfdropo_bayes.fem.native.constraint_problem import soften, solve_problem
from rfdropo_bayes.fem.native.contact_geometry import (
    add_cube_velocity,
    choose_all,
    choose_closing,
    find_candidates,
    kind_of,
    list_contacts,
    sphere_of,
    trunk_velocity,
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
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, load3, store, where_greater
from rfdropo_bayes.fem.native.sphere_maps import row_entry
from rfdropo_bayes.fem.native.vectors import add_to, added, scaled


@kernel
def _gather_contacts(scene, touch, work, rows, p, reached, cables, contacts, free, token):
    """Border rows of the contacts and the columns that they reach; the body's velocity along them."""
    panels = contacts - touch.count[3]
    clear(rows.border, 0, 9 * panels * free, token)
    for node in range(free):
        reached[node] = 0
    for c in range(contacts):
        slot, i = touch.contact[c], cables + 3 * c
        for r in range(3):
            store(p.free, i + r, load(touch.rate, 3 * slot + r, token))
        if c < touch.count[3]:
            continue
        sphere = sphere_of(scene, touch.pair[slot])
        for k in range(scene.first[sphere], scene.first[sphere + 1]):
            node = scene.place[k] // 3
            if node >= free:
                continue
            reached[node] = 1
            t = 9 * (panels * node + c - touch.count[3])
            for r in range(3):
                entry = row_entry(scene, scene.gradient, scene.arm, touch, slot, k, r, token)
                add_to(rows.border, t + 3 * r, entry, token)


@kernel
def _across(pattern, touch, work, rows, p, reached, cables, contacts, free, token):
    """Products of the contacts' rows with the engine's border; add the products with the right-hand side to
    ``free``.
    """
    corners, others = touch.count[3], pattern.border
    panels = contacts - corners
    condense_rows(pattern, rows.across, rows.border, panels, work.lower, others, False, reached, free, token)
    for i in range(3 * panels):
        row = cables + 3 * corners + i
        moved = load(rows.across, 9 * (i // 3 * others) + i % 3, token)
        store(p.free, row, load(p.free, row, token) + moved)


@kernel
def _condense(pattern, touch, work, rows, p, n, reached, cables, contacts, free, token):
    """Add the contacts of the trunk to the problem."""
    first, others = cables + 3 * touch.count[3], pattern.border
    panels = contacts - touch.count[3]
    extend_border(pattern, work.pivot, work.lower, rows.border, panels, reached, free, token)
    condense_rows(pattern, rows.own, rows.border, panels, rows.border, panels, True, reached, free, token)
    _across(pattern, touch, work, rows, p, reached, cables, contacts, free, token)
    for i in range(3 * panels):
        t, row = 9 * (i // 3 * others) + i % 3, first + i
        for c in range(cables):
            value = load(rows.across, t + 9 * ((c + 1) // 3) + 3 * ((c + 1) % 3), token)
            store(p.matrix, row * n + c, value)
            store(p.matrix, c * n + row, value)
        for j in range(i + 1):
            value = load(rows.own, 9 * (i // 3 * panels + j // 3) + 3 * (j % 3) + i % 3, token)
            store(p.matrix, row * n + first + j, value)
            store(p.matrix, (first + j) * n + row, value)


@kernel
def _weigh(pattern, scene, touch, work, rows, p, reached, cables, contacts, free, time_step, token):
    """Weights of the border rows by the change of the impulses since ``before``, and the tensions; lanes whose impulses
    were not found stay marked."""
    store(work.unsolved, 0, load(work.unsolved, 0, token) + load(p.going, 0, token))
    store(work.weight, 0, fill(1.0, work.weight, token))
    for i in range(cables + 1, 3 * pattern.border):
        store(work.weight, i, fill(0.0, work.weight, token))
    for c in range(cables):
        store(work.weight, c + 1, load(p.impulse, c, token) - load(p.before, c, token))
        store(work.tension, c, load(p.impulse, c, token) * (1.0 / time_step) * load(work.narrow, 0, token))
    if scene is not None:
        first = cables + 3 * touch.count[3]
        panels = contacts - touch.count[3]
        for column in range(free if panels > 0 else 0):
            if reached[column] == 0:
                continue
            t = 9 * (pattern.first[column + 1] - pattern.border)
            for m in range(3):
                value = load(work.lower, t + m, token)
                for i in range(3 * panels):
                    row = load(rows.border, 9 * panels * column + 3 * i + m, token)
                    change = load(p.impulse, first + i, token) - load(p.before, first + i, token)
                    value = fma(change, row, value)
                store(work.lower, t + m, value)


@kernel
def meet(scene, samples, touch, work, stage, token):
    """Candidates of a stage, the factor on its length for their impacts, and the cube without contacts."""
    one = fill(1.0, work.wide, token)
    wide = find_candidates(scene, work.position, work.velocity, touch, stage, token)
    if stage.carried > 0.0:
        store(work.wide, 0, wide)
        store(work.narrow, 0, one / wide)
        store(work.going, 0, (one - wide) + stage.carried)
    narrow, going = load(work.narrow, 0, token), load(work.going, 0, token)
    choose_closing(touch, samples.gravity, samples.rayleigh_mass, stage, wide, narrow, going, token)


@kernel
def hold(pattern, scene, samples, touch, work, rows, p, reached, cables, free, stage, schedule, token):
    """Impulses of all constraints of a stage, and the weights of its substitution; returns the number of contacts.

    ``work.slack`` holds the velocities of the cables' rows without impulses, ``work.condensed`` their products.
    """
    time_step, contacts, border = stage.length, 0, 3 * pattern.border
    wide, narrow = load(work.wide, 0, token), load(work.narrow, 0, token)
    if scene is not None:
        choose_all(touch, token)
        contacts = list_contacts(touch, token)
    n = cables + 3 * contacts
    clear(p.matrix, 0, n * n, token)
    clear(p.before, 0, n, token)
    for i in range(cables):
        store(p.free, i, load(work.slack, i, token))
        store(p.impulse, i, load(work.tension, i, token) * time_step * wide)
        for j in range(cables):
            store(p.matrix, i * n + j, load(work.condensed, (i + 1) * border + j + 1, token))
    if scene is not None:
        _gather_contacts(scene, touch, work, rows, p, reached, cables, contacts, free, token)
        if contacts > touch.count[3]:
            _condense(pattern, touch, work, rows, p, n, reached, cables, contacts, free, token)
        add_cube(touch, p, cables, contacts, time_step, wide, narrow, token)
    soften(p, cables, 0, contacts, time_step, schedule.softness, token)
    solve_problem(p, cables, 0, contacts, schedule.settled, False, token)
    _weigh(pattern, scene, touch, work, rows, p, reached, cables, contacts, free, time_step, token)
    if scene is not None:
        stop_cube(touch, p, cables, contacts, token)
    return contacts


@kernel
def add_forces(pattern, scene, touch, work, p, cables, contacts, free, token):
    """Add the contacts' impulses to border row 0 before its elimination."""
    for c in range(touch.count[3], contacts):
        slot = touch.contact[c]
        sphere = sphere_of(scene, touch.pair[slot])
        for k in range(scene.first[sphere], scene.first[sphere + 1]):
            node = scene.place[k] // 3
            if node >= free:
                continue
            t = 9 * (pattern.first[node + 1] - pattern.border)
            for r in range(3):
                push = row_entry(scene, scene.gradient, scene.arm, touch, slot, k, r, token)
                add_to(work.lower, t, scaled(push, load(p.impulse, cables + 3 * c + r, token)), token)


@kernel
def _add_impacts(scene, touch, work, p, cables, contacts, free, token):
    """Add the impulses in ``before`` to ``work.sudden``, in the lanes whose stage was taken."""
    zero, taken = fill(0.0, work.sudden, token), load(work.accepted, 0, token)
    for c in range(touch.count[3], contacts):
        slot = touch.contact[c]
        sphere = sphere_of(scene, touch.pair[slot])
        for k in range(scene.first[sphere], scene.first[sphere + 1]):
            row = scene.place[k]
            if row >= 3 * free:
                continue
            total = load3(work.sudden, row, token)
            for r in range(3):
                push = row_entry(scene, scene.gradient, scene.arm, touch, slot, k, r, token)
                total = added(push, load(p.before, cables + 3 * c + r, token), total)
            for j in range(3):
                store(work.sudden, row + j, where_greater(taken, zero, total[j], zero))


@kernel
def end_stage(scene, touch, work, p, cables, contacts, free, schedule, stage, later, token):
    """Move the cube, and store the contacts' impulses: a later stage carries a share of them on and starts its
    iterations from them.
    """
    if schedule.count > 1:
        find_impacts(touch, p, cables, contacts, token)
        carry_cube(touch, p, cables, contacts, later, work.accepted, token)
        clear(work.sudden, 0, 3 * free, token)
        _add_impacts(scene, touch, work, p, cables, contacts, free, token)
    remember_impulses(scene, touch, p, cables, contacts, load(work.narrow, 0, token), work.accepted, token)
    take_cube_stage(touch, work.accepted, work.lost, stage.length, work.wide, stage.predicted, token)


@kernel
def hold_again(pattern, scene, touch, work, rows, p, reached, cables, contacts, free, stage, schedule, token):
    """Like `hold`, for the residual of a step's solution, with the change of the impulses since then."""
    n = cables + 3 * contacts
    for i in range(cables):
        store(p.free, i, load(work.slack, i, token))
    if scene is not None:
        for c in range(contacts):
            slot, i = touch.contact[c], cables + 3 * c
            kind = kind_of(touch, slot)
            u, v, w = trunk_velocity(scene, touch, slot, kind, work.velocity, token)
            u, v, w = add_cube_velocity(touch, slot, kind, u, v, w, touch.after, 0, token)
            store(p.free, i, u, v, w)
        if contacts > touch.count[3]:
            _across(pattern, touch, work, rows, p, reached, cables, contacts, free, token)
    for i in range(n):
        value = load(p.free, i, token)
        for j in range(n):
            value = fnma(load(p.matrix, i * n + j, token), load(p.impulse, j, token), value)
        store(p.free, i, value)
        store(p.before, i, load(p.impulse, i, token))
    solve_problem(p, cables, 0, contacts, schedule.settled, False, token)
    _weigh(pattern, scene, touch, work, rows, p, reached, cables, contacts, free, stage.length, token)
    if scene is not None:
        stop_cube(touch, p, cables, contacts, token)
