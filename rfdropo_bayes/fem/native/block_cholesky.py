"""Cholesky factorisation of symmetric 3 x 3-block matrices of one static pattern, many matrices side by side in SIMD
lanes.

The pattern is analysed once: fill-reducing order (multiple minimum degree, from SuperLU through SciPy), elimination
tree, fill, and for every block of the factor the list of products it receives. The factorisation then runs over these
lists, column by column ("left-looking": George and Liu 1981, Computer Solution of Large Sparse Positive Definite
Systems, ch. 5).

Right-hand sides ride along as dense rows below the matrix. The factorisation turns each row b' into (L^-1 b)', which
is the forward substitution; products of these rows are b_i' A^-1 b_j, the condensed matrix that cables and contacts
need.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Int
from scipy.sparse.linalg import splu

from rfdropo_bayes.fem.native.simd import (
    fill,
    fma,
    fnma,
    kernel,
    load,
    load3,
    mesh_kernel,
    mesh_pasted,
    square_root,
    store,
)


class BlockPattern(NamedTuple):
    """Static structure of a factor with ``n`` columns and ``border`` dense block rows below them.

    Column j holds the blocks ``first[j]:first[j + 1]``: rows in increasing order, the border rows last. Block t is row
    ``row[t]``; it receives the products ``source[k, 0] source[k, 1]'`` for k in ``product[t]:product[t + 1]``. The
    pivot of column j receives ``own[k] own[k]'`` for k in ``own_first[j]:own_first[j + 1]``.
    """

    first: Int[np.ndarray, " n_1"]
    row: Int[np.ndarray, " blocks"]
    product: Int[np.ndarray, " blocks_1"]
    source: Int[np.ndarray, "products 2"]
    own_first: Int[np.ndarray, " n_1"]
    own: Int[np.ndarray, " own_products"]
    border: int


def elimination_order(adjacency: sparse.csr_matrix) -> Int[np.ndarray, " n"]:
    """Order that keeps the fill small: minimum degree, then a postorder, which keeps related entries close in
    memory.
    """
    count = adjacency.shape[0]
    degree = np.asarray(np.abs(adjacency).sum(axis=1)).ravel()
    dominant = (sparse.diags(degree + 1.0) - adjacency).tocsc()
    order = np.argsort(
        splu(dominant, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).perm_c, kind="stable"
    )
    parent = _parents(_columns(adjacency[order][:, order].tocsr()))
    children: list[list[int]] = [[] for _ in range(count + 1)]
    for node, above in enumerate(parent):
        children[above].append(node)
    postorder, stack = [], [count]
    while stack:  # preorder with children reversed, read backwards, is a postorder
        node = stack.pop()
        postorder.append(node)
        stack.extend(children[node])
    return order[np.array(postorder[:0:-1], dtype=int)]


def _columns(matrix: sparse.csr_matrix) -> list[set[int]]:
    """Rows of the factor below the diagonal, column by column: fill passes from a column to its parent."""
    columns = [
        {int(row) for row in matrix.indices[matrix.indptr[j] : matrix.indptr[j + 1]] if row > j}
        for j in range(matrix.shape[0])
    ]
    for rows in columns:
        if rows:
            above = min(rows)
            columns[above] |= rows - {above}
    return columns


def _parents(columns: list[set[int]]) -> list[int]:
    """Elimination tree; the root's parent is the number of columns."""
    return [min(rows) if rows else len(columns) for rows in columns]


