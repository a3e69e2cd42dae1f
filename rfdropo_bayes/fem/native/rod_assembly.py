"""Elements of a rod in SIMD lanes: strains, forces and tangent; and the inertia of its stations.

The physics is that of ``fem.dynamics``. An element lies between the stations a and b. R is the rotation halfway from
one section to the other, q the vector part of the quaternion from a to b and q0 its scalar part. With the chord d, the
length h, u = R q, g = u / (1 + q0) and W = 1 - u g', the strains h Gamma = R' d - h e3 and h K = 2 q change as

    h R dGamma = dr_b - dr_a + S_a da_a + S_b da_b,    S = [d]x (1 +- [g]x) / 2 -+ e b',    h R dK = W (da_b - da_a)

An arc is longer than its chord: to h Gamma_3, along the axis e = R e3, belongs h^3 / 24 of the squared curvature, whose
part of S is b = h^2 W R (K_1, K_2, 0) / 12.

A time step and an iteration for equilibrium differ in a few factors only, held in ``factors``. ``tables``, ``samples``,
``factors`` and ``work`` are records of addresses; see `rod_records`. Stiffnesses are those over h, strains those times
h.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.chain_cholesky import BLOCK, PANEL
from rfdropo_bayes.fem.native.rod_effects import (
    BENDING,
    BRANCH,
    LOADED,
    add_branch,
    add_law_tangent,
    find_slopes,
    place_law_stress,
)
from rfdropo_bayes.fem.native.rod_records import BOW, CHORD, DIRECTOR, GRADIENT, RATE, SLOPE, STRAIN, STRESS, TILTED
from rfdropo_bayes.fem.native.rod_tables import FRAME, SECTION, SIZE
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, load3, store, where_greater
from rfdropo_bayes.fem.native.vectors import (
    add_to,
    added,
    combined,
    components,
    cross,
    dot,
    minus,
    plus,
    put,
    scaled,
)


@kernel
def _turn_between(turn, q, token):
    """Sum of the quaternions of two neighbours, with the nearer sign, the vector part of the turn from one to the
    other, and 1 / (1 + its scalar part)."""
    zero, one = fill(0.0, turn, token), fill(1.0, turn, token)
    a, b = load(turn, q, token), load(turn, q + 4, token)
    first, second = load3(turn, q + 1, token), load3(turn, q + 5, token)
    scalar = fma(a, b, dot(first, second))
    sign = where_greater(zero, scalar, -one, one)
    b, second = b * sign, scaled(second, sign)
    between = minus(minus(scaled(second, a), scaled(first, b)), cross(first, second))
    return a + b, plus(first, second), between, one / fma(scalar, sign, one)


@kernel
def measure_element(tables, element, work, token):
    """Directors in the middle of an element, these times W, chord, g and strains times length."""
    rows, one = work.element, fill(1.0, work.turn, token)
    w, (x, y, z), between, inverse = _turn_between(work.turn, 4 * element, token)
    s, xs, ys, zs = w * inverse, x * inverse, y * inverse, z * inverse
    put(rows, DIRECTOR, (fnma(ys, y, fnma(zs, z, one)), fma(xs, y, s * z), fnma(s, y, xs * z)))
    put(rows, DIRECTOR + 3, (fnma(s, z, xs * y), fnma(xs, x, fnma(zs, z, one)), fma(ys, z, s * x)))
    put(rows, DIRECTOR + 6, (fma(xs, z, s * y), fnma(s, x, ys * z), fnma(xs, x, fnma(ys, y, one))))
    gradient = combined(rows, DIRECTOR, scaled(between, inverse), token)
    for i in range(3):
        put(rows, TILTED + 3 * i, added(gradient, -between[i], load3(rows, DIRECTOR + 3 * i, token)))
    a = FRAME * element
    chord = minus(load3(work.frame, a + FRAME, token), load3(work.frame, a, token))
    put(rows, CHORD, chord)
    put(rows, GRADIENT, gradient)
    x, y, z = components(rows, DIRECTOR, chord, token)
    bend, length = plus(between, between), fill(tables.length[element], work.element, token)
    bow = scaled(load3(rows, TILTED, token), bend[0])
    put(rows, BOW, scaled(added(load3(rows, TILTED + 3, token), bend[1], bow), length * (1.0 / 12.0)))
    longer = fma(bend[0], bend[0], bend[1] * bend[1]) * (1.0 / 24.0) - 1.0
    put(rows, STRAIN, (x, y, fma(longer, length, z)))
    put(rows, STRAIN + 3, bend)


@kernel
def _measure_rates(element, work, token):
    """Rates of the strains, times length."""
    rows, a = work.element, SIZE * element
    b = a + SIZE
    first, second = load3(work.velocity, a + 3, token), load3(work.velocity, b + 3, token)
    chord, gradient, turning = load3(rows, CHORD, token), load3(rows, GRADIENT, token), minus(second, first)
    middle = minus(plus(first, second), cross(gradient, turning))
    half = fill(0.5, work.velocity, token)
    drift = minus(load3(work.velocity, b, token), load3(work.velocity, a, token))
    drift = added(cross(chord, middle), half, drift)
    x, y, z = components(rows, DIRECTOR, drift, token)
    put(rows, RATE, (x, y, z + dot(load3(rows, BOW, token), turning)))
    put(rows, RATE + 3, components(rows, TILTED, turning, token))


@kernel
def _add_forces(element, rows, field, token):
    """Add the forces and moments of the stresses in ``rows`` to the field of both stations."""
    a = SIZE * element
    b, half = a + SIZE, fill(0.5, field, token)
    force = combined(rows, DIRECTOR, load3(rows, STRESS, token), token)
    moment = combined(rows, TILTED, load3(rows, STRESS + 3, token), token)
    moment = added(load3(rows, BOW, token), load(rows, STRESS + 2, token), moment)
    push = scaled(cross(load3(rows, CHORD, token), force), half)
    moment = minus(moment, cross(load3(rows, GRADIENT, token), push))
    add_to(field, a, force, token)
    add_to(field, a + 3, plus(push, moment), token)
    put(field, b, minus(load3(field, b, token), force))
    add_to(field, b + 3, minus(push, moment), token)


@kernel
def _entry(i):
    """Row of ``SLOPE`` that stiffness i of a section without laws has."""
    return i if i < 3 else 5 if i == 3 else 7


@kernel
def add_element_force(tables, samples, factors, element, work, token):
    """Add the elastic and viscous force of an element that was measured to ``field``; its section's tangent is left in
    ``SLOPE``."""
    rows, section = work.element, SECTION * element
    force, rate = load(factors.strain, 0, token), load(factors.strain_rate, 0, token)
    _measure_rates(element, work, token)
    for i in range(SECTION):
        store(rows, SLOPE + _entry(i), load(samples.section, section + i, token))
    if samples.present[BENDING]:
        find_slopes(tables, samples, element, work, token)
    for i in range(SIZE):
        stiff = load(rows, SLOPE + _entry(0 if i < 2 else i - 1), token)
        strain = fma(force, load(rows, STRAIN + i, token), rate * load(rows, RATE + i, token))
        store(rows, STRESS + i, stiff * strain)
    if samples.present[BENDING]:
        place_law_stress(tables, samples, element, force, rate, work, token)
    if samples.present[BRANCH]:
        add_branch(samples, factors, element, work, token)
    _add_forces(element, rows, work.field, token)


@kernel
def _symmetric(a, scale):
    """scale * a a', its lower half by columns."""
    x, y, z = a[0] * scale, a[1] * scale, a[2] * scale
    return x * a[0], x * a[1], x * a[2], y * a[1], y * a[2], z * a[2]


