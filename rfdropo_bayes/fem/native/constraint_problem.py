"""Cables, slip and contacts of a step in every lane: the convex problem of ``fem.constraints``, by Newton's method.

G, the derivative of the constraints' impulses, is L S L' with signs S and columns L: one for a cable or a run of
guides, three for a contact. With r = L a + l the solution of (I + G W) d = r is d = L y + l, with (S + L' W L) y = S a
- L' W l: symmetric, no larger than the active part, and free of differences of the large numbers 1 / R. A converged
lane keeps its impulses while others continue, and inactive rows add exact zeros: a lane's result does not depend on its
neighbours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.fem.cable_friction import PRESLIDING
from rfdropo_bayes.fem.constraints import (
    APART,
    CABLE_SOFTNESS,
    HALVINGS,
    ITERATIONS,
    NORMAL_SOFTNESS,
    RIGID,
    TANGENT_SOFTNESS,
)
from rfdropo_bayes.fem.native.simd import (
    aligned_zeros,
    any_greater,
    fill,
    fma,
    fnma,
    kernel,
    load,
    load3,
    magnitude,
    square_root,
    store,
    where_greater,
)

SETTLED = {"float64": 1e-11, "float32": 1e-5}
"""Error of a velocity, relative to the largest that a row has or its impulse makes, that ends a lane's iterations. In
single precision 43 of 600 prior draws of the demo never came to 3e-6; all come to 1e-5."""
SOFTNESS = {"float64": CABLE_SOFTNESS, "float32": 1e-5}
"""Softness of cables, relative to W. At smaller values rounding hides which sign the impulse of a taut cable has, and a
push is accepted as solved: 52 of 192 rollouts of nearly incompressible trunks then err by over 1e-5 m at 1e-6, 9 at
1e-5.
"""
ROUNDING = 0.03
"""Largest rounding of the velocities, as a share of that error."""
RATIO = TANGENT_SOFTNESS / NORMAL_SOFTNESS


class ConstraintProblem(NamedTuple):
    """Constraints of a step in one lane block; rows belong to cables, runs of guides, and contacts (three each).

    Lines are the rows of cables and runs. The last axis is the lane.
    """

    matrix: Float[np.ndarray, "rows2 lanes"]  # condensed compliance W, row-major [1/kg]
    free: Float[np.ndarray, "rows lanes"]  # velocities without impulses [m/s]
    impulse: Float[np.ndarray, "rows lanes"]  # [N s]; start of the iterations, and their result
    before: Float[np.ndarray, "rows lanes"]  # impulses before a correction
    velocity: Float[np.ndarray, "rows lanes"]
    aim: Float[np.ndarray, "rows lanes"]  # change that the constraints ask of the impulses, in the columns L
    left: Float[np.ndarray, "rows lanes"]  # and beside them; then the change d
    moving: Float[np.ndarray, "rows lanes"]  # change of the velocities in an iteration
    firmness: Float[np.ndarray, "lines lanes"]  # of a line: impulse per velocity
    limit: Float[np.ndarray, "lines lanes"]  # of a run: impulse if all of its friction is mobilised
    trial: Float[np.ndarray, "lines lanes"]  # of a run: share of the friction mobilised at the start
    opening: Float[np.ndarray, "contacts lanes"]  # gap over the time step [m/s]
    held: Float[np.ndarray, "tangents lanes"]  # of a contact: tangential impulses of the step before
    normal: Float[np.ndarray, "contacts lanes"]  # 1 / R
    tangent: Float[np.ndarray, "contacts lanes"]
    friction: Float[np.ndarray, "1 lanes"]
    sign: Float[np.ndarray, "lines lanes"]
    root: Float[np.ndarray, "roots lanes"]  # columns L: one of a line, 00 10 20 11 21 22 of a contact
    tilted: Float[np.ndarray, "rows2 lanes"]  # W L
    factor: Float[np.ndarray, "rows2 lanes"]
    answer: Float[np.ndarray, "rows lanes"]  # y
    going: Float[np.ndarray, "1 lanes"]
    column: Int[np.ndarray, " rows"]  # of L that act in any lane: row of a line or of a contact's column


def problem_storage(lines: int, contacts: int, lanes: int, dtype: type) -> ConstraintProblem:
    """Zeroed, aligned storage of one lane block."""
    rows = lines + 3 * contacts
    sizes = {
        "matrix": rows**2, "free": rows, "impulse": rows, "before": rows, "velocity": rows, "aim": rows,
        "left": rows, "moving": rows,
        "firmness": lines, "limit": lines, "trial": lines, "opening": contacts, "held": 2 * contacts,
        "normal": contacts, "tangent": contacts, "friction": 1, "sign": lines, "root": lines + 6 * contacts,
        "tilted": rows**2, "factor": rows**2, "answer": rows, "going": 1,
    }  # fmt: skip
    arrays = {name: aligned_zeros((max(size, 1), lanes), dtype) for name, size in sizes.items()}
    return ConstraintProblem(**arrays, column=np.zeros(max(rows, 1), dtype=np.int64))


@kernel
def soften(p, cables, runs, contacts, time_step, softness, token):
    """Softness of every row from the diagonal of W; rows of parts that cannot move take no part."""
    zero, one, lines = fill(0.0, p.free, token), fill(1.0, p.free, token), cables + runs
    n, largest, follows = lines + 3 * contacts, zero, time_step / PRESLIDING
    for c in range(cables):
        value = load(p.matrix, c * n + c, token)
        largest = where_greater(value, largest, value, largest)
    for c in range(cables):
        value = load(p.matrix, c * n + c, token)
        usable = where_greater(value, RIGID * largest, one, zero)
        firm = usable / (softness * where_greater(usable, zero, value, one))
        store(p.firmness, c, firm)
        store(p.sign, c, one)
    for r in range(cables, lines):
        impulse = load(p.limit, r, token)
        store(p.firmness, r, follows * impulse)
        store(p.sign, r, where_greater(zero, impulse, -one, one))
    largest = zero
    for c in range(contacts):
        mean = zero
        for i in range(lines + 3 * c, lines + 3 * c + 3):
            mean = fma(load(p.matrix, i * n + i, token), 1.0 / 3.0, mean)
        store(p.normal, c, mean)
        largest = where_greater(mean, largest, mean, largest)
    for c in range(contacts):
        mean = load(p.normal, c, token)
        moves = where_greater(mean, RIGID * largest, one, zero)
        inverse = one / where_greater(moves, zero, mean, one)
        store(p.opening, c, where_greater(moves, zero, load(p.opening, c, token), one * APART))
        store(p.normal, c, inverse * (1.0 / NORMAL_SOFTNESS))
        store(p.tangent, c, inverse * (1.0 / TANGENT_SOFTNESS))


@kernel
def _line(p, i, cables, velocity, token):
    """Impulse of a line at a velocity."""
    zero, firm = fill(0.0, p.free, token), load(p.firmness, i, token)
    if i < cables:
        return where_greater(zero, velocity, -firm * velocity, zero)
    whole = load(p.limit, i, token)
    answer, bound = fnma(firm, velocity, whole * load(p.trial, i, token)), whole * load(p.sign, i, token)
    answer = where_greater(answer, bound, bound, answer)
    return where_greater(-bound, answer, -bound, answer)


@kernel
def _contact_state(p, c, u, v, w, token):
    """Quantities of a contact at a relative velocity: impulses in sticking, their tangential size, the normal impulse
    in sliding, and friction.
    """
    friction, one = load(p.friction, 0, token), fill(1.0, p.free, token)
    y = (-load(p.opening, c, token) - u) * load(p.normal, c, token)
    firm = load(p.tangent, c, token)
    a, b = fnma(v, firm, load(p.held, 2 * c, token)), fnma(w, firm, load(p.held, 2 * c + 1, token))
    size = square_root(fma(a, a, b * b))
    hat = friction * RATIO
    push = fma(hat, size, y) / fma(friction, hat, one)
    return y, a, b, size, push, friction


@kernel
def _contact(p, c, u, v, w, token):
    """Impulses of a contact at a relative velocity: one normal and two tangential."""
    zero, one = fill(0.0, p.free, token), fill(1.0, p.free, token)
    y, a, b, size, push, friction = _contact_state(p, c, u, v, w, token)
    push = where_greater(push, zero, push, zero)
    shrink = friction * push / where_greater(size, zero, size, one)
    sticks = where_greater(friction * y, size, one, zero)
    shrink = where_greater(sticks, zero, one, shrink)
    return where_greater(sticks, zero, y, push), shrink * a, shrink * b


@kernel
def _linearise_contact(p, c, lines, token):
    """Columns L of a contact at its velocity, and the required change of its impulses."""
    zero, one, i = fill(0.0, p.free, token), fill(1.0, p.free, token), lines + 3 * c
    u, v, w = load3(p.velocity, i, token)
    y, a, b, size, push, friction = _contact_state(p, c, u, v, w, token)
    sticks = where_greater(friction * y, size, one, zero)
    inverse = one / where_greater(size, zero, size, one)
    f, g = a * inverse, b * inverse
    push = where_greater(push, zero, push, zero)
    grown = one / fma(friction, friction * RATIO, one)
    firm, firm_tangent = square_root(load(p.normal, c, token)), square_root(load(p.tangent, c, token))
    along = where_greater(push, zero, firm * square_root(grown), zero)
    across = where_greater(size, zero, firm_tangent * square_root(friction * push * inverse), zero)
    l00, l11, l22 = (
        where_greater(sticks, zero, firm, along),
        where_greater(sticks, zero, firm_tangent, -across * g),
        where_greater(sticks, zero, firm_tangent, zero),
    )
    l10, l20, l21 = (
        where_greater(sticks, zero, zero, along * friction * f),
        where_greater(sticks, zero, zero, along * friction * g),
        where_greater(sticks, zero, zero, across * f),
    )
    root = lines + 6 * c
    store(p.root, root, l00, l10, l20, l11, l21, l22)
    slide = friction * push
    x = where_greater(sticks, zero, y, push) - load(p.impulse, i, token)
    y = where_greater(sticks, zero, a, slide * f) - load(p.impulse, i + 1, token)
    z = where_greater(sticks, zero, b, slide * g) - load(p.impulse, i + 2, token)
    # The columns are orthogonal: their part of the change, and the rest.
    square = fma(l00, l00, fma(l10, l10, l20 * l20))
    r0 = fma(l00, x, fma(l10, y, l20 * z)) / where_greater(square, zero, square, one)
    square = fma(l11, l11, l21 * l21)
    r1 = fma(l11, y, l21 * z) / where_greater(square, zero, square, one)
    r2 = z / where_greater(l22, zero, l22, one)
    r2 = where_greater(l22, zero, r2, zero)
    store(p.aim, i, r0, r1, r2)
    free = where_greater(sticks, zero, zero, one)
    store(p.left, i, free * fnma(l00, r0, x), free * fnma(l11, r1, fnma(l10, r0, y)))
    store(p.left, i + 2, free * fnma(l21, r1, fnma(l20, r0, z)))


@kernel
def _linearise_line(p, i, cables, first, rounding, token):
    """As `_linearise_contact`, of a line; cables that pulled still pull in the first iteration, and also if rounding
    hides their velocity.
    """
    zero, one = fill(0.0, p.free, token), fill(1.0, p.free, token)
    velocity, impulse, firm = load(p.velocity, i, token), load(p.impulse, i, token), load(p.firmness, i, token)
    root = square_root(magnitude(firm, zero))
    answer = _line(p, i, cables, velocity, token)
    if i < cables:
        active = where_greater(zero, velocity, one, zero)
        hidden = one if first else where_greater(magnitude(velocity, zero), rounding, zero, one)
        active = where_greater(impulse, zero, where_greater(active, hidden, active, hidden), active)
        answer = -firm * velocity
    else:
        bound = load(p.limit, i, token) * load(p.sign, i, token)
        active = where_greater(bound, magnitude(answer, zero), one, zero)
    root = where_greater(active, zero, root, zero)
    acts = where_greater(root, zero, one, zero)
    store(p.root, i, root)
    aim = load(p.sign, i, token) * (answer - impulse) / where_greater(acts, zero, root, one)
    store(p.aim, i, acts * aim)
    if i < cables:
        answer = zero
    store(p.left, i, where_greater(acts, zero, zero, answer - impulse))


@kernel
def _linearise(p, cables, lines, contacts, first, rounding, token):
    """Columns L at ``velocity``, ``aim`` and ``left``: the required change of the impulses, in L and beside it. Returns
    the number of active columns.
    """
    zero, n = fill(0.0, p.free, token), lines + 3 * contacts
    for i in range(lines):
        _linearise_line(p, i, cables, first, rounding, token)
    for c in range(contacts):
        _linearise_contact(p, c, lines, token)
    m = 0
    for i in range(n):
        root = _first_root(i, lines)
        size = magnitude(load(p.root, root, token), zero)
        if i >= lines and (i - lines) % 3 == 1:
            size = size + magnitude(load(p.root, root + 1, token), zero)
        if any_greater(size, zero):
            p.column[m] = i
            m += 1
    return m


@kernel
def _first_root(i, lines):
    """Index of the first entry of column i."""
    if i < lines:
        return i
    at = (i - lines) % 3
    return lines + 6 * ((i - lines) // 3) + (0 if at == 0 else 3 if at == 1 else 5)


@kernel
def _times_column(p, values, at, i, lines, token):
    """Product of column i of L and the values from ``at`` on, one for each row."""
    root = _first_root(i, lines)
    total = load(values, at + i, token) * load(p.root, root, token)
    if i >= lines:
        for k in range(1, 3 - (i - lines) % 3):
            total = fma(load(values, at + i + k, token), load(p.root, root + k, token), total)
    return total


@kernel
def _multiply(matrix, values, row, n, token):
    """Row of a matrix times values; three sums side by side, each with the same rows however many zeros follow."""
    a, b, c = fill(0.0, matrix, token), fill(0.0, matrix, token), fill(0.0, matrix, token)
    t, whole = row * n, n - n % 3
    for j in range(0, whole, 3):
        a = fma(load(matrix, t + j, token), load(values, j, token), a)
        b = fma(load(matrix, t + j + 1, token), load(values, j + 1, token), b)
        c = fma(load(matrix, t + j + 2, token), load(values, j + 2, token), c)
    if whole < n:
        a = fma(load(matrix, t + whole, token), load(values, whole, token), a)
    if whole + 1 < n:
        b = fma(load(matrix, t + whole + 1, token), load(values, whole + 1, token), b)
    return a + b + c


@kernel
def _factor(p, lines, n, m, token):
    """L D L' of S + L' W L: L D below the diagonal, L above it, and the inverse of D on it."""
    one = fill(1.0, p.free, token)
    for k in range(m):
        column = p.column[k]
        for i in range(n):
            store(p.tilted, k * n + i, _times_column(p, p.matrix, i * n, column, lines, token))
    for i in range(m):
        row = p.column[i]
        for j in range(i + 1):
            value = _times_column(p, p.tilted, j * n, row, lines, token)
            if i == j:
                value = value + (load(p.sign, row, token) if row < lines else one)
            for k in range(j):
                value = fnma(load(p.factor, i * m + k, token), load(p.factor, k * m + j, token), value)
            if i == j:
                store(p.factor, i * m + i, one / value)
            else:
                store(p.factor, i * m + j, value)
                store(p.factor, j * m + i, value * load(p.factor, j * m + j, token))


@kernel
def _substitute(p, m, token):
    """Solve in place for ``answer``."""
    for i in range(m):
        value = load(p.answer, i, token)
        for k in range(i):
            value = fnma(load(p.factor, k * m + i, token), load(p.answer, k, token), value)
        store(p.answer, i, value)
    for i in range(m - 1, -1, -1):
        value = load(p.answer, i, token) * load(p.factor, i * m + i, token)
        for k in range(i + 1, m):
            value = fnma(load(p.factor, i * m + k, token), load(p.answer, k, token), value)
        store(p.answer, i, value)


@kernel
def _change(p, lines, n, m, token):
    """Turn ``left`` into the change d of the impulses, and ``moving`` into W d."""
    zero = fill(0.0, p.free, token)
    largest = zero
    for i in range(n):
        left = magnitude(load(p.left, i, token), zero)
        largest = where_greater(left, largest, left, largest)
    beside = any_greater(largest, zero)
    for i in range(n):
        store(p.moving, i, _multiply(p.matrix, p.left, i, n, token) if beside else zero)
    for k in range(m):
        column = p.column[k]
        store(p.answer, k, load(p.aim, column, token) - _times_column(p, p.moving, 0, column, lines, token))
    _factor(p, lines, n, m, token)
    _substitute(p, m, token)
    for k in range(m):
        column, y = p.column[k], load(p.answer, k, token)
        for i in range(n):
            store(p.moving, i, fma(load(p.tilted, k * n + i, token), y, load(p.moving, i, token)))
        root = _first_root(column, lines)
        for e in range(1 if column < lines else 3 - (column - lines) % 3):
            value = fma(load(p.root, root + e, token), y, load(p.left, column + e, token))
            store(p.left, column + e, value)


@kernel
def _slope(p, cables, lines, contacts, share, token):
    """Slope of the problem's function along the change, at a share of it."""
    total = fill(0.0, p.free, token)
    for i in range(lines):
        velocity = fma(share, load(p.moving, i, token), load(p.velocity, i, token))
        left = fma(share, load(p.left, i, token), load(p.impulse, i, token)) - _line(p, i, cables, velocity, token)
        total = fma(load(p.moving, i, token), left, total)
    for c in range(contacts):
        i = lines + 3 * c
        x, y, z = load3(p.moving, i, token)
        u = fma(share, x, load(p.velocity, i, token))
        v = fma(share, y, load(p.velocity, i + 1, token))
        w = fma(share, z, load(p.velocity, i + 2, token))
        u, v, w = _contact(p, c, u, v, w, token)
        total = fma(x, fma(share, load(p.left, i, token), load(p.impulse, i, token)) - u, total)
        total = fma(y, fma(share, load(p.left, i + 1, token), load(p.impulse, i + 1, token)) - v, total)
        total = fma(z, fma(share, load(p.left, i + 2, token), load(p.impulse, i + 2, token)) - w, total)
    return total


