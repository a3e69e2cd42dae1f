"""Static equilibrium of a rod in SIMD lanes: where a rollout starts, and every row of a quasi-static motion.

Newton's method, with all that turns with the sections in leading order. A lane at rest is not moved again, so its
result does not depend on other lanes.
"""

from __future__ import annotations

from rfdropo_bayes.fem.equilibrium import (
    CALM,
    EASED,
    FARTHEST,
    FIRMER,
    HOPELESS,
    LEAST,
    LONGEST_STEP,
    NEAR,
    SHORTEST,
    SLOWER,
    STEADY,
    WIDEST_TURN,
)
from rfdropo_bayes.fem.integrators import EULER
from rfdropo_bayes.fem.native.chain_cholesky import PANEL
from rfdropo_bayes.fem.native.fields import clear
from rfdropo_bayes.fem.native.rod_assembly import (
    STRESS,
    add_forces,
    add_station_loads,
    measure_element,
    place_stress,
    station_mass,
)
from rfdropo_bayes.fem.native.rod_constraints import hold
from rfdropo_bayes.fem.native.rod_effects import GIVE, SURROUNDED, add_surroundings
from rfdropo_bayes.fem.native.rod_step import condense_increment, gather_cables, move_stations, near, place_directors
from rfdropo_bayes.fem.native.rod_tables import FRAME, SECTION, SIZE
from rfdropo_bayes.fem.native.simd import any_greater, fill, fma, fnma, kernel, load, magnitude, store, where_greater
from rfdropo_bayes.fem.native.slip_rows import end_row, keep_row, slide, start_row, sum_losses

UNBOUNDED = 1e30
"""Relative force out of balance of a lane whose equilibrium was lost."""
TINY = 1e-30


@kernel
def _product(tables, a, b, token):
    """Product of two changes of all stations; turns count by the length of the body."""
    total, square = fill(0.0, a, token), tables.total * tables.total
    for station in range(tables.held, tables.stations):
        for i in range(SIZE):
            row = SIZE * station + i
            product = load(a, row, token) * load(b, row, token)
            total = total + (product if i < 3 else product * square)
    return total


@kernel
def _largest(tables, first, field, token):
    """Largest displacement, or turn with ``first`` = 3, of any station along an axis."""
    zero = fill(0.0, field, token)
    largest = zero
    for station in range(tables.held, tables.stations):
        for i in range(first, first + 3):
            value = magnitude(load(field, SIZE * station + i, token), zero)
            largest = where_greater(value, largest, value, largest)
    return largest


@kernel
def _pace(tables, work, token):
    """Share of ``solution`` to go by Aitken's rule; see `equilibrium`."""
    zero, one, tiny = fill(0.0, work.frame, token), fill(1.0, work.frame, token), fill(TINY, work.frame, token)
    least, most = fill(SHORTEST, work.frame, token), fill(FARTHEST, work.frame, token)
    square = _product(tables, work.before, work.before, token)
    along = _product(tables, work.before, work.solution, token)
    own = _product(tables, work.solution, work.solution, token)
    change = square - along - along + own
    share = load(work.pace, 0, token) * (square - along) / where_greater(change, tiny, change, tiny)
    share = where_greater(share, least, where_greater(share, most, most, share), least)
    away = where_greater(along * along, (STEADY * STEADY) * square * own, one, zero)
    return where_greater(where_greater(along, square, away, zero), zero, most, share)