@kernel
def _mixed(a, b):
    """a b' + b a', its lower half by columns."""
    two = a[0] * b[0], a[1] * b[1], a[2] * b[2]
    return (
        two[0] + two[0],
        fma(a[0], b[1], a[1] * b[0]),
        fma(a[0], b[2], a[2] * b[0]),
        two[1] + two[1],
        fma(a[1], b[2], a[2] * b[1]),
        two[2] + two[2],
    )


@kernel
def _sum(a, b):
    """Sum of two lower halves."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@kernel
def _difference(a, b):
    """Difference of two lower halves."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2], a[3] - b[3], a[4] - b[4], a[5] - b[5]


@kernel
def _times(a, scale):
    """A lower half times a scale."""
    return a[0] * scale, a[1] * scale, a[2] * scale, a[3] * scale, a[4] * scale, a[5] * scale


@kernel
def _put_lower(target, t, a, add, token):
    """Write (or add) the lower half of a tile."""
    if add:
        x, y, z = load3(target, t, token)
        u, v = load(target, t + 4, token), load(target, t + 5, token)
        w = load(target, t + 8, token)
        store(target, t, x + a[0], y + a[1], z + a[2])
        store(target, t + 4, u + a[3], v + a[4])
        store(target, t + 8, w + a[5])
    else:
        store(target, t, a[0], a[1], a[2])
        store(target, t + 4, a[3], a[4])
        store(target, t + 8, a[5])


