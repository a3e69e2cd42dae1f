"""Effects of the body in SIMD lanes: bending law, Prony branch, softening, fluid, wall and stretching cables.

The physics is that of ``fem.bending_law``, ``fem.surroundings`` and ``fem.dynamics``. What a batch does not have is
skipped by flags that are the same for all lanes; cables and softening are a few operations a step, and always there.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, load3, square_root, store, where_greater
from rfdropo_bayes.fem.native.stiffening_kernels import add_dyad
from rfdropo_bayes.fem.surroundings import STILL, WALL_SOFTNESS

BENDING, BRANCH, SURROUNDED, FRICTION = range(4)
"""Flags in ``samples.present``; the last one is Coulomb's friction, that of the capstan follows it."""
LOADED = FRICTION + 2
"""Flag of what acts on the body from step to step, see ``fem.section_loads``."""
FLAGS = LOADED + 1
GAIN, SHARE, DECAY, LATER_DECAY, DRAG, WALL, DISTANCE, NORMAL_X, NORMAL_Y, GIVE, COULOMB, CAPSTAN = range(12)
"""Rows of ``samples.effects``; gain and share are those of a stage, decay that of the moduli in each stage."""
EFFECTS = CAPSTAN + 1
LAW = 9
"""Rows of ``samples.law`` for each layer: linear 00, 01, 02, 11, 12, 22, then EI / L about x and y, then cubic."""


@kernel
def _row_by(axes, frame, column, field, row, token):
    """Column ``column`` of a frame times the vector at ``row`` of a field."""
    value = load(axes, frame + column, token) * load(field, row, token)
    value = fma(load(axes, frame + 3 + column, token), load(field, row + 1, token), value)
    return fma(load(axes, frame + 6 + column, token), load(field, row + 2, token), value)


@kernel
def _rotations(tables, layer, axes, field, token):
    """Rotations of a layer's upper face relative to its lower one, in its frame: about x, about y, twist."""
    modes, across, frame, half = tables.modes, tables.across, 9 * layer, fill(0.5, axes, token)
    low, high = 3 * layer * modes, 3 * (layer + 1) * modes
    wide0 = fill(1.0 / tables.rest[low + 3], axes, token)
    wide1 = fill(1.0 / tables.rest[high + 3], axes, token)
    deep0 = fill(1.0 / tables.rest[low + 3 * across + 1], axes, token)
    deep1 = fill(1.0 / tables.rest[high + 3 * across + 1], axes, token)
    about_x = deep1 * _row_by(axes, frame, 2, field, high + 3 * across, token)
    about_x = fnma(deep0, _row_by(axes, frame, 2, field, low + 3 * across, token), about_x)
    about_y = wide0 * _row_by(axes, frame, 2, field, low + 3, token)
    about_y = fnma(wide1, _row_by(axes, frame, 2, field, high + 3, token), about_y)
    twist = wide1 * _row_by(axes, frame, 1, field, high + 3, token)
    twist = fnma(deep1, _row_by(axes, frame, 0, field, high + 3 * across, token), twist)
    twist = fnma(wide0, _row_by(axes, frame, 1, field, low + 3, token), twist)
    twist = fma(deep0, _row_by(axes, frame, 0, field, low + 3 * across, token), twist)
    return about_x, about_y, half * twist


@kernel
def _linear(matrix, t, x, y, z, token):
    """Product of a symmetric matrix in six rows from ``t`` on and a vector."""
    m01, m02, m12 = load(matrix, t + 1, token), load(matrix, t + 2, token), load(matrix, t + 4, token)
    first = fma(load(matrix, t, token), x, fma(m01, y, m02 * z))
    second = fma(m01, x, fma(load(matrix, t + 3, token), y, m12 * z))
    third = fma(m02, x, fma(m12, y, load(matrix, t + 5, token) * z))
    return first, second, third


@kernel
def _subtract_moments(tables, layer, axes, field, about_x, about_y, twist, token):
    """Subtract from a field the nodal forces that do the work of three moments on the rotations of a layer."""
    modes, across, frame = tables.modes, tables.across, 9 * layer
    half = fill(0.5, axes, token)
    for face in range(2):
        base = 3 * (layer + face) * modes
        sign = 2.0 * face - 1.0
        wide = fill(sign / tables.rest[base + 3], axes, token)
        deep = fill(sign / tables.rest[base + 3 * across + 1], axes, token)
        for i in range(3):
            x, y = load(axes, frame + 3 * i, token), load(axes, frame + 3 * i + 1, token)
            z, row, column = load(axes, frame + 3 * i + 2, token), base + 3 + i, base + 3 * across + i
            pull = wide * fnma(about_y, z, half * twist * y)
            store(field, row, load(field, row, token) - pull)
            pull = deep * fnma(half * twist, x, about_x * z)
            store(field, column, load(field, column, token) - pull)