@kernel
def _choose_way(tables, work, moving, token):
    """Share of ``solution`` to go, limited in length, and less if increments do not shrink, or by `_pace` near the end;
    and what the increments after it may add up to.

    Far from rest the mass in the matrix gets less.

    All that are left are no more than a geometric series that goes on as the last two did: Newton's method converges
    faster.
    """
    zero, one, tiny = fill(0.0, work.frame, token), fill(1.0, work.frame, token), fill(TINY, work.frame, token)
    far, wide = _largest(tables, 0, work.solution, token), _largest(tables, 3, work.solution, token)
    turn, before = wide * tables.total, load(work.largest, 0, token)
    size = where_greater(far, turn, far, turn)
    grown = where_greater(size, before, one, zero)
    limit = fill(LONGEST_STEP * tables.total, work.frame, token) / where_greater(far, tiny, far, tiny)
    widest = fill(WIDEST_TURN, work.frame, token) / where_greater(wide, tiny, wide, tiny)
    limit = where_greater(limit, widest, widest, limit)
    share = where_greater(limit, one, one, limit)
    share = where_greater(grown, zero, SLOWER * share, share)
    pace = _pace(tables, work, token)
    paced = where_greater(fill(NEAR * tables.total, work.frame, token), size, load(work.pace, 0, token), zero)
    share = where_greater(paced, zero, where_greater(pace, limit, limit, pace), share)
    store(work.largest, 0, where_greater(moving, zero, size, before))
    shift, calm = load(work.shift, 0, token), fill(CALM * tables.total, work.frame, token)
    eased = where_greater(size, calm, moving, zero)
    store(work.shift, 0, where_greater(eased, zero, EASED * shift, shift))
    kept = where_greater(eased * shift, zero, zero, share)
    store(work.pace, 0, where_greater(moving, zero, kept, zero))
    alone = where_greater(before, fill(0.5 * UNBOUNDED, work.frame, token), one, grown)
    left = where_greater(alone, zero, size, size * (size / (before - size)))
    return share, where_greater(share, one, share * size, left)


@kernel
def _follow_stress(tables, samples, factors, work, share, token):
    """Let the stresses that turn in the matrix go a share of their way to those of the increment in ``velocity``,
    without its second order: in a thin rod that order of a rotation is a large force along the axis. Moments turn only
    on a body with cables, see `equilibrium`.

    As in Newton's method with independent stresses (Magisano, Leonetti and Garcea 2017, "How to improve efficiency and
    robustness of the Newton method in geometrically non-linear structural problem discretized via displacement-based
    finite elements").
    """
    zero = fill(0.0, work.stress, token)
    for element in range(tables.stations - 1):
        measure_element(tables, samples, element, work, token)
        place_stress(tables, samples, factors, element, work, token)
        for i in range(SIZE if tables.cables > 0 else 3):
            row, there = SIZE * element + i, load(work.element, STRESS + i, token)
            before = load(work.stress, row, token)
            store(work.stress, row, where_greater(share, zero, fma(share, there - before, before), before))


@kernel
def _take_tensions(tables, work, moving, token):
    """Tensions [N] from the impulses in ``weight``, in the lanes that move."""
    zero = fill(0.0, work.tension, token)
    for c in range(tables.cables):
        tension = -load(work.weight, tables.row[c], token)
        store(work.tension, c, where_greater(moving, zero, tension, load(work.tension, c, token)))


@kernel
def _found(tables, work, moving, token):
    """The lanes that move whose matrix had a solution, and those that try again with more mass in the matrix."""
    zero, bound = fill(0.0, work.frame, token), fill(UNBOUNDED, work.frame, token)
    total, least = _product(tables, work.solution, work.solution, token), load(work.least, 0, token)
    shift = load(work.shift, 0, token)
    found = where_greater(HOPELESS * least, shift, where_greater(bound, total, moving, zero), moving)
    more = where_greater(FIRMER * shift, least, FIRMER * shift, least)
    store(work.shift, 0, where_greater(moving - found, zero, more, shift))
    store(work.pace, 0, where_greater(found, zero, load(work.pace, 0, token), zero))
    return found, moving - found