@kernel
def _put_negative(target, t, a):
    """Write the symmetric tile -a, given its lower half."""
    store(target, t, -a[0], -a[1], -a[2], -a[1], -a[3], -a[4], -a[2], -a[4], -a[5])


@kernel
def _bending_tile(rows, elasticity, token):
    """W R D R' W / h times a factor, its lower half."""
    x, y, z = load3(rows, TILTED, token), load3(rows, TILTED + 3, token), load3(rows, TILTED + 6, token)
    tile = _symmetric(x, elasticity * load(rows, SLOPE + 2, token))
    tile = _sum(tile, _symmetric(y, elasticity * load(rows, SLOPE + 5, token)))
    tile = _sum(tile, _symmetric(z, elasticity * load(rows, SLOPE + 7, token)))
    return tile


@kernel
def _lever_tiles(upper, whole, soft, stiff, axis, parts, work, token):
    """Tiles of moments by displacements: S' c of both stations, column by column.

    Of a straight chord S' c = ``soft`` S' + ``stiff`` s t' with s = S' t, t the ``axis``; S and s are the sum and the
    difference of parts that are even and odd in g. Of an arc follows ``bow``, b times the stiffness along the axis.
    """
    rows, lower, half, (even, odd, bow) = work.element, upper - BLOCK, 0.5 * soft, parts
    g = load3(rows, GRADIENT, token)
    chord = scaled(load3(rows, CHORD, token), half)
    shift, zero = -dot(chord, g), fill(0.0, work.element, token)
    hats = (zero, -chord[2], chord[1]), (chord[2], zero, -chord[0]), (-chord[1], chord[0], zero)
    units = (shift, zero, zero), (zero, shift, zero), (zero, zero, shift)
    for c in range(3):
        along = stiff * axis[c]
        p, q = added(even, along, hats[c]), added(odd, along, added(chord, g[c], units[c]))
        q = added(bow, -axis[c], q)
        a, b = plus(p, q), minus(p, q)
        add_to(work.pivot, upper + PANEL + 3 * c, b, token)
        if whole:
            put(work.pivot, lower + PANEL + 3 * c, (-a[0], -a[1], -a[2]))
            put(work.coupling, upper + PANEL + 3 * c, a)
            for r in range(3):
                store(work.coupling, upper + 9 + 3 * r + c, -b[r])


@kernel
def _put_full(target, t, a, skew):
    """Write the tile of a lower half, plus [skew]x."""
    x, y, z = skew
    store(target, t, a[0], a[1] + z, a[2] - y, a[1] - z, a[3], a[4] + x, a[2] + y, a[4] - x, a[5])


@kernel
def _moment_tiles(upper, whole, soft, stiff, parts, bending, work, token):
    """Tiles of moments by rotations: S' c S of both stations and of the pair, and ``bending``; see `_lever_tiles`."""
    rows, quarter, diagonal, (even, odd, bow) = work.element, 0.25 * soft, upper + PANEL + 9, parts
    chord, g, one = load3(rows, CHORD, token), load3(rows, GRADIENT, token), fill(1.0, work.element, token)
    square, lean = dot(chord, chord), dot(chord, g)
    steep, bent, zero, half = dot(g, g), lean * lean, one - one, 0.5 * one
    own, both = _symmetric(chord, quarter), _mixed(chord, scaled(g, quarter * lean))
    first, second = _symmetric(even, stiff), _symmetric(odd, stiff)
    mixed = _mixed(even, scaled(odd, stiff))
    swing = _mixed(chord, scaled(cross(chord, g), quarter))
    mixed = _difference(_difference(mixed, swing), _mixed(bow, even))
    arc = _mixed(bow, added(load3(rows, BOW, token), half, scaled(odd, -one)))
    ball = quarter * (square + bent)
    same = _sum(_sum(_sum(first, second), bending), arc)
    same = _sum(_difference(same, both), _times(own, steep - one))
    same = _sum(same, (ball, zero, zero, ball, zero, ball))
    _put_lower(work.pivot, diagonal, _difference(same, mixed), True, token)
    if whole:
        _put_lower(work.pivot, diagonal - BLOCK, _sum(same, mixed), False, token)
        ball = quarter * (square - bent)
        pair = _difference(_difference(_difference(first, second), bending), arc)
        pair = _difference(_sum(pair, both), _times(own, steep + one))
        pair = _sum(pair, (ball, zero, zero, ball, zero, ball))
        skew = added(cross(odd, even), stiff, scaled(added(chord, lean, scaled(g, square)), quarter))
        _put_full(work.coupling, diagonal, pair, minus(cross(bow, even), skew))


