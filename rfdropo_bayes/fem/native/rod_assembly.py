"""Elements of a rod in SIMD lanes: strains, forces and tangent; and the inertia of its stations.

The physics follows ``fem.dynamics``. An element lies between the stations a and b. R is the rotation halfway from one
section to the other, q the vector part of the quaternion from a to b and q0 its scalar part. With the chord d, the
length h, u = R q, g = u / (1 + q0) and W = 1 - u g', the strains h Gamma = R' d - h e3 and h K = 2 q change as

    h R dGamma = dr_b - dr_a + S_a da_a + S_b da_b,    S = [d]x (1 +- [g]x) / 2 -+ e b',    h R dK = W (da_b - da_a)

An arc is longer than its chord: to h Gamma_3, along the axis e = R e3, belongs h^3 / 24 of the squared curvature, whose
part of S is b = h^2 W R (K_1, K_2, 0) / 12.

A time step and an iteration for equilibrium differ in a few factors only, held in ``factors``. ``tables``, ``samples``,
``factors`` and ``work`` are records of addresses; see `rod_records`. Stiffnesses are divided by h, strains multiplied
by h.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.chain_cholesky import BLOCK, PANEL
from rfdropo_bayes.fem.native.rod_effects import BENDING, BRANCH, LOADED, add_branch, find_slopes, place_law_stress
from rfdropo_bayes.fem.native.rod_records import (
    ALONG,
    BOW,
    CHORD,
    DIRECTOR,
    GRADIENT,
    HELD,
    LEAN,
    NET,
    RATE,
    SLOPE,
    STRAIN,
    STRESS,
    TILTED,
)
from rfdropo_bayes.fem.native.rod_tables import FRAME, INNER, SECTION, SIZE
from rfdropo_bayes.fem.native.simd import (
    any_greater,
    fill,
    fma,
    fnma,
    inlined,
    kernel,
    load,
    load3,
    store,
    where_greater,
)
from rfdropo_bayes.fem.native.vectors import add_to, added, combined, components, cross, dot, minus, plus, put, scaled


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
def measure_element(tables, samples, element, work, token):
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
    inner, along = INNER * element, z - length
    curl, arc = load(samples.inner, inner, token), fma(bend[0], bend[0], bend[1] * bend[1]) * (1.0 / 24.0)
    stretch = along / length
    square = 4.0 * stretch * stretch
    less = one / (square + one)
    bounded, rise = along * less, (one - square) * less * less
    wide = fma(curl, bounded, length)
    bow = added(load3(rows, TILTED + 3, token), bend[1], bow)
    longer, steep = fma(arc, wide, along), fma(curl * rise, arc, one)
    for i in range(2):
        strain, more = (x, y)[i], load(samples.inner, inner + 3 + i, token)
        lean = fma(more, bounded, load(samples.inner, inner + 1 + i, token)) * strain
        store(rows, LEAN + i, lean + lean)
        longer, steep = fma(lean, strain, longer), fma(rise * more * strain, strain, steep)
    store(rows, LEAN + 2, steep)
    put(rows, BOW, scaled(bow, wide * (1.0 / 12.0) / steep))
    put(rows, STRAIN, (x, y, longer))
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
    z = z + dot(load3(rows, BOW, token), turning)
    put(rows, RATE, (x, y, dot(load3(rows, LEAN, token), (x, y, z))))
    store(rows, ALONG, z)
    put(rows, RATE + 3, components(rows, TILTED, turning, token))


@kernel
def add_forces(element, rows, field, token):
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
    return i if i < 4 else 6 if i == 4 else 8


@kernel
def place_stress(tables, samples, factors, element, work, token):
    """Stresses of an element that was measured, elastic, viscous and of chambers; its section's tangent is left in
    ``SLOPE``."""
    rows, section = work.element, SECTION * element
    force, rate = load(factors.strain, 0, token), load(factors.strain_rate, 0, token)
    _measure_rates(element, work, token)
    for i in range(SECTION):
        store(rows, SLOPE + _entry(i), load(samples.section, section + i, token))
    if samples.present[BENDING]:
        find_slopes(tables, samples, element, work, token)
    for i in range(SIZE):
        stiff = load(rows, SLOPE + _entry(i), token)
        strain = fma(force, load(rows, STRAIN + i, token), rate * load(rows, RATE + i, token))
        store(rows, STRESS + i, stiff * strain)
    if samples.present[BENDING]:
        place_law_stress(tables, samples, element, force, rate, work, token)
    if samples.present[BRANCH]:
        add_branch(samples, factors, element, work, token)
    for c in range(tables.chambers):
        t, pressure = 3 * (c * (tables.stations - 1) + element), load(work.commanded, tables.cables + c, token)
        pressure = pressure * load(factors.force, 0, token)
        for i in range(3):
            row = STRESS + 2 + i
            store(rows, row, fnma(pressure, fill(tables.blown[t + i], rows, token), load(rows, row, token)))
    pull = load(rows, STRESS + 2, token)
    store(rows, STRESS + 2, pull - pull)
    put(rows, STRESS, added(load3(rows, LEAN, token), pull, load3(rows, STRESS, token)))


@inlined
def _symmetric(a, scale):
    """scale * a a', its lower half by columns."""
    x, y, z = a[0] * scale, a[1] * scale, a[2] * scale
    return x * a[0], x * a[1], x * a[2], y * a[1], y * a[2], z * a[2]


