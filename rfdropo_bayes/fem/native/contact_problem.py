"""Contacts and cables of a step in every lane: what ``fem.contact.solve_constraints`` solves, by the same sweeps.

A lane whose impulses have settled keeps them while others go on, and contacts that exert nothing add exact zeros: a
lane's result does not depend on its neighbours.
"""

from __future__ import annotations

from rfdropo_bayes.fem.contact import CABLE_CHOICES, REGULARISATION, SWEEPS, TOLERANCE
from rfdropo_bayes.fem.native.complementarity import solve_unilateral, substitute_active
from rfdropo_bayes.fem.native.contact_rows import APART
from rfdropo_bayes.fem.native.simd import any_greater, fill, fma, fnma, kernel, load, square_root, store, where_greater
from rfdropo_bayes.fem.pushing import RESTING, RIGID


@kernel
def cube_compliance(touch, contacts, token):
    """Start ``matrix``, row-major, with the cube's part, and ``free`` with the velocities of the step's start."""
    one, n = fill(1.0, touch.cube, token), 3 * contacts
    light = one / load(touch.values, 0, token)
    gyration = load(touch.values, 2, token)
    nimble = light / (gyration * gyration)
    for i in range(n):
        rate = fill(0.0, touch.cube, token)
        for k in range(6):
            rate = fma(load(touch.on_cube, 6 * i + k, token), load(touch.twist, k, token), rate)
        rate = rate + load(touch.moving, i, token)
        store(touch.free, i, rate)
        for j in range(i + 1):
            value, turning = fill(0.0, touch.cube, token), fill(0.0, touch.cube, token)
            for k in range(3):
                value = fma(load(touch.on_cube, 6 * i + k, token), load(touch.on_cube, 6 * j + k, token), value)
                t, s = 6 * i + 3 + k, 6 * j + 3 + k
                turning = fma(load(touch.on_cube, t, token), load(touch.on_cube, s, token), turning)
            value = fma(nimble, turning, light * value)
            store(touch.matrix, i * n + j, value)
            store(touch.matrix, j * n + i, value)


