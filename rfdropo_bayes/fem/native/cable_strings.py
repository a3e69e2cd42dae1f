"""What taut cables hold between the sections of a layer; see ``fem.cable_strings``.

In the frame of a layer a cable resists s_x, s_y and s_z with its spring T / L, where s_i = sum over modes k of p_k u_ki
+ lever g_ki u_kz; the last term is missing in s_z. Of mode k, w_k is the weight in the way of the cable through the
layer, and g_k that in the mean gradient along the axis that its parity says; p_k is w_k, less lever g_k where that axis
is z.
"""

from __future__ import annotations

from rfdropo_bayes.fem.cable_strings import SHORTEST
from rfdropo_bayes.fem.native.fields import clear
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, load3, square_root, store, where_greater


@kernel
def measure_strings(tables, layer, rate, work, token):
    """Spring, over ``rate`` squared, and lever of every cable in a layer, whose frame is known."""
    modes, cables, axes, a = tables.modes, tables.cables, work.axes, 9 * layer
    half, base, first = fill(0.5, axes, token), 3 * layer * modes, 2 * modes * layer
    least = fill(SHORTEST * (tables.rest[base + 3 * modes + 2] - tables.rest[base + 2]), axes, token)
    stretch = fill(0.0, axes, token)
    for k in range(2 * modes):
        kind, slope = tables.parity[k % modes], fill(tables.gradient[first + k], axes, token)
        axis, along = (2 if kind == 0 else kind - 1), fill(0.0, axes, token)
        for i in range(3):
            x = load(work.position, base + 3 * k + i, token)
            if k == 0 or k == modes:
                x = x - load(work.position, base + i, token)
            store(work.local, 3 * k + i, x)
            along = fma(load(axes, a + 3 * i + axis, token), x, along)
        stretch = fma(slope, along if kind == 0 else half * along, stretch)
    for c in range(cables):
        dx, dy, dz = fill(0.0, axes, token), fill(0.0, axes, token), fill(0.0, axes, token)
        for k in range(2 * modes):
            weight = fill(tables.crossing[(layer * cables + c) * 2 * modes + k], axes, token)
            x, y, z = load3(work.local, 3 * k, token)
            dx, dy, dz = fma(weight, x, dx), fma(weight, y, dy), fma(weight, z, dz)
        length = square_root(fma(dx, dx, fma(dy, dy, dz * dz)))
        length = where_greater(length, least, length, least)
        reached = abs(tables.crossing[(layer * cables + c) * 2 * modes])  # one, or zero beyond the cable's end
        spring = fill(reached, axes, token) * load(work.tension, c, token) / (length * fill(rate * rate, axes, token))
        store(work.string, 2 * (layer * cables + c), spring, length / stretch)


@kernel
def _relative(tables, layer, c, k, lever, token):
    """p_k of a cable."""
    weight = fill(tables.crossing[(layer * tables.cables + c) * 2 * tables.modes + k], lever, token)
    if tables.parity[k % tables.modes] == 0:
        return fnma(lever, fill(tables.gradient[2 * tables.modes * layer + k], lever, token), weight)
    return weight


@kernel
def _sum_strings(tables, layer, work, token):
    """Sums over the cables of spring times p_k p_l, k >= l, of spring lever p_k and of spring lever^2 into ``web``."""
    size, cables = 2 * tables.modes, tables.cables
    mixed = size * (size + 1) // 2
    clear(work.web, 0, mixed + size + 1, token)
    for c in range(cables):
        spring = load(work.string, 2 * (layer * cables + c), token)
        lever = load(work.string, 2 * (layer * cables + c) + 1, token)
        for k in range(size):
            store(work.local, k, _relative(tables, layer, c, k, lever, token))
        entry = 0
        for k in range(size):
            pulled = spring * load(work.local, k, token)
            for n in range(k + 1):
                store(work.web, entry, fma(pulled, load(work.local, n, token), load(work.web, entry, token)))
                entry += 1
            store(work.web, mixed + k, fma(pulled, lever, load(work.web, mixed + k, token)))
        last = mixed + size
        store(work.web, last, fma(spring * lever, lever, load(work.web, last, token)))


@kernel
def _string_tile(tables, target, t, layer, k, n, work, token):
    """Add the part of modes k and n of a layer to the tile at ``t``."""
    modes, axes, a = tables.modes, work.axes, 9 * layer
    size, first = 2 * modes, 2 * modes * layer
    mixed = size * (size + 1) // 2
    high, low = max(k, n), min(k, n)
    straight = load(work.web, high * (high + 1) // 2 + low, token)
    row_kind, column_kind = tables.parity[k % modes], tables.parity[n % modes]
    row_slope, column_slope = tables.gradient[first + k], tables.gradient[first + n]
    tilted = fill(0.0, axes, token)
    if row_kind == column_kind and (row_kind == 1 or row_kind == 2):
        tilted = load(work.web, mixed + size, token) * fill(row_slope * column_slope, axes, token)
    into = load(work.web, mixed + k, token) * fill(column_slope, axes, token)
    out = load(work.web, mixed + n, token) * fill(row_slope, axes, token)
    for c in range(3):
        z = load(axes, a + 3 * c + 2, token)
        side = tilted * z
        if row_kind == 1 or row_kind == 2:
            side = fma(out, load(axes, a + 3 * c + row_kind - 1, token), side)
        for r in range(3):
            value = fma(load(axes, a + 3 * r + 2, token), side, load(target, t + 3 * c + r, token))
            if column_kind == 1 or column_kind == 2:
                value = fma(into * load(axes, a + 3 * r + column_kind - 1, token), z, value)
            store(target, t + 3 * c + r, value + straight if r == c else value)


@kernel
def add_strings(tables, layer, work, whole, token):
    """Add the strings of a layer to the matrix; ``whole`` as in ``layered_assembly``."""
    modes = tables.modes
    block = 9 * modes * modes
    upper = (layer + 1) * block
    _sum_strings(tables, layer, work, token)
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
    tilt_x, tilt_y = zero, zero
    for k in range(size):
        slope, z = fill(tables.gradient[first + k], zero, token), load(local, 3 * k + 2, token)
        if tables.parity[k % modes] == 1:
            tilt_x = fma(slope, z, tilt_x)
        elif tables.parity[k % modes] == 2:
            tilt_y = fma(slope, z, tilt_y)
    for c in range(cables):
        spring = load(work.string, 2 * (layer * cables + c), token)
        lever = load(work.string, 2 * (layer * cables + c) + 1, token)
        x, y, z = lever * tilt_x, lever * tilt_y, zero
        for k in range(size):
            weight = _relative(tables, layer, c, k, lever, token)
            dx, dy, dz = load3(local, 3 * k, token)
            x, y, z = fma(weight, dx, x), fma(weight, dy, y), fma(weight, dz, z)
        x, y, z = spring * scale * x, spring * scale * y, spring * scale * z
        for k in range(size):
            weight = _relative(tables, layer, c, k, lever, token)
            fx, fy, fz = load3(reaction, 3 * k, token)
            fx, fy, fz = fma(weight, x, fx), fma(weight, y, fy), fma(weight, z, fz)
            kind = tables.parity[k % modes]
            if kind == 1 or kind == 2:
                fz = fma(lever * fill(tables.gradient[first + k], zero, token), x if kind == 1 else y, fz)
            store(reaction, 3 * k, fx, fy, fz)
