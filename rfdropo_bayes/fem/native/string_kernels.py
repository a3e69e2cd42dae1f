"""What taut cables hold between the sections of a layer; see ``fem.cable_strings``.

In the frame of a layer a cable resists s_x, s_y and s_z with its spring T / L, where s_i = sum over modes k of p_k u_ki
+ lever g_ki u_kz; the last term is missing in s_z. Of mode k, w_k is the weight in the way of the cable through the
layer, and g_k that in the mean gradient along the axis that its parity says; p_k is w_k, less lever g_k where that axis
is z. Cables that are slack in all lanes, or end before the layer, are left out: they add exact zeros.
"""

from __future__ import annotations

from rfdropo_bayes.fem.cable_strings import AHEAD_FACTOR, AHEAD_SHORTEST, SHORTEST
from rfdropo_bayes.fem.native.chain_cholesky import subtract_product
from rfdropo_bayes.fem.native.fields import clear
from rfdropo_bayes.fem.native.simd import (
    any_greater,
    fill,
    fma,
    fnma,
    kernel,
    load,
    load3,
    square_root,
    store,
    where_greater,
)


@kernel
def _way(tables, layer, c, field, token):
    """Way of a cable through a layer, of the modes' values in a field."""
    x, y, z = fill(0.0, field, token), fill(0.0, field, token), fill(0.0, field, token)
    first = (layer * tables.cables + c) * 2 * tables.modes
    for k in range(2 * tables.modes):
        weight = fill(tables.crossing[first + k], field, token)
        u, v, w = load3(field, 3 * k, token)
        x, y, z = fma(weight, u, x), fma(weight, v, y), fma(weight, w, z)
    return x, y, z


@kernel
def measure_strings(tables, layer, square, ahead, work, token):
    """Spring, times the ``square`` of a stage's length, and lever of every cable in a layer, whose frame is known;
    ``ahead`` as in ``fem.cable_strings.string_stiffness``."""
    shortest = AHEAD_SHORTEST if ahead else SHORTEST
    if ahead:
        square = AHEAD_FACTOR * square
    modes, cables, axes, a = tables.modes, tables.cables, work.axes, 9 * layer
    zero, one, half = fill(0.0, axes, token), fill(1.0, axes, token), fill(0.5, axes, token)
    base, first, stretch = 3 * layer * modes, 2 * modes * layer, zero
    least = fill(shortest * (tables.rest[base + 3 * modes + 2] - tables.rest[base + 2]), axes, token)
    for k in range(2 * modes):
        kind, slope = tables.parity[k], fill(tables.gradient[first + k], axes, token)
        axis, along = (2 if kind == 0 else kind - 1), zero
        for i in range(3):
            x = load(work.position, base + 3 * k + i, token)
            if k == 0 or k == modes:
                x = x - load(work.position, base + i, token)
            store(work.local, 3 * k + i, x)
            along = fma(load(axes, a + 3 * i + axis, token), x, along)
        stretch = fma(slope, along if kind == 0 else half * along, stretch)
    shrink = one / stretch
    for c in range(cables):
        tension, string = load(work.tension, c, token), 2 * (layer * cables + c)
        if tables.crossing[string * modes] == 0.0 or not any_greater(tension, zero):
            store(work.string, string, zero, zero)
            continue
        x, y, z = _way(tables, layer, c, work.local, token)
        length = square_root(fma(x, x, fma(y, y, z * z)))
        length = where_greater(length, least, length, least)
        store(work.string, string, square * tension / length, length * shrink)