@kernel
def add_bending_law(tables, samples, factors, layer, work, token):
    """Subtract the moments of the bending law from ``field``; keeps their derivatives in ``slope``."""
    law, s = LAW * layer, 6 * layer
    x, y, z = _rotations(tables, layer, work.axes, work.position, token)
    kx, ky = load(samples.law, law + 6, token), load(samples.law, law + 7, token)
    cubic = load(samples.law, law + 8, token)
    mx, my = kx * x, ky * y
    energy = cubic * fma(mx, x, my * y)
    two = 2.0 * cubic
    store(work.slope, s, load(samples.law, law, token) + fma(energy, kx, two * mx * mx))
    store(work.slope, s + 1, fma(two * mx, my, load(samples.law, law + 1, token)), load(samples.law, law + 2, token))
    store(work.slope, s + 3, load(samples.law, law + 3, token) + fma(energy, ky, two * my * my))
    store(work.slope, s + 4, load(samples.law, law + 4, token), load(samples.law, law + 5, token))
    force, rate = load(factors.strain, 0, token), load(factors.strain_rate, 0, token)
    ax, ay, az = _linear(samples.law, law, x, y, z, token)
    ax, ay = fma(energy, mx, ax), fma(energy, my, ay)
    vx, vy, vz = _rotations(tables, layer, work.axes, work.velocity, token)
    bx, by, bz = _linear(work.slope, s, vx, vy, vz, token)
    ax, ay, az = fma(force, ax, rate * bx), fma(force, ay, rate * by), fma(force, az, rate * bz)
    _subtract_moments(tables, layer, work.axes, work.field, ax, ay, az, token)


@kernel
def subtract_law_product(tables, layer, elasticity, change, field, work, token):
    """Subtract the law's part of the matrix times a change of velocity from a field."""
    x, y, z = _rotations(tables, layer, work.axes, change, token)
    x, y, z = _linear(work.slope, 6 * layer, x, y, z, token)
    _subtract_moments(tables, layer, work.axes, field, elasticity * x, elasticity * y, elasticity * z, token)


@kernel
def _law_tile(matrix, t, work, layer, x_row, x_column, scale, token):
    """Add the law's part of the tile of two linear modes, in x or not, times a scale."""
    axes, frame, s = work.axes, 9 * layer, 6 * layer
    # A face tilts by +z / h along y and by -z / h along x, and twists by y / 2 h along x and by -x / 2 h along y.
    row, column = (1 if x_row else 0), (1 if x_column else 0)
    tilt, spin = scale * load(work.slope, s + (3 if x_row else 0), token), 0.25 * scale * load(work.slope, s + 5, token)
    mixed_row = 0.5 * scale * load(work.slope, s + (4 if x_row else 2), token)
    mixed_column = 0.5 * scale * load(work.slope, s + (4 if x_column else 2), token)
    if row != column:
        tilt = -(scale * load(work.slope, s + 1, token))
        spin = -spin
    # Signs of a mode's tilt and twist are opposite: the mixed terms change theirs where the modes are equal.
    sign = 1.0 if row != column else -1.0
    add_dyad(matrix, t, tilt, axes, frame, 2, frame, 2, token)
    add_dyad(matrix, t, sign * mixed_row, axes, frame, 2, frame, column, token)
    add_dyad(matrix, t, sign * mixed_column, axes, frame, row, frame, 2, token)
    add_dyad(matrix, t, spin, axes, frame, row, frame, column, token)


@kernel
def _law_tiles(tables, matrix, t, layer, row_face, column_face, triangle, elasticity, work, token):
    """Add the law's part of the block of two faces, from ``t`` on."""
    modes, across = tables.modes, tables.across
    low, high = 3 * (layer + row_face) * modes, 3 * (layer + column_face) * modes
    sign = 1.0 if row_face == column_face else -1.0
    for i in range(2):
        for j in range(i + 1 if triangle else 2):
            row, column = (across if i else 1), (across if j else 1)
            a = tables.rest[low + (3 * across + 1 if i else 3)]
            b = tables.rest[high + (3 * across + 1 if j else 3)]
            tile = t + 9 * (row * modes + column)
            _law_tile(matrix, tile, work, layer, i == 0, j == 0, elasticity * (sign / (a * b)), token)


