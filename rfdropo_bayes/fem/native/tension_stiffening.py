"""Geometric stiffness of layers in tension and of taut cables; see ``fem.tension_stiffening``."""

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
def stiffen(tables, layer, rate, work, whole, token):
    """Add N / L against lateral motion of the mean of one face relative to the other, N > 0 of body and cables
    together, over ``rate`` squared.

    ``reaction`` must hold what the layer resists over ``rate``; ``whole`` as in ``layered_assembly``.
    """
    modes, axes, zero = tables.modes, work.axes, fill(0.0, work.axes, token)
    length = tables.rest[3 * (layer + 1) * modes + 2] - tables.rest[3 * layer * modes + 2]
    tension = load(work.reaction, 3 * modes + 2, token) * fill(rate, axes, token)
    for i in range(3):
        tension = fnma(load(work.beyond, 3 * layer + i, token), load(axes, 9 * layer + 3 * i + 2, token), tension)
    spring = where_greater(tension, zero, tension, zero) / fill(length * rate * rate, axes, token)
    store(work.string, layer, spring)
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
    """Subtract what a layer in tension puts against lateral motion, its stiffness in ``string``, times a change."""
    modes, axes, a = tables.modes, work.axes, 9 * layer
    low, high = 3 * layer * modes, 3 * (layer + 1) * modes
    spring, along = load(work.string, layer, token), fill(0.0, axes, token)
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


@kernel
def _twist_tiles(tables, matrix, t, layer, triangle, sign, stiffness, x0, y0, x1, y1, axes, token):
    """Add a stiffness against the relative twist of a layer's faces to the block of two of them, from ``t`` on.

    The twist of a face is q_x . e_y x - q_y . e_x y, where q_x and q_y are its modes linear in x and y.
    """
    modes, across, frame = tables.modes, tables.across, 9 * layer
    for i in range(2):
        for j in range(i + 1 if triangle else 2):
            tile = t + 9 * ((across if i else 1) * modes + (across if j else 1))
            scale = (sign if i == j else -sign) * (stiffness * (y0 if i else x0) * (y1 if j else x1))
            add_dyad(matrix, tile, scale, axes, frame, 1 - i, frame, 1 - j, token)


@kernel
def stiffen_twist(tables, layer, rate, work, whole, token):
    """Add T r^2 / L of all cables against the twist of a layer, over ``rate`` squared."""
    modes, axes, y = tables.modes, work.axes, 3 * tables.across + 1
    block, stiffness = 9 * modes * modes, fill(0.0, axes, token)
    for c in range(tables.cables):
        arm = fill(tables.twist_arm[layer * tables.cables + c], axes, token)
        stiffness = fma(arm, load(work.tension, c, token), stiffness)
    stiffness = stiffness * fill(1.0 / (rate * rate), axes, token)
    store(work.twist, layer, stiffness)
    low, high, upper = 3 * layer * modes, 3 * (layer + 1) * modes, (layer + 1) * block
    x0, y0 = 0.5 / tables.rest[low + 3], 0.5 / tables.rest[low + y]
    x1, y1 = 0.5 / tables.rest[high + 3], 0.5 / tables.rest[high + y]
    _twist_tiles(tables, work.pivot, upper, layer, True, 1.0, stiffness, x1, y1, x1, y1, axes, token)
    if whole:
        _twist_tiles(tables, work.pivot, upper - block, layer, True, 1.0, stiffness, x0, y0, x0, y0, axes, token)
        _twist_tiles(tables, work.coupling, upper, layer, False, -1.0, stiffness, x0, y0, x1, y1, axes, token)


@kernel
def resist_twist(tables, layer, change, field, work, token):
    """Subtract what the cables put against the twist of a layer, its stiffness in ``twist``, times a change."""
    modes, axes, a = tables.modes, work.axes, 9 * layer
    low, high = 3 * layer * modes, 3 * (layer + 1) * modes
    x, y = 3, 3 * tables.across
    x0, y0 = fill(0.5 / tables.rest[low + x], axes, token), fill(0.5 / tables.rest[low + y + 1], axes, token)
    x1, y1 = fill(0.5 / tables.rest[high + x], axes, token), fill(0.5 / tables.rest[high + y + 1], axes, token)
    twist = fill(0.0, axes, token)
    for i in range(3):
        along_x = x1 * load(change, high + x + i, token) - x0 * load(change, low + x + i, token)
        along_y = y1 * load(change, high + y + i, token) - y0 * load(change, low + y + i, token)
        twist = fma(load(axes, a + 3 * i + 1, token), along_x, twist)
        twist = fnma(load(axes, a + 3 * i, token), along_y, twist)
    moment = load(work.twist, layer, token) * twist
    for i in range(3):
        first, second = moment * load(axes, a + 3 * i, token), moment * load(axes, a + 3 * i + 1, token)
        store(field, high + x + i, fnma(second, x1, load(field, high + x + i, token)))
        store(field, low + x + i, fma(second, x0, load(field, low + x + i, token)))
        store(field, high + y + i, fma(first, y1, load(field, high + y + i, token)))
        store(field, low + y + i, fnma(first, y0, load(field, low + y + i, token)))
