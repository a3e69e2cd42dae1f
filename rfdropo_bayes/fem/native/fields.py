"""Rows of fields in SIMD lanes: cleared, read at points, and filled from a batch."""

from __future__ import annotations

from rfdropo_bayes.fem.native.simd import fill, fma, kernel, load, store


@kernel
def clear(rows, first, last, token):
    """Zero the rows from first to last."""
    zero = fill(0.0, rows, token)
    for i in range(first, last):
        store(rows, i, zero)


@kernel
def point(first, place, weight, p, field, token):
    """Point p of a sparse list."""
    return weighted(place, weight, first[p], first[p + 1], field, token)


@kernel
def weighted(place, weight, first, last, field, token):
    """Weighted sum of a field's vectors."""
    x, y, z = fill(0.0, field, token), fill(0.0, field, token), fill(0.0, field, token)
    for k in range(first, last):
        row, w = place[k], fill(weight[k], field, token)
        x = fma(load(field, row, token), w, x)
        y = fma(load(field, row + 1, token), w, y)
        z = fma(load(field, row + 2, token), w, z)
    return x, y, z


@kernel
def fill_lanes(source, pitch, offset, width, first, count, target, token):
    """Spread rows of a batch, ``pitch`` apart, over lanes; lanes beyond the batch repeat its last row."""
    lanes = len(token)
    for lane in range(lanes):
        row = min(first + lane, count - 1) * pitch + offset
        for i in range(width):
            target[i * lanes + lane] = source[row + i]
