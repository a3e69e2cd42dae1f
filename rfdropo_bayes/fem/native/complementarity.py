"""Unilateral cable tensions in every lane: block principal pivoting with an exact solve for the active set.

The problem is T >= 0, w = M T + q >= 0, T w = 0 with M symmetric positive definite. First all infeasible indices are
exchanged between the two sets (the primal-dual active set method); should that cycle, only the infeasible index of
highest number is (Murty), which ends (Judice and Pires 1994, Computers & Operations Research 21:587-596). A lane that
has reached its solution stays there bit for bit while others go on.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.simd import any_greater, fill, fma, fnma, kernel, load, square_root, store, where_greater

REGULARISATION = 1e-9
"""Relative compliance added to every cable, so that cables which share one route still have a definite tension."""
FULL_EXCHANGES = 10
MAX_EXCHANGES = 60


@kernel
def factor_active(matrix, active, count, work, token):
    """Cholesky factor of the active set's matrix into ``work`` (count * count, lanes)."""
    one = fill(1.0, matrix, token)
    for i in range(count):
        here = load(active, i, token)
        for j in range(i + 1):
            value = here * load(active, j, token) * load(matrix, i * count + j, token)
            if i == j:
                value = value * (1.0 + REGULARISATION) + (one - here)
            for k in range(j):
                value = fnma(load(work, i * count + k, token), load(work, j * count + k, token), value)
            if i == j:
                store(work, i * count + i, one / square_root(value))
            else:
                store(work, i * count + j, value * load(work, j * count + j, token))


@kernel
def substitute_active(offset, first, active, count, work, tension, token):
    """Tensions of the active set for the offsets from row ``first`` on, after `factor_active`; the others are zero."""
    zero = fill(0.0, work, token)
    for i in range(count):
        value = zero - load(active, i, token) * load(offset, first + i, token)
        for k in range(i):
            value = fnma(load(work, i * count + k, token), load(tension, first + k, token), value)
        store(tension, first + i, value * load(work, i * count + i, token))
    for i in range(count - 1, -1, -1):
        value = load(tension, first + i, token)
        for k in range(i + 1, count):
            value = fnma(load(work, k * count + i, token), load(tension, first + k, token), value)
        store(tension, first + i, value * load(work, i * count + i, token))


@kernel
def solve_for_active(matrix, offset, active, count, work, tension, token):
    """Tensions of the active set by Cholesky; the others are zero. ``work`` is (count * count, lanes)."""
    factor_active(matrix, active, count, work, token)
    substitute_active(offset, 0, active, count, work, tension, token)


@kernel
def solve_unilateral(matrix, offset, count, tolerance, active, work, tension, token):
    """Solve for ``tension`` (count, lanes); returns False if a lane is left without a solution.

    ``matrix`` is (count * count, lanes), row-major; ``active`` holds 1 for the indices to try first as positive and
    else 0, and is left at the solution's. ``work`` is (count * (count + 1), lanes). Slacks, and tensions times their
    diagonal entry, count as feasible above ``-tolerance`` times the largest offset.
    """
    zero, one = fill(0.0, matrix, token), fill(1.0, matrix, token)
    wrong = count * count
    threshold = zero
    for i in range(count):
        size = load(offset, i, token)
        size = where_greater(size, zero, size, -size) * tolerance
        threshold = where_greater(size, threshold, size, threshold)
    for exchange in range(MAX_EXCHANGES):
        solve_for_active(matrix, offset, active, count, work, tension, token)
        largest = zero
        for i in range(count):
            slack = load(offset, i, token)
            for k in range(count):
                slack = fma(load(matrix, i * count + k, token), load(tension, k, token), slack)
            value = where_greater(
                load(active, i, token), zero, load(tension, i, token) * load(matrix, i * count + i, token), slack
            )
            bad = where_greater(-value, threshold, one, zero)
            store(work, wrong + i, bad)
            largest = where_greater(bad, zero, fill(1.0 + i, matrix, token), largest)
        if not any_greater(largest, zero):
            return True
        for i in range(count):
            bad, state = load(work, wrong + i, token), load(active, i, token)
            if exchange >= FULL_EXCHANGES:
                bad = where_greater(largest, fill(i + 0.5, matrix, token), bad, zero)
                bad = where_greater(largest, fill(i + 1.5, matrix, token), zero, bad)
            store(active, i, state + bad * (one - state - state))
    return False