def analyse(adjacency: sparse.csr_matrix, border: int) -> BlockPattern:
    """Pattern of the factor of a matrix that is already in elimination order, with ``border`` dense block rows."""
    count = adjacency.shape[0]
    rows = [sorted(column) + list(range(count, count + border)) for column in _columns(adjacency.tocsr())]
    first = np.concatenate([[0], np.cumsum([len(column) for column in rows])]).astype(np.int32)
    place = [{row: int(first[j]) + k for k, row in enumerate(column)} for j, column in enumerate(rows)]
    products: list[list[tuple[int, int]]] = [[] for _ in range(first[-1])]
    own: list[list[int]] = [[] for _ in range(count)]
    for k, column in enumerate(rows):
        for b, lower in enumerate(column):
            if lower >= count:
                break  # products of border rows form the condensed matrix, which is summed apart
            own[lower].append(int(first[k]) + b)
            for a in range(b + 1, len(column)):
                products[place[lower][column[a]]].append((int(first[k]) + a, int(first[k]) + b))
    return BlockPattern(
        first,
        np.concatenate([np.array(column, dtype=np.int32) for column in rows]),
        np.concatenate([[0], np.cumsum([len(items) for items in products])]).astype(np.int32),
        np.array([pair for items in products for pair in items], dtype=np.int32).reshape(-1, 2),
        np.concatenate([[0], np.cumsum([len(items) for items in own])]).astype(np.int32),
        np.array([item for items in own for item in items], dtype=np.int32),
        border,
    )


def block_slot(pattern: BlockPattern, row: int, column: int) -> int:
    """Index of the block (row, column), row > column."""
    first, last = pattern.first[column], pattern.first[column + 1]
    return int(first + np.searchsorted(pattern.row[first:last], row))


@mesh_pasted
def _invert_pivot(pivot, j, token):
    """Replace the lower triangle (00, 10, 11, 20, 21, 22) of a pivot by the inverse of its Cholesky factor, and return
    it."""
    one = fill(1.0, pivot, token)
    i00 = one / square_root(load(pivot, j, token))
    l10 = load(pivot, j + 1, token) * i00
    l20 = load(pivot, j + 3, token) * i00
    i11 = one / square_root(fnma(l10, l10, load(pivot, j + 2, token)))
    l21 = fnma(l20, l10, load(pivot, j + 4, token)) * i11
    i22 = one / square_root(fnma(l21, l21, fnma(l20, l20, load(pivot, j + 5, token))))
    i10 = -(l10 * i00 * i11)
    i21 = -(l21 * i11 * i22)
    i20 = -(fma(l20, i00, l21 * i10) * i22)
    store(pivot, j, i00, i10, i11, i20, i21, i22)
    return i00, i10, i11, i20, i21, i22


@mesh_pasted
def _update_pivot(pivot, j, lower, pattern, column, token):
    """Subtract from a pivot the products of the blocks to its left."""
    p00, p10, p11 = load3(pivot, j, token)
    p20, p21, p22 = load3(pivot, j + 3, token)
    for k in range(pattern.own_first[column], pattern.own_first[column + 1]):
        block = 9 * pattern.own[k]
        for m in range(3):
            a, b, c = (
                load(lower, block + m, token),
                load(lower, block + 3 + m, token),
                load(lower, block + 6 + m, token),
            )
            p00 = fnma(a, a, p00)
            p10 = fnma(b, a, p10)
            p11 = fnma(b, b, p11)
            p20 = fnma(c, a, p20)
            p21 = fnma(c, b, p21)
            p22 = fnma(c, c, p22)
    store(pivot, j, p00, p10, p11, p20, p21, p22)


