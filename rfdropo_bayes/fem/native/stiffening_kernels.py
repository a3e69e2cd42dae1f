"""Geometric stiffness of layers in tension; see ``fem.tension_stiffening``."""

from __future__ import annotations

from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, store, where_greater


@kernel
def sum_cable_forces(tables, work, token):
    """``beyond``: force of the cables on all stations beyond each layer. The border must still hold the rows dl/dx."""
    size, panels = 3 * tables.modes, (tables.cables + 3) // 3
    x, y, z = fill(0.0, work.border, token), fill(0.0, work.border, token), fill(0.0, work.border, token)
    for layer in range(tables.stations - 2, -1, -1):
        for c in range(tables.cables):
            row = c + 1
            t = 3 * size * ((layer + 1) * panels + row // 3) + row % 3
            tension = load(work.tension, c, token)
            x = fnma(tension, load(work.border, t, token), x)
            y = fnma(tension, load(work.border, t + 3, token), y)
            z = fnma(tension, load(work.border, t + 6, token), z)
        store(work.beyond, 3 * layer, x, y, z)


@kernel
def stiffen(tables, factors, layer, rate, work, whole, token):
    """Add N / L against lateral motion of the mean of one face relative to the other, N > 0 of body and cables
    together, over ``rate`` squared.

    ``held`` must hold the axial force that the layer resists, over ``rate``; ``whole`` as in ``layered_assembly``.
    """
    modes, axes, zero = tables.modes, work.axes, fill(0.0, work.axes, token)
    length = tables.rest[3 * (layer + 1) * modes + 2] - tables.rest[3 * layer * modes + 2]
    wide = load(factors.wide, 0, token)
    tension = load(work.held, layer, token) * fill(rate, axes, token) * load(factors.narrow, 0, token)
    for i in range(3):
        tension = fnma(load(work.beyond, 3 * layer + i, token), load(axes, 9 * layer + 3 * i + 2, token), tension)
    spring = where_greater(tension, zero, tension, zero) / fill(length * rate * rate, axes, token) * (wide * wide)
    store(work.held, layer, spring)
    block = 9 * modes * modes
    upper = (layer + 1) * block
    for c in range(3):
        for r in range(3):
            along = load(axes, 9 * layer + 3 * r + 2, token) * load(axes, 9 * layer + 3 * c + 2, token)
            value = fma(spring, fill(1.0 if r == c else 0.0, axes, token), -(spring * along))
            k = 3 * c + r
            store(work.pivot, upper + k, load(work.pivot, upper + k, token) + value)
            if whole:
                store(work.pivot, upper - block + k, load(work.pivot, upper - block + k, token) + value)
                store(work.coupling, upper + k, load(work.coupling, upper + k, token) - value)


@kernel
def resist_lateral(tables, layer, change, field, work, token):
    """Subtract what a layer in tension puts against lateral motion, its stiffness in ``held``, times a change."""
    modes, axes, a = tables.modes, work.axes, 9 * layer
    low, high = 3 * layer * modes, 3 * (layer + 1) * modes
    spring, along = load(work.held, layer, token), fill(0.0, axes, token)
    for i in range(3):
        gap = load(change, high + i, token) - load(change, low + i, token)
        along = fma(load(axes, a + 3 * i + 2, token), gap, along)
    for i in range(3):
        gap = load(change, high + i, token) - load(change, low + i, token)
        pull = spring * fnma(load(axes, a + 3 * i + 2, token), along, gap)
        store(field, high + i, load(field, high + i, token) - pull)
        store(field, low + i, load(field, low + i, token) + pull)


@kernel
def add_dyad(matrix, t, scale, axes, a, i, b, j, token):
    """Add the dyad of two columns of a layer's axes to the tile at ``t``."""
    for c in range(3):
        right = scale * load(axes, b + 3 * c + j, token)
        for r in range(3):
            k = t + 3 * c + r
            store(matrix, k, fma(load(axes, a + 3 * r + i, token), right, load(matrix, k, token)))