@inlined
def _both(a, b):
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


@inlined
def _sum(a, b):
    """Sum of two lower halves."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@inlined
def _load_lower(rows, first, token):
    """A lower half in six rows."""
    return load3(rows, first, token) + load3(rows, first + 3, token)


@inlined
def _columns(a):
    """Columns of a symmetric matrix, given its lower half."""
    return (a[0], a[1], a[2]), (a[1], a[3], a[4]), (a[2], a[4], a[5])


@inlined
def _lower(a):
    """Lower half of a matrix of columns."""
    return a[0][0], a[0][1], a[0][2], a[1][1], a[1][2], a[2][2]


@inlined
def _less_dyad(matrix, a, b):
    """A matrix of columns, less a b'."""
    return added(a, -b[0], matrix[0]), added(a, -b[1], matrix[1]), added(a, -b[2], matrix[2])


@inlined
def _applied(matrix, a):
    """A matrix of columns times a vector."""
    return added(matrix[2], a[2], added(matrix[1], a[1], scaled(matrix[0], a[0])))


@inlined
def _back(matrix, a):
    """The transpose of a matrix of columns times a vector."""
    return dot(matrix[0], a), dot(matrix[1], a), dot(matrix[2], a)


@inlined
def _product(a, b):
    """Product of two matrices of columns."""
    return _applied(a, b[0]), _applied(a, b[1]), _applied(a, b[2])


@inlined
def _back_product(a, b):
    """The transpose of a matrix of columns times another."""
    return _back(a, b[0]), _back(a, b[1]), _back(a, b[2])


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
def _put_tile(target, t, a):
    """Write a matrix of columns."""
    for c in range(3):
        put(target, t + 3 * c, a[c])


@inlined
def _negative(a):
    """Minus a matrix of columns."""
    return scaled(a[0], -1.0), scaled(a[1], -1.0), scaled(a[2], -1.0)


@inlined
def _plus(a, b):
    """Sum of two matrices of columns."""
    return plus(a[0], b[0]), plus(a[1], b[1]), plus(a[2], b[2])


@inlined
def _minus(a, b):
    """Difference of two matrices of columns."""
    return minus(a[0], b[0]), minus(a[1], b[1]), minus(a[2], b[2])


@inlined
def _across(a):
    """Transpose of a matrix of columns."""
    return (a[0][0], a[1][0], a[2][0]), (a[0][1], a[1][1], a[2][1]), (a[0][2], a[1][2], a[2][2])


@kernel
def _measure_held(tables, factors, element, work, token):
    """How taut cables hold an element, times the factor in the matrix; see `cables.held`. Returns whether any does."""
    rows, zero, taut_any = work.element, fill(0.0, work.element, token), False
    net = net_moment = zero, zero, zero
    force = moment = zero, zero, zero, zero, zero, zero
    one, two, three = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
    for k in range(tables.beside_first[element], tables.beside_first[element + 1]):
        taut = load(work.tension, tables.beside_cable[k], token) * load(factors.held, 0, token)
        if any_greater(taut, zero):
            taut_any, g, along = True, tables.beside_guide[k], tables.beside_along[k]
            taut = taut * tables.beside_share[k]
            arm = scaled(load3(work.offset, 3 * tables.beside_start[k], token), fill(1.0 - along, rows, token))
            arm = added(load3(work.offset, 3 * g, token), fill(along, rows, token), arm)
            a, b = taut * load(work.inverse, g, token), taut * load(work.sharp, g, token)
            way = load3(work.direction, 3 * g, token)
            turn, (x, y, z), ball = cross(way, arm), scaled(arm, a), a * dot(arm, arm)
            force = _sum(_sum(force, _symmetric(way, -b)), (a, zero, zero, a, zero, a))
            moment = _sum(_sum(moment, _symmetric(turn, -b)), _symmetric(arm, -a))
            moment = _sum(moment, (ball, zero, zero, ball, zero, ball))
            pull = scaled(way, load(work.tension, tables.beside_cable[k], token) * tables.beside_part[k])
            net, net_moment, way = plus(net, pull), plus(net_moment, cross(arm, pull)), scaled(way, b)
            one = added(way, turn[0], plus(one, (zero, -z, y)))
            two = added(way, turn[1], plus(two, (z, zero, -x)))
            three = added(way, turn[2], plus(three, (-y, x, zero)))
    for i in range(6):
        store(rows, HELD + i, force[i])
        store(rows, HELD + 15 + i, moment[i])
    _put_tile(rows, HELD + 6, (one, two, three))
    put(rows, NET, net)
    put(rows, NET + 3, net_moment)
    return taut_any


