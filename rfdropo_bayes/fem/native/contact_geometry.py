"""The contacts of a step in SIMD lanes: their gaps, frames and rows, as ``fem.pushing.find_contacts`` finds them.

Lanes share the examined pairs. A pair is a candidate if it is near in any lane, and a contact if any lane has chosen
it; it stays open in the other lanes.
"""

from __future__ import annotations

import math

from rfdropo_bayes.fem.constraints import APART
from rfdropo_bayes.fem.integrators import REBOUND
from rfdropo_bayes.fem.native.contact_records import CORNERS
from rfdropo_bayes.fem.native.simd import (
    any_greater,
    fill,
    fma,
    fnma,
    kernel,
    load,
    load3,
    magnitude,
    square_root,
    store,
    where_greater,
)
from rfdropo_bayes.fem.native.sphere_maps import centre_of, centre_velocity, place_offset, row_entry
from rfdropo_bayes.fem.native.vectors import dot

ALARM = 0.005
"""[m] Surfaces nearer than this, and as much more as they move in two steps, are looked at for contacts."""
EAGER = 0.02
"""[m/s] A candidate is a contact from the start if it would open more slowly than this; it saves solves, no more."""
HALF_DIAGONAL = 0.5 * math.sqrt(3.0)
"""Half the diagonal of a unit cube."""


@kernel
def _dot(a, b, c, x, y, z):
    return fma(a, x, fma(b, y, c * z))


@kernel
def turn_cube(touch, token):
    """Matrix of the cube's orientation."""
    x, y, z = load3(touch.cube, 3, token)
    w, one = load(touch.cube, 6, token), fill(1.0, touch.cube, token)
    store(touch.turn, 0, one - 2.0 * fma(y, y, z * z), 2.0 * fma(x, y, -z * w), 2.0 * fma(x, z, y * w))
    store(touch.turn, 3, 2.0 * fma(x, y, z * w), one - 2.0 * fma(x, x, z * z), 2.0 * fma(y, z, -x * w))
    store(touch.turn, 6, 2.0 * fma(x, z, -y * w), 2.0 * fma(y, z, x * w), one - 2.0 * fma(x, x, y * y))


@kernel
def free_cube(touch, gravity, drag, time_step, wide, going, token):
    """Twist of the cube at the end of a stage without contacts; see ``fem.rigid_body.free_twist``."""
    one = fill(1.0, touch.cube, token)
    shrink = one / fma(load(drag, 0, token) * wide, time_step, one)
    for i in range(3):
        velocity = fma(going, load(touch.carried, i, token), load(touch.cube, 7 + i, token))
        velocity = fma(load(gravity, i, token) * wide, time_step, velocity)
        spin = fma(going, load(touch.carried, 3 + i, token), load(touch.cube, 10 + i, token))
        store(touch.twist, i, velocity * shrink)
        store(touch.twist, 3 + i, spin * shrink)


@kernel
def _height(scene, x, y, z):
    """Height of a point above the plate."""
    return fma(x, scene.up[0], fma(y, scene.up[1], z * scene.up[2])) - scene.height


@kernel
def _place_frame(touch, slot, x, y, z, token):
    """A normal, and two tangents; the first is across the axis that the normal is furthest from."""
    zero, one = fill(0.0, touch.cube, token), fill(1.0, touch.cube, token)
    ax, ay, az = magnitude(x, zero), magnitude(y, zero), magnitude(z, zero)
    first = where_greater(ax, ay, zero, where_greater(ax, az, zero, one))
    second = (one - first) * where_greater(ay, az, zero, one)
    third = one - first - second
    tx, ty, tz = fnma(second, z, third * y), fnma(third, x, first * z), fnma(first, y, second * x)
    scale = one / square_root(_dot(tx, ty, tz, tx, ty, tz))
    tx, ty, tz = tx * scale, ty * scale, tz * scale
    f = 9 * slot
    store(touch.frame, f, x, y, z, tx, ty, tz, fnma(z, ty, y * tz), fnma(x, tz, z * tx), fnma(y, tx, x * ty))


@kernel
def _list(touch, slot, pair, gap, x, y, z, nx, ny, nz, token):
    """Write a candidate: gap, place relative to the cube's centre, and normal."""
    touch.pair[slot] = pair
    store(touch.gap, slot, gap)
    store(touch.arm, 3 * slot, x, y, z)
    _place_frame(touch, slot, nx, ny, nz, token)


@kernel
def _upward(scene, touch, token):
    """Normal of the plate."""
    zero = fill(0.0, touch.cube, token)
    return zero + scene.up[0], zero + scene.up[1], zero + scene.up[2]


@kernel
def _length(x, y, z):
    return square_root(_dot(x, y, z, x, y, z))