@kernel
def add_element_tangent(factors, element, work, whole, token):
    """Add the tangent of an element to the pivot of its upper station; ``whole``: set the coupling, and start the pivot
    of the lower one."""
    rows, upper, elasticity = work.element, (element + 1) * BLOCK, load(factors.elasticity, 0, token)
    soft = elasticity * load(rows, SLOPE, token)
    stiff = fma(elasticity, load(rows, SLOPE + 1, token), -soft)
    axis, chord, g = load3(rows, DIRECTOR + 6, token), load3(rows, CHORD, token), load3(rows, GRADIENT, token)
    half, zero = fill(0.5, work.element, token), fill(0.0, work.element, token)
    tile = _sum(_symmetric(axis, stiff), (soft, zero, zero, soft, zero, soft))
    _put_lower(work.pivot, upper, tile, True, token)
    if whole:
        _put_lower(work.pivot, upper - BLOCK, tile, False, token)
        _put_negative(work.coupling, upper, tile)
    even = scaled(cross(axis, chord), half)
    odd = scaled(added(chord, dot(g, axis), scaled(axis, -dot(chord, g))), half)
    parts = even, odd, scaled(load3(rows, BOW, token), soft + stiff)
    _lever_tiles(upper, whole, soft, stiff, axis, parts, work, token)
    _moment_tiles(upper, whole, soft, stiff, parts, _bending_tile(rows, elasticity, token), work, token)


@kernel
def assemble_element(tables, samples, factors, element, work, whole, token):
    """Force of an element and its part of the matrix; see `add_element_tangent` for ``whole``."""
    measure_element(tables, element, work, token)
    add_element_force(tables, samples, factors, element, work, token)
    add_element_tangent(factors, element, work, whole, token)
    if samples.present[BENDING]:
        add_law_tangent(factors, element, work, whole, token)


@kernel
def _moment_of(tables, samples, station, a, work, token):
    """Inertia of a section times a spin or its change."""
    frame, density = FRAME * station + 3, load(samples.density, 0, token)
    x, y, z = components(work.frame, frame, a, token)
    m = 3 * station
    parts = x * tables.moment[m], y * tables.moment[m + 1], z * tables.moment[m + 2]
    return scaled(combined(work.frame, frame, parts, token), density)


@kernel
def station_mass(tables, samples, station, token):
    """Mass of a station."""
    return fma(load(samples.density, 0, token), tables.volume[station], load(samples.point_mass, station, token))


@kernel
def add_station_loads(tables, samples, factors, station, work, token):
    """Add weight, drag by mass, gyroscopic moment and forces on a section to ``field``."""
    row, force, drag = SIZE * station, load(factors.force, 0, token), load(factors.drag, 0, token)
    mass, spin = station_mass(tables, samples, station, token), load3(work.velocity, SIZE * station + 3, token)
    push = added(load3(samples.gravity, 0, token), force, scaled(load3(work.velocity, row, token), -drag))
    push = scaled(push, mass)
    if samples.present[LOADED]:
        push = added(load3(work.pushed, 3 * station, token), force, push)
    add_to(work.field, row, push, token)
    momentum = _moment_of(tables, samples, station, spin, work, token)
    moment = added(momentum, -drag, scaled(cross(spin, momentum), -force))
    add_to(work.field, row + 3, moment, token)


@kernel
def add_going(tables, samples, share, station, work, token):
    """Add to ``field`` a share of what the stage before did at a station, without the impacts in it."""
    row, mass = SIZE * station, station_mass(tables, samples, station, token)
    moment = _moment_of(tables, samples, station, load3(work.before, row + 3, token), work, token)
    push = minus(scaled(load3(work.before, row, token), mass), load3(work.sudden, row, token))
    add_to(work.field, row, scaled(push, share), token)
    add_to(work.field, row + 3, scaled(minus(moment, load3(work.sudden, row + 3, token)), share), token)


@kernel
def add_station_mass(tables, samples, factors, station, work, token):
    """Add the inertia of a station to its pivot."""
    t, inertia, frame = station * BLOCK, load(factors.inertia, 0, token), FRAME * station + 3
    mass = inertia * station_mass(tables, samples, station, token)
    for i in range(3):
        store(work.pivot, t + 4 * i, load(work.pivot, t + 4 * i, token) + mass)
    density = inertia * load(samples.density, 0, token)
    tile = _symmetric(load3(work.frame, frame, token), density * tables.moment[3 * station])
    for i in range(1, 3):
        director = load3(work.frame, frame + 3 * i, token)
        tile = _sum(tile, _symmetric(director, density * tables.moment[3 * station + i]))
    _put_lower(work.pivot, t + PANEL + 9, tile, True, token)