@kernel
def _mixed(rows, token):
    """Columns of the force of cables that hold an element by its bending and twist."""
    return load3(rows, HELD + 6, token), load3(rows, HELD + 9, token), load3(rows, HELD + 12, token)


@kernel
def _hold_rates(rows, token):
    """Add to the stresses the resistance of cables to the strain rates of an element."""
    x, y, _ = load3(rows, RATE, token)
    stretching = combined(rows, DIRECTOR, (x, y, load(rows, ALONG, token)), token)
    bending = combined(rows, DIRECTOR, load3(rows, RATE + 3, token), token)
    mixed = _mixed(rows, token)
    force = plus(_applied(_columns(_load_lower(rows, HELD, token)), stretching), _applied(mixed, bending))
    moment = plus(_back(mixed, stretching), _applied(_columns(_load_lower(rows, HELD + 15, token)), bending))
    add_to(rows, STRESS, components(rows, DIRECTOR, force, token), token)
    add_to(rows, STRESS + 3, components(rows, DIRECTOR, moment, token), token)


@kernel
def _levers(rows, token):
    """S of both stations, as columns."""
    d, g, half = load3(rows, CHORD, token), load3(rows, GRADIENT, token), fill(0.5, rows, token)
    x, y, z = scaled(d, half)
    zero, e, b = half - half, load3(rows, DIRECTOR + 6, token), load3(rows, BOW, token)
    ball, lean = -dot((x, y, z), g), scaled(g, half)
    fold = (ball, zero, zero), (zero, ball, zero), (zero, zero, ball)
    fold = added(lean, d[0], fold[0]), added(lean, d[1], fold[1]), added(lean, d[2], fold[2])
    fold, turn = _less_dyad(fold, e, b), ((zero, z, -y), (-z, zero, x), (y, -x, zero))
    first = plus(turn[0], fold[0]), plus(turn[1], fold[1]), plus(turn[2], fold[2])
    second = minus(turn[0], fold[0]), minus(turn[1], fold[1]), minus(turn[2], fold[2])
    return first, second


@kernel
def _section_force(samples, element, rows, elasticity, turning, token):
    """Lower half of the force by stretch and shear, in space; ``turning``: the axial force that turns, or zero."""
    axis = combined(rows, DIRECTOR, load3(rows, LEAN, token), token)
    force = _symmetric(axis, elasticity * load(rows, SLOPE + 2, token))
    for i in range(2):
        lean = turning * load(samples.inner, INNER * element + 1 + i, token)
        soft = fma(elasticity, load(rows, SLOPE + i, token), lean + lean)
        force = _sum(force, _symmetric(load3(rows, DIRECTOR + 3 * i, token), soft))
    return force


@kernel
def _section_moment(rows, elasticity, bow, lawful, token):
    """Lower half of the moment by bending and twist in space, between W and W; ``bow``: added stiffness of bending."""
    x, y, z = load3(rows, TILTED, token), load3(rows, TILTED + 3, token), load3(rows, TILTED + 6, token)
    moment = _symmetric(x, fma(elasticity, load(rows, SLOPE + 3, token), bow))
    moment = _sum(moment, _symmetric(y, fma(elasticity, load(rows, SLOPE + 6, token), bow)))
    moment = _sum(moment, _symmetric(z, elasticity * load(rows, SLOPE + 8, token)))
    if lawful:
        moment = _sum(moment, _both(x, scaled(y, elasticity * load(rows, SLOPE + 4, token))))
        moment = _sum(moment, _both(x, scaled(z, elasticity * load(rows, SLOPE + 5, token))))
        moment = _sum(moment, _both(y, scaled(z, elasticity * load(rows, SLOPE + 7, token))))
    return moment


