"""Cholesky factorisation of bordered block-tridiagonal matrices, many side by side in SIMD lanes.

The stations of a rod, each of two tiles, are eliminated in sequence from the tip to the base. Three arrays hold, for
every station, the pivot block, the coupling to the next station and the border: rows below the matrix, one for each
right-hand side. All are cut into 3 x 3 tiles and stored panel by panel: rows 3 p to 3 p + 2 of a block are panel p,
element (3 p + r, c) at ``(p * SIZE + c) * 3 + r``. One kernel, panel times transposed panel, does nearly all of the
work. The factorisation turns a border row b' into (L^-1 b)', and products of these rows are b_i' A^-1 b_j.

A border row is zero beyond the station that its cable reaches. Rows come in the order of their reach, so that the
panels which are not zero at a station are its first ``active`` panels.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.simd import fill, fma, fnma, inlined, kernel, load, load3, square_root, store

TILES = 2
"""Tiles of a block: translation and rotation."""
SIZE = 3 * TILES
PANEL = 3 * SIZE
BLOCK = TILES * PANEL


@inlined
def _tile_minus_product(target, t, left, a, right, b, length, token):
    """The tile at ``t`` less the product of ``length`` columns of two panels; nine values, column by column."""
    c0, c1, c2 = load3(target, t, token)
    c3, c4, c5 = load3(target, t + 3, token)
    c6, c7, c8 = load3(target, t + 6, token)
    for k in range(length):
        x, y, z = load3(left, a + 3 * k, token)
        w = load(right, b + 3 * k, token)
        c0, c1, c2 = fnma(x, w, c0), fnma(y, w, c1), fnma(z, w, c2)
        w = load(right, b + 3 * k + 1, token)
        c3, c4, c5 = fnma(x, w, c3), fnma(y, w, c4), fnma(z, w, c5)
        w = load(right, b + 3 * k + 2, token)
        c6, c7, c8 = fnma(x, w, c6), fnma(y, w, c7), fnma(z, w, c8)
    return c0, c1, c2, c3, c4, c5, c6, c7, c8


@kernel
def subtract_product(target, t, left, a, right, b, length, token):
    """Subtract the product of two panels from a tile."""
    c0, c1, c2, c3, c4, c5, c6, c7, c8 = _tile_minus_product(target, t, left, a, right, b, length, token)
    store(target, t, c0, c1, c2, c3, c4, c5, c6, c7, c8)


@kernel
def _pivot_tile(block, row, length, token):
    """Finish the diagonal tile after ``length`` columns: its Cholesky factor, with the diagonal inverted."""
    t = row + 3 * length
    c0, c1, c2, _, c4, c5, _, _, c8 = _tile_minus_product(block, t, block, row, block, row, length, token)
    one = fill(1.0, block, token)
    inverse = one / square_root(c0)
    c1, c2 = c1 * inverse, c2 * inverse
    store(block, t, inverse, c1, c2)
    inverse = one / square_root(fnma(c1, c1, c4))
    c5 = fnma(c2, c1, c5) * inverse
    store(block, t + 4, inverse, c5)
    store(block, t + 8, one / square_root(fnma(c5, c5, fnma(c2, c2, c8))))


@kernel
def _factor_tile(target, row, block, pivot_row, length, token):
    """Finish the tile of a panel below the diagonal tile after ``length`` columns."""
    t, d = row + 3 * length, pivot_row + 3 * length
    c0, c1, c2, c3, c4, c5, c6, c7, c8 = _tile_minus_product(target, t, target, row, block, pivot_row, length, token)
    inverse = load(block, d, token)
    c0, c1, c2 = c0 * inverse, c1 * inverse, c2 * inverse
    lower, inverse = load(block, d + 1, token), load(block, d + 4, token)
    c3, c4, c5 = fnma(c0, lower, c3) * inverse, fnma(c1, lower, c4) * inverse, fnma(c2, lower, c5) * inverse
    lower, last, inverse = load(block, d + 2, token), load(block, d + 5, token), load(block, d + 8, token)
    store(target, t, c0, c1, c2, c3, c4, c5, fnma(c3, last, fnma(c0, lower, c6)) * inverse)
    store(target, t + 7, fnma(c4, last, fnma(c1, lower, c7)) * inverse, fnma(c5, last, fnma(c2, lower, c8)) * inverse)


@kernel
def eliminate(pivot, coupling, border, condensed, station, last, panels, active, token):
    """Factorise one station and carry it over to the next, ``station - 1``, and to the condensed matrix.

    ``panels`` is the height of the border; only its first ``active`` rows are not zero. ``last`` says that no
    station follows.
    """
    p, b = station * BLOCK, station * panels * PANEL
    for k in range(TILES):
        _pivot_tile(pivot, p + k * PANEL, 3 * k, token)
        for i in range(k + 1, TILES):
            _factor_tile(pivot, p + i * PANEL, pivot, p + k * PANEL, 3 * k, token)
        if not last:
            for i in range(TILES):
                _factor_tile(coupling, p + i * PANEL, pivot, p + k * PANEL, 3 * k, token)
        for i in range(active):
            _factor_tile(border, b + i * PANEL, pivot, p + k * PANEL, 3 * k, token)
    for i in range(active):
        for j in range(i + 1):
            subtract_product(condensed, 9 * (i * panels + j), border, b + i * PANEL, border, b + j * PANEL, SIZE, token)
    if last:
        return
    for i in range(TILES):
        for j in range(i + 1):
            t = p - BLOCK + i * PANEL + 9 * j
            subtract_product(pivot, t, coupling, p + i * PANEL, coupling, p + j * PANEL, SIZE, token)
    for i in range(active):
        for j in range(TILES):
            t = b - panels * PANEL + i * PANEL + 9 * j
            subtract_product(border, t, border, b + i * PANEL, coupling, p + j * PANEL, SIZE, token)


@kernel
def extend_border(pivot, coupling, extra, first, top, panels, token):
    """Turn further border rows b', zero above the station ``top``, into (L^-1 b)' after all stations are eliminated."""
    for station in range(top, first - 1, -1):
        p, b = station * BLOCK, station * panels * PANEL
        for i in range(panels):
            for k in range(TILES):
                _factor_tile(extra, b + i * PANEL, pivot, p + k * PANEL, 3 * k, token)
            if station > first:
                for j in range(TILES):
                    t = b - panels * PANEL + i * PANEL + 9 * j
                    subtract_product(extra, t, extra, b + i * PANEL, coupling, p + j * PANEL, SIZE, token)


@kernel
def condense_rows(target, rows, panels, others, other_panels, symmetric, first, top, token):
    """``target`` = minus the products of border rows and others, in tiles, or the lower half of these; both are zero
    above the station ``top``."""
    zero = fill(0.0, target, token)
    for i in range(panels):
        for j in range(i + 1 if symmetric else other_panels):
            t = 9 * (i * other_panels + j)
            for k in range(9):
                store(target, t + k, zero)
            for station in range(first, top + 1):
                a, b = (station * panels + i) * PANEL, (station * other_panels + j) * PANEL
                subtract_product(target, t, rows, a, others, b, SIZE, token)


@kernel
def combine_border(border, weight, values, first, stations, panels, active, token):
    """``values`` = sum_i weight_i L^-1 b_i over the border rows b_i, after all stations >= ``first`` are eliminated.

    ``active``: panels that are not zero, of every station.
    """
    for station in range(first, stations):
        for k in range(SIZE):
            value = fill(0.0, border, token)
            for i in range(active[station]):
                t = ((station * panels + i) * SIZE + k) * 3
                value = fma(load(weight, 3 * i, token), load(border, t, token), value)
                value = fma(load(weight, 3 * i + 1, token), load(border, t + 1, token), value)
                value = fma(load(weight, 3 * i + 2, token), load(border, t + 2, token), value)
            store(values, station * SIZE + k, value)


@kernel
def _subtract_columns(block, t, values, source, target, tiles, token):
    """Subtract the transpose of three columns of a block, from tile row ``t`` on, times the values below from three
    values."""
    x, y, z = load3(values, target, token)
    for i in range(tiles):
        for r in range(3):
            k, value = t + i * PANEL + r, load(values, source + 3 * i + r, token)
            x = fnma(load(block, k, token), value, x)
            y = fnma(load(block, k + 3, token), value, y)
            z = fnma(load(block, k + 6, token), value, z)
    return x, y, z


@kernel
def substitute_back(pivot, coupling, values, first, stations, token):
    """Solve L' x = y in place."""
    for station in range(first, stations):
        s, p = station * SIZE, station * BLOCK
        for k in range(TILES - 1, -1, -1):
            row, t = s + 3 * k, p + k * PANEL + 9 * k
            if station > first:
                x, y, z = _subtract_columns(coupling, p + 9 * k, values, s - SIZE, row, TILES, token)
                store(values, row, x, y, z)
            x, y, z = _subtract_columns(pivot, t + PANEL, values, row + 3, row, TILES - k - 1, token)
            z = z * load(pivot, t + 8, token)
            y = fnma(load(pivot, t + 5, token), z, y) * load(pivot, t + 4, token)
            x = fnma(load(pivot, t + 2, token), z, fnma(load(pivot, t + 1, token), y, x)) * load(pivot, t, token)
            store(values, row, x, y, z)
