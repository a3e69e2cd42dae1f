"""Effects of the body in SIMD lanes: laws of the section, Prony branch, softening, fluid, wall and stretching cables.

The physics follows ``fem.sections``, ``fem.surroundings`` and ``fem.dynamics``. Absent effects are skipped by flags
that are the same for all lanes; cables and softening cost little and are always computed.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.chain_cholesky import BLOCK
from rfdropo_bayes.fem.native.rod_records import FIRM, RATE, SLOPE, STRAIN, STRESS
from rfdropo_bayes.fem.native.rod_tables import FRAME, SECTION, SIZE
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, load3, square_root, store, where_greater
from rfdropo_bayes.fem.native.vectors import add_to, added, dot, minus, put, scaled
from rfdropo_bayes.fem.surroundings import STILL, WALL_SOFTNESS

BENDING, BRANCH, SURROUNDED, FRICTION = range(4)
"""Flags in ``samples.present``; the last is Coulomb's friction, followed by the capstan's."""
LOADED = FRICTION + 2
"""Flag of loads that change from step to step, see ``fem.section_loads``."""
FLAGS = LOADED + 1
(
    GAIN, SHARE, DECAY, LATER_DECAY, DRAG, WALL, DISTANCE, NORMAL_X, NORMAL_Y, GIVE, COULOMB, CAPSTAN, FIBRE,
) = range(13)  # fmt: skip
"""Rows of ``samples.effects``; gain and share belong to a stage, decay to the moduli in each stage."""
EFFECTS = FIBRE + 1
LAW = 6
"""Rows of ``samples.law`` for each element, added to its stiffness in bending and twist: 00, 01, 02, 11, 12, 22."""


@kernel
def find_slopes(tables, samples, element, work, token):
    """The section's tangent and its stiffness with the laws of its bending and of its fibres, into ``SLOPE`` and
    ``FIRM``."""
    rows, section, law = work.element, SECTION * element, LAW * element
    left = _fibres(tables, samples, element, work, token)[0]
    store(rows, SLOPE + 2, left * load(samples.section, section + 2, token))
    for i in range(LAW):
        firm = load(samples.law, law + i, token)
        if i == 0 or i == 3 or i == 5:
            firm = firm + load(samples.section, section + (3 if i == 0 else 4 if i == 3 else 5), token)
        store(rows, FIRM + i, firm)
        planar = i == 0 or i == 1 or i == 3
        store(rows, SLOPE + 3 + i, firm * left if planar else firm)


@kernel
def _fibres(tables, samples, element, work, token):
    """Tangent and secant of the law of fibres, and half the derivative of the tangent by the stretch of the element."""
    steep, one = load(samples.effects, FIBRE, token) * (1.5 / tables.length[element]), fill(1.0, work.element, token)
    h = steep * load(work.element, STRAIN + 2, token)
    square = fma(h, h, one)
    r = square_root(square)
    tangent = (r - h) * (r - h)
    secant = fma(h * (2.0 / 3.0), h - (square + r + one) / (r + one), one)
    return tangent, secant, -(steep * tangent) / r


@kernel
def _moments(rows, first, a, token):
    """Product of a symmetric matrix in six rows from ``first`` on and a vector."""
    m00, m01, m02 = load3(rows, first, token)
    m11, m12, m22 = load3(rows, first + 3, token)
    return dot((m00, m01, m02), a), dot((m01, m11, m12), a), dot((m02, m12, m22), a)


@kernel
def place_law_stress(tables, samples, element, force, rate, work, token):
    """Stresses of stretch, bending and twist by the laws of the section."""
    rows = work.element
    tangent, secant, change = _fibres(tables, samples, element, work, token)
    stretch, stiff = load(rows, STRAIN + 2, token), load(samples.section, SECTION * element + 2, token)
    bend, turning = load3(rows, STRAIN + 3, token), load3(rows, RATE + 3, token)
    moment, slow = _moments(rows, FIRM, bend, token), _moments(rows, SLOPE + 3, turning, token)
    cross = load(rows, FIRM + 2, token) * bend[2], load(rows, FIRM + 4, token) * bend[2]
    planar = moment[0] - cross[0], moment[1] - cross[1]
    pull = force * fma(stiff * stretch, secant, change * fma(planar[0], bend[0], planar[1] * bend[1]))
    store(rows, STRESS + 2, fma(rate * load(rows, SLOPE + 2, token), load(rows, RATE + 2, token), pull))
    softer = fill(1.0, rows, token) - tangent
    bent = fnma(softer, planar[0], moment[0]), fnma(softer, planar[1], moment[1]), moment[2]
    put(rows, STRESS + 3, added(bent, force, scaled(slow, rate)))


@kernel
def add_branch(samples, factors, element, work, token):
    """Add the stress of an element's Prony branch."""
    rows, section, b, gain = work.element, SECTION * element, SIZE * element, load(factors.branch, 0, token)
    for i in range(3):
        stiffness = gain * load(samples.section, section + i, token)
        strain = load(rows, STRAIN + i, token) - load(work.branch, b + i, token)
        store(rows, STRESS + i, fma(stiffness, strain, load(rows, STRESS + i, token)))
    bend = minus(load3(rows, STRAIN + 3, token), load3(work.branch, b + 3, token))
    if samples.present[BENDING]:
        moment = _moments(rows, FIRM, bend, token)
    else:
        x, y, z = load3(samples.section, section + 3, token)
        moment = x * bend[0], y * bend[1], z * bend[2]
    add_to(rows, STRESS + 3, scaled(moment, gain), token)


@kernel
def follow_branch(factors, element, work, token):
    """Let the dashpot of the Prony branch of an element that was measured follow the strain."""
    share = load(factors.share, 0, token)
    for i in range(SIZE):
        behind = load(work.branch, SIZE * element + i, token)
        strain = load(work.element, STRAIN + i, token)
        store(work.branch, SIZE * element + i, fma(share, strain - behind, behind))


@kernel
def add_surroundings(tables, samples, factors, station, predicted, work, token):
    """Add the wall and the fluid of a station to ``field`` and to its pivot.

    ``predicted``: the wall acts at the position itself, and the fluid with the derivative of the speed.
    """
    zero, row = fill(0.0, work.field, token), SIZE * station
    x, y, _ = load3(work.frame, FRAME * station, token)
    u, v, w = load3(work.velocity, row, token)
    nx, ny = load(samples.effects, NORMAL_X, token), load(samples.effects, NORMAL_Y, token)
    soft, step = fill(WALL_SOFTNESS, work.field, token), load(factors.force, 0, token)
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
    drag = step * load(samples.effects, DRAG, token) * tables.section_area[station] * speed
    steep = drag / (speed * speed) if predicted else zero
    add_to(work.field, row, (-fma(push, nx, drag * u), -fma(push, ny, drag * v), -(drag * w)), token)
    t = station * BLOCK
    first = fma(wall * nx, nx, drag), wall * nx * ny, zero
    add_to(work.pivot, t, added((u, v, w), steep * u, first), token)
    add_to(work.pivot, t + 3, added((u, v, w), steep * v, (first[1], fma(wall * ny, ny, drag), zero)), token)
    add_to(work.pivot, t + 6, added((u, v, w), steep * w, (zero, zero, drag)), token)