@mesh_kernel
def factor(pattern, pivot, lower, token):
    """Factorise in place: ``lower`` (9 blocks, lanes) becomes L, ``pivot`` (6 n, lanes) the inverses of its diagonal
    blocks."""
    for column in range(len(pattern.first) - 1):
        _update_pivot(pivot, 6 * column, lower, pattern, column, token)
        i00, i10, i11, i20, i21, i22 = _invert_pivot(pivot, 6 * column, token)
        for block in range(pattern.first[column], pattern.first[column + 1]):
            t = 9 * block
            a00, a01, a02 = load3(lower, t, token)
            a10, a11, a12 = load3(lower, t + 3, token)
            a20, a21, a22 = load3(lower, t + 6, token)
            for k in range(pattern.product[block], pattern.product[block + 1]):
                left, right = 9 * pattern.source[k, 0], 9 * pattern.source[k, 1]
                for m in range(3):
                    x, y, z = (
                        load(lower, right + m, token),
                        load(lower, right + 3 + m, token),
                        load(lower, right + 6 + m, token),
                    )
                    w = load(lower, left + m, token)
                    a00 = fnma(w, x, a00)
                    a01 = fnma(w, y, a01)
                    a02 = fnma(w, z, a02)
                    w = load(lower, left + 3 + m, token)
                    a10 = fnma(w, x, a10)
                    a11 = fnma(w, y, a11)
                    a12 = fnma(w, z, a12)
                    w = load(lower, left + 6 + m, token)
                    a20 = fnma(w, x, a20)
                    a21 = fnma(w, y, a21)
                    a22 = fnma(w, z, a22)
            store(lower, t, a00 * i00, fma(a00, i10, a01 * i11), fma(a00, i20, fma(a01, i21, a02 * i22)), a10 * i00)
            store(lower, t + 4, fma(a10, i10, a11 * i11), fma(a10, i20, fma(a11, i21, a12 * i22)), a20 * i00)
            store(lower, t + 7, fma(a20, i10, a21 * i11), fma(a20, i20, fma(a21, i21, a22 * i22)))


@mesh_kernel
def forward_substitute(pattern, pivot, lower, token):
    """Replace border row 0, a new row b' after `factor`, by (L^-1 b)'."""
    for column in range(len(pattern.first) - 1):
        block = pattern.first[column + 1] - pattern.border
        t, j = 9 * block, 6 * column
        x, y, z = load3(lower, t, token)
        for k in range(pattern.product[block], pattern.product[block + 1]):
            left, right = 9 * pattern.source[k, 0], 9 * pattern.source[k, 1]
            for m in range(3):
                value = load(lower, left + m, token)
                x = fnma(value, load(lower, right + m, token), x)
                y = fnma(value, load(lower, right + 3 + m, token), y)
                z = fnma(value, load(lower, right + 6 + m, token), z)
        store(lower, t, x * load(pivot, j, token), fma(x, load(pivot, j + 1, token), y * load(pivot, j + 2, token)))
        i20, i21, i22 = load3(pivot, j + 3, token)
        store(lower, t + 2, fma(x, i20, fma(y, i21, z * i22)))