@kernel
def _less_turn(rows, matrix, token):
    """A matrix of columns times W."""
    g, one = load3(rows, GRADIENT, token), fill(1.0, rows, token)
    return _less_dyad(matrix, _applied(matrix, scaled(g, (one + one) / (one + dot(g, g)))), g)


@kernel
def _turning(rows, token):
    """Geometric terms of a section and its cables, in leading order: force by rotation of the middle, moment by
    rotation of the middle (lower half), and moment by the rotations of both sections.
    """
    force = plus(load3(rows, NET, token), combined(rows, DIRECTOR, load3(rows, STRESS, token), token))
    moment = plus(load3(rows, NET + 3, token), combined(rows, DIRECTOR, load3(rows, STRESS + 3, token), token))
    half = fill(0.5, rows, token)
    force, moment, chord, zero = scaled(force, half), scaled(moment, half), load3(rows, CHORD, token), half - half
    ball = -0.5 * dot(force, chord)
    swing = _sum(_both(force, scaled(chord, 0.25)), (ball, zero, zero, ball, zero, ball))
    return _skew(force), _columns(swing), _skew(moment)


@inlined
def _skew(a):
    """[a]x, its columns."""
    zero = a[0] - a[0]
    return (zero, a[2], -a[1]), (-a[2], zero, a[0]), (a[1], -a[0], zero)


@kernel
def add_element_tangent(tables, samples, factors, element, work, whole, held, lawful, still, token):
    """Add the tangent of an element to the pivot of its upper station; ``whole``: set the coupling, and start the pivot
    of the lower one; ``held`` by cables; ``lawful``: with a bending law; ``still``: of an equilibrium."""
    rows, upper, elasticity = work.element, (element + 1) * BLOCK, load(factors.elasticity, 0, token)
    lower, tile, (first, second) = upper - BLOCK, upper + PANEL, _levers(rows, token)
    axial = load(rows, STRESS + 2, token) if still else elasticity - elasticity
    force = _section_force(samples, element, rows, elasticity, axial, token)
    bow = axial * (tables.length[element] / 12.0)
    bent = _columns(_section_moment(rows, elasticity, bow, lawful, token))
    if held:
        force = _sum(force, _load_lower(rows, HELD, token))
        moment = _less_turn(rows, _columns(_load_lower(rows, HELD + 15, token)), token)
        bent = _plus(bent, _less_turn(rows, _across(moment), token))
    stiff = _columns(force)
    a, b, turned, across = _product(stiff, first), _product(stiff, second), bent, _negative(bent)
    if held:
        mixed = _less_turn(rows, _mixed(rows, token), token)
        a, b, back = _minus(a, mixed), _plus(b, mixed), _back_product(mixed, second)
        turned, across = _plus(bent, back), _minus(across, back)
        bent = _minus(bent, _back_product(mixed, first))
    turned, bent = _plus(_back_product(second, b), turned), _plus(_back_product(first, a), bent)
    across = _plus(_back_product(first, b), across)
    if still:
        tilt, swing, roll = _turning(rows, token)
        a, b, turned, bent = _minus(a, tilt), _minus(b, tilt), _plus(turned, swing), _plus(bent, swing)
        across = _plus(_plus(across, swing), roll)
    _put_lower(work.pivot, upper, force, True, token)
    back = _across(b)
    for c in range(3):
        add_to(work.pivot, tile + 3 * c, back[c], token)
    _put_lower(work.pivot, tile + 9, _lower(turned), True, token)
    if whole:
        back = _across(a)
        _put_lower(work.pivot, lower, force, False, token)
        _put_tile(work.pivot, lower + PANEL, _negative(back))
        _put_lower(work.pivot, lower + PANEL + 9, _lower(bent), False, token)
        _put_tile(work.coupling, upper, _negative(stiff))
        _put_tile(work.coupling, upper + 9, _negative(b))
        _put_tile(work.coupling, tile, back)
        _put_tile(work.coupling, tile + 9, across)


@kernel
def assemble_element(tables, samples, factors, element, work, whole, predicted, still, token):
    """Force of an element and its part of the matrix; see `add_element_tangent` for ``whole``."""
    measure_element(tables, samples, element, work, token)
    held = _measure_held(tables, factors, element, work, token)
    place_stress(tables, samples, factors, element, work, token)
    if held and not predicted and not still:
        _hold_rates(work.element, token)
    add_forces(element, work.element, work.field, token)
    if still:
        for i in range(SIZE):
            store(work.element, STRESS + i, load(work.stress, SIZE * element + i, token))
    add_element_tangent(tables, samples, factors, element, work, whole, held, samples.present[BENDING], still, token)


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
    """Add to ``field`` a share of the previous stage's change at a station, without impacts."""
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