@kernel
def _iterate(tables, runs, samples, factors, work, friction, rows, p, slips, bound, schedule, token):
    """One iteration of the moving lanes; lanes with a small increment stop."""
    zero, one, moving = fill(0.0, work.frame, token), fill(1.0, work.frame, token), load(work.moving, 0, token)
    unsolved = load(work.unsolved, 0, token)
    store(factors.inertia, 0, load(work.shift, 0, token))
    condense_increment(tables, samples, factors, work, EULER, True, token)
    if runs is not None and slips > 0:
        slide(tables, runs, friction, slips, work, token)
    hold(
        tables, runs, None, samples, factors, work, friction, None, rows, p, slips, 0, 1.0, schedule, token
    )  # fmt: skip
    store(work.solves, 0, load(work.solves, 0, token) + moving)
    moving, waiting = _found(tables, work, moving, token)
    store(work.unsolved, 0, where_greater(moving, zero, load(work.unsolved, 0, token), unsolved))
    _take_tensions(tables, work, moving, token)
    small = fill(bound * tables.total, work.frame, token)
    share, left = _choose_way(tables, work, moving, token)
    for row in range(SIZE * tables.held, SIZE * tables.stations):
        increment = load(work.solution, row, token)
        store(work.before, row, increment)
        store(work.velocity, row, increment)
        store(work.solution, row, share * increment)
    store(factors.strain_rate, 0, one)
    _follow_stress(tables, samples, factors, work, share * moving, token)
    store(factors.strain_rate, 0, zero)
    clear(work.velocity, SIZE * tables.held, SIZE * tables.stations, token)
    if runs is not None and slips > 0:
        sum_losses(tables, runs, samples, friction, p, token)
        keep_row(tables, factors, friction, p, work, slips, moving, token)
    move_stations(tables, moving, work, token)
    store(work.moving, 0, where_greater(left, small, moving, zero) + waiting)


@kernel
def _set_least(tables, samples, work, token):
    """Smallest factor on the mass in the matrix, about the square of the first natural frequency [1/s2]."""
    one, flexible, mass = fill(1.0, work.frame, token), fill(0.0, work.frame, token), fill(TINY, work.frame, token)
    for element in range(tables.stations - 1):
        flexible = flexible + one / load(samples.section, SECTION * element + 3, token)
    for station in range(tables.stations):
        mass = mass + station_mass(tables, samples, station, token)
    store(work.least, 0, LEAST / (flexible * mass * (tables.total * tables.total)))


@kernel
def come_to_rest(tables, runs, samples, factors, work, friction, rows, p, slips, most, bound, schedule, token):
    """Find the equilibrium of the lanes in ``moving`` from their present state in at most ``most`` iterations, to the
    increment ``bound`` relative to the body's length.
    """
    zero, one = fill(0.0, work.frame, token), fill(1.0, work.frame, token)
    _start_settling(tables, samples, factors, work, token)
    clear(work.stress, 0, SIZE * tables.stations, token)
    _follow_stress(tables, samples, factors, work, one, token)
    store(work.largest, 0, fill(UNBOUNDED, work.frame, token))
    store(work.pace, 0, zero)
    store(work.shift, 0, zero)
    _set_least(tables, samples, work, token)
    if runs is not None and slips > 0:
        gather_cables(tables, work, one, False, token)
        start_row(tables, runs, samples, friction, work, token)
    for _ in range(most):
        _iterate(tables, runs, samples, factors, work, friction, rows, p, slips, bound, schedule, token)
        if not any_greater(load(work.moving, 0, token), zero):
            break
    if runs is not None:
        end_row(friction, slips, token)


@kernel
def go_to_rest(tables, work, token):
    """Let the lanes without an equilibrium of this row move again, from the undeformed body without tension; the others
    stay.
    """
    zero, one = fill(0.0, work.frame, token), fill(1.0, work.frame, token)
    clear(work.solution, 0, SIZE * tables.stations, token)
    lost = one - near(tables, work, zero, False, token)
    missed = where_greater(load(work.unsolved, 0, token) + load(work.moving, 0, token), zero, one, lost)
    missed = missed * (one - load(work.failed, 0, token))
    put_at_rest(tables, one - missed, work, token)
    for c in range(tables.cables):
        store(work.tension, c, where_greater(missed, zero, zero, load(work.tension, c, token)))
    store(work.unsolved, 0, zero)
    store(work.moving, 0, missed)


@kernel
def _start_settling(tables, samples, factors, work, token):
    """Set the factors of a static iteration."""
    one, zero = fill(1.0, factors.force, token), fill(0.0, factors.force, token)
    store(factors.elasticity, 0, load(work.firmness, 0, token))
    store(factors.held, 0, one)
    store(factors.inertia, 0, zero)
    store(factors.force, 0, one)
    store(factors.strain, 0, load(work.firmness, 0, token))
    store(factors.strain_rate, 0, zero)
    store(factors.drag, 0, zero)
    store(factors.branch, 0, zero)
    store(factors.share, 0, zero)
    store(factors.wide, 0, one)
    store(factors.narrow, 0, one)
    store(factors.going, 0, zero)
    store(factors.give, 0, load(samples.effects, GIVE, token))