@mesh_kernel
def condensed_entry(pattern, lower, i, j, token):
    """Product b_i' A^-1 b_j of two border rows, after `factor`."""
    total = fill(0.0, lower, token)
    for column in range(len(pattern.first) - 1):
        last = pattern.first[column + 1] - pattern.border
        a, b = 9 * (last + i // 3) + 3 * (i % 3), 9 * (last + j // 3) + 3 * (j % 3)
        for m in range(3):
            total = fma(load(lower, a + m, token), load(lower, b + m, token), total)
    return total


@mesh_kernel
def condense(pattern, lower, condensed, token):
    """Products b_i' A^-1 b_j of all border rows i >= j, after `factor`, into ``condensed`` (rows * rows, lanes),
    row-major."""
    rows = 3 * pattern.border
    for i in range(rows):
        for j in range(i + 1):
            total = condensed_entry(pattern, lower, i, j, token)
            store(condensed, i * rows + j, total)
            store(condensed, j * rows + i, total)


@mesh_kernel
def back_substitute(pattern, pivot, lower, weight, solution, token):
    """Solve A x = sum_i weight_i b_i over the border rows b_i, after `factor`; ``solution`` is (3 n, lanes)."""
    for column in range(len(pattern.first) - 2, -1, -1):
        last = pattern.first[column + 1] - pattern.border
        x, y, z = fill(0.0, lower, token), fill(0.0, lower, token), fill(0.0, lower, token)
        for i in range(3 * pattern.border):
            t, factor_i = 9 * (last + i // 3) + 3 * (i % 3), load(weight, i, token)
            x = fma(factor_i, load(lower, t, token), x)
            y = fma(factor_i, load(lower, t + 1, token), y)
            z = fma(factor_i, load(lower, t + 2, token), z)
        for block in range(pattern.first[column], last):
            t, row = 9 * block, 3 * pattern.row[block]
            for m in range(3):
                value = load(solution, row + m, token)
                x = fnma(load(lower, t + 3 * m, token), value, x)
                y = fnma(load(lower, t + 3 * m + 1, token), value, y)
                z = fnma(load(lower, t + 3 * m + 2, token), value, z)
        j = 6 * column
        i20, i21, i22 = load3(pivot, j + 3, token)
        store(solution, 3 * column, fma(load(pivot, j, token), x, fma(load(pivot, j + 1, token), y, i20 * z)))
        store(solution, 3 * column + 1, fma(load(pivot, j + 2, token), y, i21 * z), i22 * z)


@kernel
def extend_border(pattern, pivot, lower, rows, panels, reached, count, token):
    """Turn further block rows b', (column, panel) by blocks of nine, into (L^-1 b)' after `factor`.

    ``reached`` holds 1 for the columns in which a row is not zero, before and after; there are ``count``.
    """
    for column in range(count):
        if reached[column] == 0:
            continue
        j = 6 * column
        i00, i10, i11 = load3(pivot, j, token)
        i20, i21, i22 = load3(pivot, j + 3, token)
        for r in range(3 * panels):
            t = 9 * panels * column + 3 * r
            x, y, z = load3(rows, t, token)
            store(rows, t, x * i00, fma(x, i10, y * i11), fma(x, i20, fma(y, i21, z * i22)))
        for block in range(pattern.first[column], pattern.first[column + 1] - pattern.border):
            below = pattern.row[block]
            reached[below] = 1
            for r in range(3 * panels):
                t, s = 9 * panels * column + 3 * r, 9 * panels * below + 3 * r
                x, y, z = load3(rows, t, token)
                for a in range(3):
                    k = 9 * block + 3 * a
                    value = fnma(x, load(lower, k, token), load(rows, s + a, token))
                    value = fnma(y, load(lower, k + 1, token), value)
                    store(rows, s + a, fnma(z, load(lower, k + 2, token), value))


@kernel
def condense_rows(pattern, target, rows, panels, others, other_panels, own, reached, count, token):
    """Write products of the rows of `extend_border` into ``target``, in tiles by columns: with the same rows if
    ``own``, else with the rows of the factor's border.
    """
    zero = fill(0.0, target, token)
    for tile in range(panels * other_panels):
        i, j = tile // other_panels, tile % other_panels
        c0, c1, c2, c3, c4, c5, c6, c7, c8 = zero, zero, zero, zero, zero, zero, zero, zero, zero
        for column in range(count):
            if reached[column] == 0:
                continue
            t, s = 9 * (panels * column + i), 9 * (other_panels * column + j)
            if not own:
                s = 9 * (pattern.first[column + 1] - pattern.border + j)
            for m in range(3):
                x, y, z = (load(rows, t + m, token), load(rows, t + 3 + m, token), load(rows, t + 6 + m, token))
                w = load(others, s + m, token)
                c0, c1, c2 = fma(x, w, c0), fma(y, w, c1), fma(z, w, c2)
                w = load(others, s + 3 + m, token)
                c3, c4, c5 = fma(x, w, c3), fma(y, w, c4), fma(z, w, c5)
                w = load(others, s + 6 + m, token)
                c6, c7, c8 = fma(x, w, c6), fma(y, w, c7), fma(z, w, c8)
        t = 9 * tile
        store(target, t, c0, c1, c2, c3, c4, c5, c6, c7, c8)