@kernel
def add_law_tangent(tables, factors, layer, work, whole, token):
    """Add the tangent of the bending law; ``whole`` as in ``layered_assembly``."""
    elasticity, block = load(factors.elasticity, 0, token), 9 * tables.modes * tables.modes
    upper = (layer + 1) * block
    _law_tiles(tables, work.pivot, upper, layer, 1, 1, True, elasticity, work, token)
    if whole:
        _law_tiles(tables, work.pivot, upper - block, layer, 0, 0, True, elasticity, work, token)
        _law_tiles(tables, work.coupling, upper, layer, 0, 1, False, elasticity, work, token)


@kernel
def add_surroundings(tables, samples, factors, station, predicted, work, token):
    """Add the wall and the fluid of a station to ``field`` and to its pivot; keeps their part of the matrix.

    ``predicted``: the wall is met where the position is, and the fluid with the derivative of the speed.
    """
    zero, row = fill(0.0, work.field, token), 3 * station * tables.modes
    x, y = load(work.position, row, token), load(work.position, row + 1, token)
    u, v, w = load3(work.velocity, row, token)
    nx, ny = load(samples.effects, NORMAL_X, token), load(samples.effects, NORMAL_Y, token)
    soft, step = fill(WALL_SOFTNESS, zero, token), load(factors.force, 0, token)
    depth = fma(nx, x, ny * y) - load(samples.effects, DISTANCE, token)
    into = where_greater(depth, -soft, depth + soft, zero)
    into = where_greater(into, 2.0 * soft, 2.0 * soft, into)
    beyond = where_greater(depth, soft, depth - soft, zero)
    stiffness = load(samples.effects, WALL, token) * tables.section_length[station]
    slope = into * (0.5 / WALL_SOFTNESS)
    wall = step * step * stiffness * slope
    push = step * stiffness * fma(0.5 * slope, into, beyond)
    if not predicted:
        push = push + wall * fma(nx, u, ny * v)
    speed = square_root(fma(u, u, fma(v, v, w * w)) + STILL * STILL)
    drag = load(factors.fluid, 0, token) * load(samples.effects, DRAG, token) * tables.section_area[station] * speed
    store(work.around, 3 * station, wall, drag)
    store(work.field, row, fnma(push, nx, fnma(drag, u, load(work.field, row, token))))
    store(work.field, row + 1, fnma(push, ny, fnma(drag, v, load(work.field, row + 1, token))))
    store(work.field, row + 2, fnma(drag, w, load(work.field, row + 2, token)))
    t = 9 * station * tables.modes * tables.modes
    store(work.pivot, t, fma(wall * nx, nx, load(work.pivot, t, token)) + drag)
    store(work.pivot, t + 1, fma(wall * nx, ny, load(work.pivot, t + 1, token)))
    store(work.pivot, t + 3, fma(wall * nx, ny, load(work.pivot, t + 3, token)))
    store(work.pivot, t + 4, fma(wall * ny, ny, load(work.pivot, t + 4, token)) + drag)
    store(work.pivot, t + 8, load(work.pivot, t + 8, token) + drag)
    if predicted:
        steep = drag / (speed * speed)
        store(work.around, 3 * station + 2, steep)
        for c in range(3):
            along = steep * load(work.velocity, row + c, token)
            for r in range(3):
                k = t + 3 * c + r
                store(work.pivot, k, fma(along, load(work.velocity, row + r, token), load(work.pivot, k, token)))
    else:
        store(work.around, 3 * station + 2, zero)


@kernel
def subtract_surroundings_product(tables, samples, change, field, work, token):
    """Subtract the surroundings' part of the matrix times a change of velocity from a field."""
    nx, ny = load(samples.effects, NORMAL_X, token), load(samples.effects, NORMAL_Y, token)
    for station in range(tables.stations):
        row = 3 * station * tables.modes
        wall, drag, steep = load3(work.around, 3 * station, token)
        x, y, z = load3(change, row, token)
        push = wall * fma(nx, x, ny * y)
        u, v, w = load3(work.velocity, row, token)
        along = steep * fma(u, x, fma(v, y, w * z))
        a, b, c = load3(field, row, token)
        store(field, row, fnma(along, u, fnma(push, nx, fnma(drag, x, a))))
        store(field, row + 1, fnma(along, v, fnma(push, ny, fnma(drag, y, b))))
        store(field, row + 2, fnma(along, w, fnma(drag, z, c)))