@kernel
def _firmness(p, i, lines, token):
    """Derivative of a row's impulse by its own velocity."""
    if i < lines:
        root = load(p.root, i, token)
        return root * root
    root, at = lines + 6 * ((i - lines) // 3), (i - lines) % 3
    first = load(p.root, root + at, token)
    if at == 0:
        return first * first
    second, third = load(p.root, root + 2 + at, token), load(p.root, root + 5, token)
    total = fma(first, first, second * second)
    return total if at == 1 else fma(third, third, total)


@kernel
def _residual(p, lines, n, token):
    """Largest error of a velocity: of active columns, over the norm of their column L, and of columns to release."""
    zero, one = fill(0.0, p.free, token), fill(1.0, p.free, token)
    largest = zero
    for i in range(n):
        root, square = _first_root(i, lines), zero
        for k in range(1 if i < lines else 3 - (i - lines) % 3):
            entry = load(p.root, root + k, token)
            square = fma(entry, entry, square)
        wrong = magnitude(load(p.aim, i, token), zero) / square_root(where_greater(square, zero, square, one))
        wrong = wrong + magnitude(load(p.left, i, token) * load(p.matrix, i * n + i, token), zero)
        largest = where_greater(wrong, largest, wrong, largest)
    return largest


@kernel
def _doubt(p, lines, n, rounding, settled, each, token):
    """Slope of the problem's function that rounding errors of velocities would cause: all errors with the ``rounding``
    of the largest velocity, or ``each`` relative to its own velocity.

    The velocity of loose cables (3 m/s) is no scale for a cube at rest, whose contacts change from sticking to sliding
    within 1 um/s. In single precision with SDIRK2, 19 of 512 prior draws of TrunkPush do not converge with the largest
    velocity, and 4 with each. The largest number is 3 in implicit Euler; stored recordings and policies depend on its
    digits.
    """
    zero, total = fill(0.0, p.free, token), fill(0.0, p.free, token)
    for i in range(n):
        change = magnitude(load(p.moving, i, token), zero)
        if each:
            size, other = magnitude(load(p.free, i, token), zero), magnitude(load(p.velocity, i, token), zero)
            size = where_greater(other, size, other, size)
            other = magnitude(load(p.matrix, i * n + i, token) * load(p.impulse, i, token), zero)
            change = change * where_greater(other, size, other, size) * (ROUNDING * settled)
        total = fma(change, _firmness(p, i, lines, token), total)
    return total if each else total * rounding


@kernel
def _search_share(p, cables, lines, contacts, going, doubt, token):
    """The share of the change at which its slope vanishes, at most 1; slopes up to ``doubt`` are rounding."""
    zero, one = fill(0.0, p.free, token), fill(1.0, p.free, token)
    beyond = where_greater(going, zero, _slope(p, cables, lines, contacts, one, token), zero)
    if not any_greater(beyond, doubt):
        return one
    low, high = zero, one
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        ahead = _slope(p, cables, lines, contacts, middle, token)
        low, high = where_greater(ahead, zero, low, middle), where_greater(ahead, zero, middle, high)
    return where_greater(beyond, doubt, 0.5 * (low + high), one)


@kernel
def solve_problem(p, cables, runs, contacts, settled, each, token):
    """Solve for ``impulse`` from its present value, and for the ``velocity`` that follows; ``going`` stays 1 without
    convergence. ``each``: see `_doubt`.
    """
    zero, lines = fill(0.0, p.free, token), cables + runs
    n, going = lines + 3 * contacts, fill(1.0, p.free, token)
    for iteration in range(ITERATIONS):
        largest = zero
        for i in range(n):
            free = load(p.free, i, token)
            velocity = free + _multiply(p.matrix, p.impulse, i, n, token)
            store(p.velocity, i, velocity)
            free = magnitude(free, zero)
            own = magnitude(load(p.matrix, i * n + i, token) * load(p.impulse, i, token), zero)
            largest = where_greater(free, largest, free, largest)
            largest = where_greater(own, largest, own, largest)
        rounding = largest * (ROUNDING * settled)
        m = _linearise(p, cables, lines, contacts, iteration == 0, rounding, token)
        going = where_greater(_residual(p, lines, n, token), settled * largest, going, zero)
        if not any_greater(going, zero):
            break
        _change(p, lines, n, m, token)
        doubt = _doubt(p, lines, n, rounding, settled, each, token)
        share = _search_share(p, cables, lines, contacts, going, doubt, token)
        for i in range(n):
            impulse = fma(share, load(p.left, i, token), load(p.impulse, i, token))
            store(p.impulse, i, where_greater(going, zero, impulse, load(p.impulse, i, token)))
    store(p.going, 0, going)