@kernel
def _within(gap, reach, token):
    """The gap, or a gap out of reach if it exceeds ``reach``."""
    return where_greater(reach, gap, gap, fill(APART, gap, token))


@kernel
def _place_spheres(scene, touch, position, velocity, time_step, token):
    """The spheres' centres, and their reach."""
    for sphere in range(scene.spheres):
        x, y, z = centre_of(scene, scene.gradient, scene.arm, touch, sphere, position, token)
        store(touch.middle, 3 * sphere, x, y, z)
        u, v, w = centre_velocity(scene, scene.gradient, scene.arm, touch, sphere, velocity, token)
        store(touch.reach, sphere, 2.0 * time_step * _length(u, v, w) + ALARM)


@kernel
def _cube_reach(touch, time_step, token):
    """Largest displacement of a point of the cube in two steps."""
    x, y, z = load3(touch.cube, 7, token)
    u, v, w = load3(touch.cube, 10, token)
    return 2.0 * time_step * fma(load(touch.values, 1, token), _length(u, v, w), _length(x, y, z))


@kernel
def _list_corners(scene, touch, reach, token):
    """The cube's corners that are near the plate in any lane; returns how many."""
    nx, ny, nz = _upward(scene, touch, token)
    half, slot, reach = 0.5 * load(touch.values, 1, token), 0, reach + ALARM
    cx, cy, cz = load3(touch.cube, 0, token)
    level = _height(scene, cx, cy, cz) - scene.distance
    for corner in range(CORNERS):
        x = half * (-1.0 if corner // 4 == 0 else 1.0)
        y = half * (-1.0 if corner // 2 % 2 == 0 else 1.0)
        z = half * (-1.0 if corner % 2 == 0 else 1.0)
        ax, bx, dx = load3(touch.turn, 0, token)
        ay, by, dy = load3(touch.turn, 3, token)
        az, bz, dz = load3(touch.turn, 6, token)
        ax, ay, az = _dot(ax, bx, dx, x, y, z), _dot(ay, by, dy, x, y, z), _dot(az, bz, dz, x, y, z)
        gap = level + fma(ax, scene.up[0], fma(ay, scene.up[1], az * scene.up[2]))
        if any_greater(reach, gap):
            _list(touch, slot, corner, _within(gap, reach, token), ax, ay, az, nx, ny, nz, token)
            slot += 1
    return slot


@kernel
def _box_distance(touch, x, y, z, token):
    """Signed distance of a point, given from the cube's centre, to the cube, and the outward normal there."""
    zero, one = fill(0.0, touch.cube, token), fill(1.0, touch.cube, token)
    half, square, deepest = 0.5 * load(touch.values, 1, token), zero, zero - APART
    nx, ny, nz, mx, my, mz = zero, zero, zero, zero, zero, zero
    for j in range(3):
        ux, uy, uz = load(touch.turn, j, token), load(touch.turn, j + 3, token), load(touch.turn, j + 6, token)
        local = _dot(x, y, z, ux, uy, uz)
        sign = where_greater(zero, local, -one, one)
        beyond = fma(sign, local, -half)
        outside = where_greater(beyond, zero, beyond, zero)
        square = fma(outside, outside, square)
        outside = outside * sign
        nx, ny, nz = fma(outside, ux, nx), fma(outside, uy, ny), fma(outside, uz, nz)
        mx = where_greater(beyond, deepest, sign * ux, mx)
        my = where_greater(beyond, deepest, sign * uy, my)
        mz = where_greater(beyond, deepest, sign * uz, mz)
        deepest = where_greater(beyond, deepest, beyond, deepest)
    length = square_root(where_greater(square, zero, square, one))
    scale = one / length
    nx = where_greater(square, zero, nx * scale, mx)
    ny = where_greater(square, zero, ny * scale, my)
    nz = where_greater(square, zero, nz * scale, mz)
    return where_greater(square, zero, length, deepest), nx, ny, nz


@kernel
def _list_pushing(scene, touch, position, slot, reach, token):
    """The spheres that are near the cube in any lane; returns the next free slot."""
    (cx, cy, cz), outer = load3(touch.cube, 0, token), HALF_DIAGONAL * load(touch.values, 1, token)
    for sphere in range(scene.spheres):
        x, y, z = load3(touch.middle, 3 * sphere, token)
        x, y, z, near = x - cx, y - cy, z - cz, reach + load(touch.reach, sphere, token)
        far = outer + near + (scene.radius[sphere] + scene.distance)
        if not any_greater(far * far, _dot(x, y, z, x, y, z)):
            continue
        distance, nx, ny, nz = _box_distance(touch, x, y, z, token)
        gap = distance - (scene.radius[sphere] + scene.distance)
        if any_greater(near, gap):
            # The contact lies on the cube, below the sphere's centre.
            x, y, z = fnma(distance, nx, x), fnma(distance, ny, y), fnma(distance, nz, z)
            _list(touch, slot, CORNERS + sphere, _within(gap, near, token), x, y, z, nx, ny, nz, token)
            place_offset(scene, scene.gradient, scene.arm, touch, slot, sphere, position, token)
            slot += 1
    return slot


@kernel
def _list_lying(scene, touch, position, slot, token):
    """The spheres that are near the plate in any lane; returns the next free slot."""
    zero, (nx, ny, nz) = fill(0.0, touch.cube, token), _upward(scene, touch, token)
    for sphere in range(scene.spheres):
        x, y, z = load3(touch.middle, 3 * sphere, token)
        near = load(touch.reach, sphere, token)
        gap = _height(scene, x, y, z) - (scene.radius[sphere] + scene.distance)
        if any_greater(near, gap):
            pair, gap = CORNERS + scene.spheres + sphere, _within(gap, near, token)
            _list(touch, slot, pair, gap, zero, zero, zero, nx, ny, nz, token)
            place_offset(scene, scene.gradient, scene.arm, touch, slot, sphere, position, token)
            slot += 1
    return slot


@kernel
def sphere_of(scene, pair):
    """The sphere of a pair that has one."""
    return (pair - CORNERS) % scene.spheres


@kernel
def cube_row(touch, slot, r, kind, token):
    """Derivative of a candidate's relative velocity along row r by the cube's twist; zero between trunk and plate."""
    sign = 1.0 if kind == 0 else -1.0 if kind == 1 else 0.0
    x, y, z = load3(touch.frame, 9 * slot + 3 * r, token)
    ax, ay, az = load3(touch.arm, 3 * slot, token)
    x, y, z = sign * x, sign * y, sign * z
    return x, y, z, fnma(az, y, ay * z), fnma(ax, z, az * x), fnma(ay, x, ax * y)


@kernel
def kind_of(touch, slot):
    """0: corner and plate, 1: sphere and cube, 2: sphere and plate."""
    return 0 if slot < touch.count[0] else 1 if slot < touch.count[0] + touch.count[1] else 2


@kernel
def trunk_velocity(scene, touch, slot, kind, field, token):
    """Contribution of a velocity field of the body to a candidate's relative velocity."""
    zero = fill(0.0, touch.cube, token)
    u, v, w = zero, zero, zero
    if kind == 0:
        return u, v, w
    sphere = sphere_of(scene, touch.pair[slot])
    for k in range(scene.first[sphere], scene.first[sphere + 1]):
        value = load3(field, scene.place[k], token)
        u = u + dot(row_entry(scene, scene.gradient, scene.arm, touch, slot, k, 0, token), value)
        v = v + dot(row_entry(scene, scene.gradient, scene.arm, touch, slot, k, 1, token), value)
        w = w + dot(row_entry(scene, scene.gradient, scene.arm, touch, slot, k, 2, token), value)
    return u, v, w


@kernel
def cube_rate(touch, slot, kind, r, twist, first, token):
    """Contribution of the cube's twist, at rows from ``first`` on, to a candidate's relative velocity along row r."""
    a, b, c, d, e, f = cube_row(touch, slot, r, kind, token)
    x, y, z = load3(twist, first, token)
    u, v, w = load3(twist, first + 3, token)
    return _dot(a, b, c, x, y, z) + _dot(d, e, f, u, v, w)


@kernel
def add_cube_velocity(touch, slot, kind, u, v, w, twist, first, token):
    """A candidate's relative velocity including the cube's twist, at rows from ``first`` on."""
    u = u + cube_rate(touch, slot, kind, 0, twist, first, token)
    v = v + cube_rate(touch, slot, kind, 1, twist, first, token)
    return u, v, w + cube_rate(touch, slot, kind, 2, twist, first, token)


@kernel
def _closing(touch, slot, u, v, w, time_step, narrow, token):
    """Velocity at which a candidate presses, given its relative velocity, friction included; see `fem.constraints`."""
    sliding = square_root(fma(v, v, w * w))
    pressed = fma(load(touch.values, 3, token), sliding, -u)
    return pressed - load(touch.gap, slot, token) * (1.0 / time_step) * narrow


@kernel
def _near(touch, slot, value, token):
    """A value in the lanes that a candidate is within reach of, zero elsewhere."""
    return where_greater(fill(0.5 * APART, value, token), load(touch.gap, slot, token), value, fill(0.0, value, token))


@kernel
def impact(change, token):
    """Degree to which a change of the closing speed is an impact, from 0 to 1."""
    square = change * change
    return square / (square + REBOUND * REBOUND)


@kernel
def _longer(touch, slot, u, stage, token):
    """Extra length of a stage for a candidate that closes with this relative velocity; see
    ``fem.integrators``."""
    zero, one, gap = fill(0.0, touch.cube, token), fill(1.0, touch.cube, token), load(touch.gap, slot, token)
    closes = where_greater(zero, gap, where_greater(zero, u, one, zero), zero)
    past = where_greater(closes, zero, gap / where_greater(closes, zero, u, one), zero)
    longest = fill(stage.elapsed, past, token)
    longer = where_greater(past, longest, longest, past) - stage.length
    return where_greater(longer, zero, longer, zero) * impact(u, token)


@kernel
def find_candidates(scene, position, velocity, touch, stage, token):
    """The candidates of a stage; returns the factor on its length for their impacts."""
    turn_cube(touch, token)
    _place_spheres(scene, touch, position, velocity, stage.length, token)
    reach = _cube_reach(touch, stage.length, token)
    corners = _list_corners(scene, touch, reach, token)
    pushing = _list_pushing(scene, touch, position, corners, reach, token)
    last = _list_lying(scene, touch, position, pushing, token)
    touch.count[0], touch.count[1], touch.count[2] = corners, pushing - corners, last - pushing
    longest = fill(0.0, touch.cube, token)
    for slot in range(last):
        kind = kind_of(touch, slot)
        u, v, w = trunk_velocity(scene, touch, slot, kind, velocity, token)
        store(touch.rate, 3 * slot, u, v, w)
        if stage.carried > 0.0:
            longer = _longer(touch, slot, u + cube_rate(touch, slot, kind, 0, touch.cube, 7, token), stage, token)
            longest = where_greater(longer, longest, longer, longest)
    return fill(1.0, longest, token) + longest * (1.0 / stage.length)


@kernel
def choose_closing(touch, gravity, drag, stage, wide, narrow, going, token):
    """The cube without contacts, and which candidates of a stage the velocities of its start would close."""
    zero, one, time_step = fill(0.0, touch.cube, token), fill(1.0, touch.cube, token), stage.length
    free_cube(touch, gravity, drag, time_step, wide, going, token)
    for slot in range(touch.count[0] + touch.count[1] + touch.count[2]):
        u, v, w = load3(touch.rate, 3 * slot, token)
        u, v, w = add_cube_velocity(touch, slot, kind_of(touch, slot), u, v, w, touch.cube, 7, token)
        if stage.predicted:  # the velocity of the start has closed the gap already
            store(touch.gap, slot, fnma(u * wide, time_step, load(touch.gap, slot, token)))
        closing = where_greater(_closing(touch, slot, u, v, w, time_step, narrow, token), -EAGER * one, one, zero)
        # A former contact may hold on by its friction.
        x, y, z = load3(touch.memory, 3 * touch.pair[slot], token)
        closing = where_greater(_dot(x, y, z, x, y, z), zero, one, closing)
        store(touch.chosen, slot, _near(touch, slot, closing, token))


@kernel
def choose_all(touch, token):
    """Choose all candidates."""
    one = fill(1.0, touch.cube, token)
    for slot in range(touch.count[0] + touch.count[1] + touch.count[2]):
        store(touch.chosen, slot, _near(touch, slot, one, token))


@kernel
def list_contacts(touch, token):
    """List the candidates that any lane has chosen; returns their number, and the number of contacts with the trunk."""
    zero, contacts, corners = fill(0.0, touch.cube, token), 0, 0
    for slot in range(touch.count[0] + touch.count[1] + touch.count[2]):
        if any_greater(load(touch.chosen, slot, token), zero):
            touch.contact[contacts] = slot
            contacts += 1
            if kind_of(touch, slot) == 0:
                corners += 1
    touch.count[3] = corners
    return contacts


@kernel
def add_missed(scene, touch, increment, time_step, narrow, missed, token):
    """Choose the candidates that a step's solution closes; returns whether there are any."""
    zero, one, found = fill(0.0, touch.cube, token), fill(1.0, touch.cube, token), False
    for slot in range(touch.count[0] + touch.count[1] + touch.count[2]):
        chosen, kind = load(touch.chosen, slot, token), kind_of(touch, slot)
        near = _near(touch, slot, one - chosen, token)
        if not any_greater(near, zero):
            continue
        u, v, w = load3(touch.rate, 3 * slot, token)
        x, y, z = trunk_velocity(scene, touch, slot, kind, increment, token)
        u, v, w = add_cube_velocity(touch, slot, kind, u + x, v + y, w + z, touch.after, 0, token)
        near = where_greater(_closing(touch, slot, u, v, w, time_step, narrow, token), missed * one, near, zero)
        if any_greater(near, zero):
            found = True
            store(touch.chosen, slot, chosen + near)
    return found