@kernel
def trunk_compliance(touch, contacts, sign, token):
    """Add the trunk's part to ``matrix``: ``sign`` times the tiles of ``own``."""
    panels, n, first = contacts - RESTING, 3 * contacts, 3 * RESTING
    for i in range(3 * panels):
        for j in range(i + 1):
            t = 9 * (i // 3 * panels + j // 3) + 3 * (j % 3) + i % 3
            row, column = first + i, first + j
            value = fma(load(touch.own, t, token), sign, load(touch.matrix, row * n + column, token))
            store(touch.matrix, row * n + column, value)
            store(touch.matrix, column * n + row, value)


@kernel
def open_contacts(touch, contacts, token):
    """Add the gaps to ``free``, and make ``matrix`` definite; between parts that cannot move nothing is solved."""
    n, zero, one = 3 * contacts, fill(0.0, touch.cube, token), fill(1.0, touch.cube, token)
    largest, stiff = zero, zero
    for i in range(n):
        value = load(touch.matrix, i * n + i, token)
        largest = where_greater(value, largest, value, largest)
        if i % 3 == 0:
            value = value * load(touch.near, i // 3, token)
            stiff = where_greater(value, stiff, value, stiff)
    for c in range(contacts):
        size = load(touch.matrix, 3 * c * n + 3 * c, token)
        opening = where_greater(size, RIGID * stiff, load(touch.opening, c, token), one * APART)
        store(touch.free, 3 * c, load(touch.free, 3 * c, token) + opening)
        for i in range(3 * c, 3 * c + 3):
            value = load(touch.matrix, i * n + i, token)
            value = where_greater(value, zero, value + REGULARISATION * largest, one)
            store(touch.matrix, i * n + i, value)
            store(touch.impulse, i, zero)


@kernel
def _velocity(matrix, free, impulse, row, n, token):
    """Relative velocity of a row; three sums side by side, one for each row of a contact."""
    a, b, c = load(free, row, token), fill(0.0, matrix, token), fill(0.0, matrix, token)
    t = row * n
    for j in range(0, n, 3):
        a = fma(load(matrix, t + j, token), load(impulse, j, token), a)
        b = fma(load(matrix, t + j + 1, token), load(impulse, j + 1, token), b)
        c = fma(load(matrix, t + j + 2, token), load(impulse, j + 2, token), c)
    return a + b + c


@kernel
def _ease_contacts(matrix, ease, contacts, token):
    """What divides the normal and the tangential velocity of every contact: its own compliance, the tangents' mean."""
    n, one, two = 3 * contacts, fill(1.0, matrix, token), fill(2.0, matrix, token)
    for contact in range(contacts):
        d = 3 * contact * (n + 1)
        store(ease, 2 * contact, one / load(matrix, d, token))
        tangential = load(matrix, d + n + 1, token) + load(matrix, d + 2 * n + 2, token)
        store(ease, 2 * contact + 1, two / tangential)


@kernel
def _updated(matrix, free, impulse, ease, friction, contact, n, token):
    """Impulse of a contact, given all others; see ``fem.contact``."""
    i, zero, one = 3 * contact, fill(0.0, matrix, token), fill(1.0, matrix, token)
    v = _velocity(matrix, free, impulse, i, n, token)
    v1 = _velocity(matrix, free, impulse, i + 1, n, token)
    v2 = _velocity(matrix, free, impulse, i + 2, n, token)
    old, d = load(impulse, i, token), i * n + i
    normal = fnma(v, load(ease, 2 * contact, token), old)
    normal = where_greater(normal, zero, normal, zero)
    change = normal - old
    v1 = fma(load(matrix, d + n, token), change, v1)
    v2 = fma(load(matrix, d + 2 * n, token), change, v2)
    scale = load(ease, 2 * contact + 1, token)
    t1 = fnma(v1, scale, load(impulse, i + 1, token))
    t2 = fnma(v2, scale, load(impulse, i + 2, token))
    square, limit = fma(t1, t1, t2 * t2), friction * normal
    if not any_greater(square, limit * limit):
        return normal, t1, t2
    beyond = where_greater(square, limit * limit, one, zero)
    shrink = where_greater(beyond, zero, limit / square_root(where_greater(beyond, zero, square, one)), one)
    return normal, t1 * shrink, t2 * shrink


@kernel
def _larger(value, largest, zero):
    """The larger of a value's size and another."""
    size = where_greater(value, zero, value, -value)
    return where_greater(size, largest, size, largest)


@kernel
def sweep(touch, matrix, free, contacts, sweeps, settled, token):
    """Gauss-Seidel sweeps over ``impulse`` in the lanes that are ``going``; leaves it 0 in those that have settled."""
    zero, n = fill(0.0, touch.cube, token), 3 * contacts
    friction, going = load(touch.values, 3, token), load(touch.going, 0, token)
    _ease_contacts(matrix, touch.ease, contacts, token)
    for _ in range(sweeps):
        if not any_greater(going, zero):
            break
        change, largest = zero, zero
        for contact in range(contacts):
            x, y, z = _updated(matrix, free, touch.impulse, touch.ease, friction, contact, n, token)
            i = 3 * contact
            a, b, c = (
                load(touch.impulse, i, token),
                load(touch.impulse, i + 1, token),
                load(touch.impulse, i + 2, token),
            )
            x, y, z = (
                where_greater(going, zero, x, a),
                where_greater(going, zero, y, b),
                where_greater(going, zero, z, c),
            )
            change = _larger(x - a, _larger(y - b, _larger(z - c, change, zero), zero), zero)
            largest = _larger(x, _larger(y, _larger(z, largest, zero), zero), zero)
            store(touch.impulse, i, x)
            store(touch.impulse, i + 1, y)
            store(touch.impulse, i + 2, z)
        going = where_greater(change, settled * largest, going, zero)
    store(touch.going, 0, going)


@kernel
def _reduce(touch, work, cables, contacts, token):
    """``reduced`` problem of the contacts, the cables that pull held at their lengths; ``held`` their answers."""
    first, n = 3 * RESTING, 3 * contacts
    substitute_active(work.slack, 0, work.active, cables, work.pivoting, touch.offset, token)
    for i in range(first, n):
        substitute_active(touch.pull, i * cables, work.active, cables, work.pivoting, touch.held, token)
    for i in range(n):
        rate = load(touch.free, i, token)
        for c in range(cables if i >= first else 0):
            rate = fma(load(touch.pull, i * cables + c, token), load(touch.offset, c, token), rate)
        store(touch.reduced_free, i, rate)
        for j in range(n):
            value = load(touch.matrix, i * n + j, token)
            for c in range(cables if min(i, j) >= first else 0):
                pull, answer = load(touch.pull, i * cables + c, token), load(touch.held, j * cables + c, token)
                value = fma(pull, answer, value)
            store(touch.reduced, i * n + j, value)


@kernel
def _pulled(touch, work, cables, contacts, tolerance, token):
    """Tensions at the impulses of the contacts; returns whether all were found."""
    for c in range(cables):
        value = load(work.slack, c, token)
        for i in range(3 * RESTING, 3 * contacts):
            value = fma(load(touch.pull, i * cables + c, token), load(touch.impulse, i, token), value)
        store(touch.offset, c, value)
    return solve_unilateral(
        work.compliance, touch.offset, cables, tolerance, work.active, work.pivoting, work.tension, token
    )


@kernel
def _choose(touch, work, cables, first, token):
    """Lanes whose cables that pull are those of the choice before, and whose contacts have settled, are done; returns
    whether others are left."""
    zero, one = fill(0.0, touch.cube, token), fill(1.0, touch.cube, token)
    other = zero
    for c in range(cables):
        active = load(work.active, c, token)
        other = _larger(active - load(touch.before, c, token), other, zero)
        store(touch.before, c, active)
    going = one if first else where_greater(other, zero, one, load(touch.going, 0, token))
    store(touch.going, 0, going)
    return any_greater(going, zero)


@kernel
def judge_contacts(touch, work, cables, contacts, token):
    """``stuck`` where a contact's own law would change its impulse by more than the tolerance."""
    zero, one, n = fill(0.0, touch.cube, token), fill(1.0, touch.cube, token), 3 * contacts
    for i in range(n):
        rate = load(touch.free, i, token)
        for c in range(cables if i >= 3 * RESTING else 0):
            tension = load(work.tension, c, token)
            tension = where_greater(tension, zero, tension, zero)
            rate = fma(load(touch.pull, i * cables + c, token), tension, rate)
        store(touch.reduced_free, i, rate)
    change, largest, friction = zero, zero, load(touch.values, 3, token)
    _ease_contacts(touch.matrix, touch.ease, contacts, token)
    for contact in range(contacts):
        x, y, z = _updated(touch.matrix, touch.reduced_free, touch.impulse, touch.ease, friction, contact, n, token)
        i = 3 * contact
        a, b, c = load(touch.impulse, i, token), load(touch.impulse, i + 1, token), load(touch.impulse, i + 2, token)
        change = _larger(x - a, _larger(y - b, _larger(z - c, change, zero), zero), zero)
        largest = _larger(a, _larger(b, _larger(c, largest, zero), zero), zero)
    largest = where_greater(largest, zero, largest, one)
    store(touch.stuck, 0, where_greater(change, TOLERANCE * largest, one, zero))


@kernel
def solve_contacts(touch, work, cables, contacts, tolerance, settled, token):
    """Impulses of contacts and unilateral tensions; returns whether the latter were found in all lanes.

    ``work.slack`` and ``work.compliance`` hold the tension problem without contacts, ``work.active`` where to start.
    """
    for choice in range(CABLE_CHOICES):
        _pulled(touch, work, cables, contacts, tolerance, token)
        if not _choose(touch, work, cables, choice == 0, token):
            break
        _reduce(touch, work, cables, contacts, token)
        sweep(touch, touch.reduced, touch.reduced_free, contacts, SWEEPS, settled, token)
    return _pulled(touch, work, cables, contacts, tolerance, token)


@kernel
def stop_cube(touch, contacts, token):
    """The cube's twist ``after`` the contacts' impulses."""
    light = fill(1.0, touch.cube, token) / load(touch.values, 0, token)
    gyration = load(touch.values, 2, token)
    for k in range(6):
        total = fill(0.0, touch.cube, token)
        for i in range(3 * contacts):
            total = fma(load(touch.on_cube, 6 * i + k, token), load(touch.impulse, i, token), total)
        share = light if k < 3 else light / (gyration * gyration)
        store(touch.after, k, fma(share, total, load(touch.twist, k, token)))