@kernel
def _add_cable_forces(tables, work, token):
    """Add the pull of all cables, whose rows dl/dx are in the border, to ``field``."""
    for c in range(tables.cables):
        row, tension = tables.row[c], load(work.tension, c, token)
        for station in range(tables.stations):
            for k in range(SIZE):
                t, f = PANEL * (station * tables.panels + row // 3) + 3 * k + row % 3, station * SIZE + k
                store(work.field, f, fnma(tension, load(work.border, t, token), load(work.field, f, token)))


@kernel
def _component(tables, field, station, i, token):
    """Size of a force on a station, or of a moment over the body's length."""
    value = magnitude(load(field, SIZE * station + i, token), fill(0.0, field, token))
    return value if i < 3 else value * (1.0 / tables.total)


@kernel
def measure_imbalance(tables, samples, factors, work, token):
    """Largest force out of balance relative to the sum of the loads; keeps it in ``imbalance``."""
    zero, tiny = fill(0.0, work.field, token), fill(1e-30, work.field, token)
    clear(work.field, 0, SIZE * tables.stations, token)
    gather_cables(tables, work, fill(1.0, work.field, token), False, token)
    loads, largest = zero, zero
    for station in range(tables.stations):
        add_station_loads(tables, samples, factors, station, work, token)
        for i in range(SIZE):
            loads = loads + _component(tables, work.field, station, i, token)
    for c in range(tables.cables):
        loads = loads + load(work.tension, c, token)
    for c in range(tables.chambers):
        loads = loads + magnitude(load(work.commanded, tables.cables + c, token), zero) * tables.thrust[c]
    if samples.present[SURROUNDED]:
        for station in range(tables.stations):
            add_surroundings(tables, samples, factors, station, False, work, token)
    for element in range(tables.stations - 1):
        measure_element(tables, samples, element, work, token)
        place_stress(tables, samples, factors, element, work, token)
        add_forces(element, work.element, work.field, token)
    _add_cable_forces(tables, work, token)
    for station in range(tables.held, tables.stations):
        for i in range(SIZE):
            force = _component(tables, work.field, station, i, token)
            largest = where_greater(largest, force, largest, force)
    store(work.imbalance, 0, largest / where_greater(loads, tiny, loads, tiny))


@kernel
def put_at_rest(tables, accepted, work, token):
    """Reset the body to its undeformed state in rejected lanes."""
    zero, one = fill(0.0, work.frame, token), fill(1.0, work.frame, token)
    for station in range(tables.stations):
        t, frame = 4 * station, FRAME * station
        for i in range(3):
            rest = fill(tables.rest[station], work.frame, token) if i == 2 else zero
            store(work.frame, frame + i, where_greater(accepted, zero, load(work.frame, frame + i, token), rest))
        for i in range(4):
            rest = one if i == 0 else zero
            store(work.turn, t + i, where_greater(accepted, zero, load(work.turn, t + i, token), rest))
        place_directors(work, station, token)


@kernel
def keep_found(tables, work, measured, token):
    """Whether the equilibria were found; lanes that are lost go back to rest, without tension.

    ``measured``: by their ``imbalance``, which is beyond any tolerance if they were not; else by their iterations.
    """
    zero, one = fill(0.0, work.frame, token), fill(1.0, work.frame, token)
    clear(work.solution, 0, SIZE * tables.stations, token)
    accepted = near(tables, work, zero, False, token)
    if measured:
        imbalance, bound = load(work.imbalance, 0, token), fill(UNBOUNDED, work.frame, token)
        accepted = where_greater(bound, imbalance, accepted, zero)
        store(work.imbalance, 0, where_greater(accepted, zero, imbalance, bound))
    else:
        failed = load(work.unsolved, 0, token) + load(work.moving, 0, token)
        store(work.failed, 0, where_greater(failed, zero, one, load(work.failed, 0, token)))
        store(work.lost, 0, where_greater(accepted, zero, load(work.lost, 0, token), one))
    put_at_rest(tables, accepted, work, token)
    for c in range(tables.cables):
        store(work.tension, c, where_greater(accepted, zero, load(work.tension, c, token), zero))