@kernel
def _sum_strings(tables, layer, work, token):
    """Sums over the cables of spring times r_k r_l into ``web``, in tiles, where r is p and then the lever; returns
    False where no cable pulls."""
    modes, cables, ways, pulled, web = tables.modes, tables.cables, work.ways, work.pulled, work.web
    size, zero, taut = 2 * modes, fill(0.0, work.string, token), 0
    panels = size // 3 + 1
    for c in range(cables):
        string = 2 * (layer * cables + c)
        spring, lever = load(work.string, string, token), load(work.string, string + 1, token)
        if not any_greater(spring, zero):
            continue
        for k in range(size + 1):
            t, way = 3 * (k // 3 * cables + taut) + k % 3, lever
            if k < size:
                way = fill(tables.crossing[string * modes + k], lever, token)
                if tables.parity[k] == 0:
                    way = fnma(lever, fill(tables.gradient[size * layer + k], lever, token), way)
            store(ways, t, way)
            store(pulled, t, -(spring * way))
        taut += 1
    clear(web, 0, 9 * panels * panels if taut > 0 else 0, token)
    for i in range(panels if taut > 0 else 0):
        for j in range(i + 1):
            subtract_product(web, 9 * (i * panels + j), pulled, 3 * i * cables, ways, 3 * j * cables, taut, token)
    return taut > 0


@kernel
def _sum_of(k, n, panels, work, token):
    """Entry k >= n of ``web``."""
    return load(work.web, 9 * (k // 3 * panels + n // 3) + 3 * (n % 3) + k % 3, token)


@kernel
def _string_tile(tables, target, t, layer, k, n, work, token):
    """Add the part of modes k and n of a layer to the tile at ``t``."""
    size, axes, a, parity, slope = 2 * tables.modes, work.axes, 9 * layer, tables.parity, tables.gradient
    first, panels = size * layer, size // 3 + 1
    straight, row_kind, column_kind = _sum_of(max(k, n), min(k, n), panels, work, token), parity[k], parity[n]
    row_tilts, column_tilts = row_kind == 1 or row_kind == 2, column_kind == 1 or column_kind == 2
    if not (row_tilts or column_tilts):
        for i in range(3):
            store(target, t + 4 * i, load(target, t + 4 * i, token) + straight)
        return
    zero = fill(0.0, axes, token)
    into, out, tilted = zero, zero, zero
    if column_tilts:
        into = _sum_of(size, k, panels, work, token) * slope[first + n]
    if row_tilts:
        out = _sum_of(size, n, panels, work, token) * slope[first + k]
        if row_kind == column_kind:
            tilted = _sum_of(size, size, panels, work, token) * (slope[first + k] * slope[first + n])
    row, column = a + (row_kind - 1 if row_tilts else 0), a + (column_kind - 1 if column_tilts else 0)
    z0, z1, z2 = load(axes, a + 2, token), load(axes, a + 5, token), load(axes, a + 8, token)
    x0, x1 = into * load(axes, column, token), into * load(axes, column + 3, token)
    x2 = into * load(axes, column + 6, token)
    y0, y1 = fma(out, load(axes, row, token), tilted * z0), fma(out, load(axes, row + 3, token), tilted * z1)
    y2 = fma(out, load(axes, row + 6, token), tilted * z2)
    c0, c1, c2 = load3(target, t, token)
    c3, c4, c5 = load3(target, t + 3, token)
    c6, c7, c8 = load3(target, t + 6, token)
    c0, c1, c2 = fma(z0, y0, c0) + straight, fma(z1, y0, c1), fma(z2, y0, c2)
    c3, c4, c5 = fma(z0, y1, c3), fma(z1, y1, c4) + straight, fma(z2, y1, c5)
    c6, c7, c8 = fma(z0, y2, c6), fma(z1, y2, c7), fma(z2, y2, c8) + straight
    store(target, t, fma(x0, z0, c0), fma(x1, z0, c1), fma(x2, z0, c2))
    store(target, t + 3, fma(x0, z1, c3), fma(x1, z1, c4), fma(x2, z1, c5))
    store(target, t + 6, fma(x0, z2, c6), fma(x1, z2, c7), fma(x2, z2, c8))


@kernel
def add_strings(tables, layer, work, whole, token):
    """Add the strings of a layer to the matrix; ``whole`` as in ``layered_assembly``."""
    modes = tables.modes
    block = 9 * modes * modes
    upper = (layer + 1) * block
    if not _sum_strings(tables, layer, work, token):
        return
    for m in range(modes):
        for n in range(modes):
            tile = 9 * (m * modes + n)
            if n <= m:
                _string_tile(tables, work.pivot, upper + tile, layer, modes + m, modes + n, work, token)
                if whole:
                    _string_tile(tables, work.pivot, upper - block + tile, layer, m, n, work, token)
            if whole:
                _string_tile(tables, work.coupling, upper + tile, layer, m, modes + n, work, token)


@kernel
def add_string_reaction(tables, layer, scale, work, token):
    """Add to ``reaction`` what the strings put against ``local``, a change in the layer's frame, times a scale."""
    modes, cables, local, reaction = tables.modes, tables.cables, work.local, work.reaction
    size, first, zero = 2 * modes, 2 * modes * layer, fill(0.0, work.local, token)
    tx, ty, tz = zero, zero, zero  # what a lever adds to a cable's way
    for k in range(size):
        kind, slope = tables.parity[k], fill(tables.gradient[first + k], zero, token)
        u, v, w = load3(local, 3 * k, token)
        if kind == 0:
            tx, ty, tz = fnma(slope, u, tx), fnma(slope, v, ty), fnma(slope, w, tz)
        elif kind == 1:
            tx = fma(slope, w, tx)
        elif kind == 2:
            ty = fma(slope, w, ty)
    mx, my, mz = zero, zero, zero  # what pulls at the levers
    for c in range(cables):
        string = 2 * (layer * cables + c)
        spring, lever = load(work.string, string, token), load(work.string, string + 1, token)
        if not any_greater(spring, zero):
            continue
        x, y, z = _way(tables, layer, c, local, token)
        pull = spring * scale
        x, y, z = pull * fma(lever, tx, x), pull * fma(lever, ty, y), pull * fma(lever, tz, z)
        mx, my, mz = fma(lever, x, mx), fma(lever, y, my), fma(lever, z, mz)
        for k in range(size):
            weight = fill(tables.crossing[string * modes + k], zero, token)
            fx, fy, fz = load3(reaction, 3 * k, token)
            store(reaction, 3 * k, fma(weight, x, fx), fma(weight, y, fy), fma(weight, z, fz))
    for k in range(size):
        kind, slope = tables.parity[k], fill(tables.gradient[first + k], zero, token)
        fx, fy, fz = load3(reaction, 3 * k, token)
        if kind == 0:
            fx, fy, fz = fnma(slope, mx, fx), fnma(slope, my, fy), fnma(slope, mz, fz)
        elif kind != 3:
            fz = fma(slope, mx if kind == 1 else my, fz)
        store(reaction, 3 * k, fx, fy, fz)
