"""The contacts of a step, lane by lane: their frames, gaps and rows, as ``fem.pushing.find_contacts`` finds them.

Which points touch differs from lane to lane, so that this is arithmetic on numbers; all else works on whole lanes.
"""

from __future__ import annotations

import math

from rfdropo_bayes.fem.native.contact_records import SPACE
from rfdropo_bayes.fem.native.simd import kernel
from rfdropo_bayes.fem.pushing import ALARM, LYING, PUSHING, RESTING

APART = 1e6
"""[m/s] Opening of a contact that exerts nothing."""
NONE = 1e9


@kernel
def turn_cube(touch, lane, lanes):
    """Matrix of the cube's orientation."""
    x, y = touch.cube[3 * lanes + lane], touch.cube[4 * lanes + lane]
    z, w = touch.cube[5 * lanes + lane], touch.cube[6 * lanes + lane]
    touch.turn[lane] = 1.0 - 2.0 * (y * y + z * z)
    touch.turn[lanes + lane] = 2.0 * (x * y - z * w)
    touch.turn[2 * lanes + lane] = 2.0 * (x * z + y * w)
    touch.turn[3 * lanes + lane] = 2.0 * (x * y + z * w)
    touch.turn[4 * lanes + lane] = 1.0 - 2.0 * (x * x + z * z)
    touch.turn[5 * lanes + lane] = 2.0 * (y * z - x * w)
    touch.turn[6 * lanes + lane] = 2.0 * (x * z - y * w)
    touch.turn[7 * lanes + lane] = 2.0 * (y * z + x * w)
    touch.turn[8 * lanes + lane] = 1.0 - 2.0 * (x * x + y * y)


@kernel
def _clearance(scene, touch, corner, lane, lanes):
    """A corner of the cube, from its centre, and its height above the plate."""
    side, height = touch.values[lanes + lane], -scene.height
    x = side * (-0.5 if corner // 4 == 0 else 0.5)
    y = side * (-0.5 if corner // 2 % 2 == 0 else 0.5)
    z = side * (-0.5 if corner % 2 == 0 else 0.5)
    cx = touch.turn[lane] * x + touch.turn[lanes + lane] * y + touch.turn[2 * lanes + lane] * z
    cy = touch.turn[3 * lanes + lane] * x + touch.turn[4 * lanes + lane] * y + touch.turn[5 * lanes + lane] * z
    cz = touch.turn[6 * lanes + lane] * x + touch.turn[7 * lanes + lane] * y + touch.turn[8 * lanes + lane] * z
    height += scene.up[0] * (cx + touch.cube[lane])
    height += scene.up[1] * (cy + touch.cube[lanes + lane])
    height += scene.up[2] * (cz + touch.cube[2 * lanes + lane])
    return cx, cy, cz, height


@kernel
def _tangent(nx, ny, nz):
    """A unit vector across a normal, and across the axis that the normal is furthest from."""
    ax, ay, az = abs(nx), abs(ny), abs(nz)
    if ax <= ay and ax <= az:
        tx, ty, tz = 0.0 * nx, nz, -ny
    elif ay <= az:
        tx, ty, tz = -nz, 0.0 * ny, nx
    else:
        tx, ty, tz = ny, -nx, 0.0 * nz
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    return tx / length, ty / length, tz / length


@kernel
def _row(touch, row, sign, x, y, z, ax, ay, az, lane, lanes):
    """A row of a contact along a direction, and what the cube's twist makes of it at an arm from its centre."""
    f, t = 3 * row * lanes + lane, 6 * row * lanes + lane
    touch.frame[f], touch.frame[f + lanes], touch.frame[f + 2 * lanes] = x, y, z
    touch.on_cube[t], touch.on_cube[t + lanes], touch.on_cube[t + 2 * lanes] = sign * x, sign * y, sign * z
    touch.on_cube[t + 3 * lanes] = sign * (ay * z - az * y)
    touch.on_cube[t + 4 * lanes] = sign * (az * x - ax * z)
    touch.on_cube[t + 5 * lanes] = sign * (ax * y - ay * x)


@kernel
def _place(touch, contact, sign, normal, arm, gap, time_step, lane, lanes):
    """Frame, rows and opening of a contact."""
    nx, ny, nz = normal
    ax, ay, az = arm
    tx, ty, tz = _tangent(nx, ny, nz)
    _row(touch, 3 * contact, sign, nx, ny, nz, ax, ay, az, lane, lanes)
    _row(touch, 3 * contact + 1, sign, tx, ty, tz, ax, ay, az, lane, lanes)
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    _row(touch, 3 * contact + 2, sign, bx, by, bz, ax, ay, az, lane, lanes)
    near = gap < ALARM
    touch.near[contact * lanes + lane] = 1.0 if near else 0.0
    touch.opening[contact * lanes + lane] = gap / time_step if near else APART


@kernel
def place_resting(scene, touch, time_step, lane, lanes):
    """Contacts of the cube's lowest corners with the plate, in the order of the corners."""
    up = (scene.up[0], scene.up[1], scene.up[2])
    contact = 0
    for corner in range(8):
        touch.level[corner * lanes + lane] = _clearance(scene, touch, corner, lane, lanes)[3]
    for corner in range(8):
        x, y, z, _ = _clearance(scene, touch, corner, lane, lanes)
        lower, height = 0, touch.level[corner * lanes + lane]  # rounded as those that it is compared with
        for other in range(8):
            level = touch.level[other * lanes + lane]
            lower += 1 if level < height or (level == height and other < corner) else 0
        if lower < RESTING and contact < RESTING:
            _place(touch, contact, 1.0, up, (x, y, z), height - scene.distance, time_step, lane, lanes)
            contact += 1
    for left in range(contact, RESTING):  # only where the cube's place is not a number
        _place(touch, left, 1.0, up, (0.0 * up[0], 0.0 * up[0], 0.0 * up[0]), APART, time_step, lane, lanes)


@kernel
def _next_point(touch, first, count, limit, previous, lane, lanes):
    """The listed point of lowest number above ``previous`` that is nearer than ``limit``."""
    found = NONE
    for s in range(first, first + count):
        p = touch.nearest[s * lanes + lane]
        if touch.gap[s * lanes + lane] < limit and p > previous and p < found:
            found = p
    return found


@kernel
def surface_point(scene, p, field, lane, lanes):
    """A point of the trunk's surface, or its velocity."""
    x, y, z = 0.0 * field[lane], 0.0 * field[lane], 0.0 * field[lane]
    for k in range(scene.first[p], scene.first[p + 1]):
        row, weight = scene.place[k] * lanes + lane, scene.weight[k]
        x += weight * field[row]
        y += weight * field[row + lanes]
        z += weight * field[row + 2 * lanes]
    return x, y, z


@kernel
def _outward(touch, x, y, z, lane, lanes):
    """Distance of a point, given from the cube's centre, to the cube, and the outward normal there."""
    half = 0.5 * touch.values[lanes + lane]
    square, deepest, axis = 0.0 * half, -NONE, 0
    nx, ny, nz = 0.0 * half, 0.0 * half, 0.0 * half
    for j in range(3):
        ux, uy = touch.turn[j * lanes + lane], touch.turn[(3 + j) * lanes + lane]
        uz = touch.turn[(6 + j) * lanes + lane]
        local = x * ux + y * uy + z * uz
        sign = -1.0 if local < 0.0 else 1.0
        beyond = sign * local - half
        if beyond > deepest:
            deepest, axis = beyond, j
        if beyond > 0.0:
            square += beyond * beyond
            nx, ny, nz = nx + sign * beyond * ux, ny + sign * beyond * uy, nz + sign * beyond * uz
    if square > 0.0:
        length = math.sqrt(square)
        return length, nx / length, ny / length, nz / length
    ux, uy = touch.turn[axis * lanes + lane], touch.turn[(3 + axis) * lanes + lane]
    uz = touch.turn[(6 + axis) * lanes + lane]
    sign = -1.0 if x * ux + y * uy + z * uz < 0.0 else 1.0
    return deepest, sign * ux, sign * uy, sign * uz


@kernel
def _list_candidate(touch, slot, p, gap, normal, arm, lane, lanes):
    """Write a candidate."""
    touch.candidate[slot * lanes + lane] = p
    t = SPACE * slot * lanes + lane
    touch.space[t] = gap
    touch.space[t + lanes], touch.space[t + 2 * lanes], touch.space[t + 3 * lanes] = normal
    touch.space[t + 4 * lanes], touch.space[t + 5 * lanes], touch.space[t + 6 * lanes] = arm


@kernel
def list_pushing(scene, touch, position, lane, lanes):
    """The trunk's points near the cube, in ascending order."""
    p = -0.5
    for s in range(touch.count[0]):
        p = _next_point(touch, 0, PUSHING, ALARM, p, lane, lanes)
        x, y, z, nx, ny, nz, gap = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, APART
        if p < NONE:
            x, y, z = surface_point(scene, int(p), position, lane, lanes)
            x, y, z = x - touch.cube[lane], y - touch.cube[lanes + lane], z - touch.cube[2 * lanes + lane]
            distance, nx, ny, nz = _outward(touch, x, y, z, lane, lanes)
            # The contact lies on the cube, below the trunk's point.
            x, y, z = x - distance * nx, y - distance * ny, z - distance * nz
            gap = distance - scene.distance
        _list_candidate(touch, s, p if p < NONE else -1.0, gap, (nx, ny, nz), (x, y, z), lane, lanes)


@kernel
def list_lying(scene, touch, position, lane, lanes):
    """The trunk's points near the plate, in ascending order."""
    nx, ny, nz, p = 1.0 * scene.up[0], 1.0 * scene.up[1], 1.0 * scene.up[2], -0.5
    for s in range(touch.count[0], touch.count[0] + touch.count[1]):
        p = _next_point(touch, PUSHING, LYING, ALARM, p, lane, lanes)
        gap = APART
        if p < NONE:
            x, y, z = surface_point(scene, int(p), position, lane, lanes)
            gap = nx * x + ny * y + nz * z - scene.height - scene.distance
        _list_candidate(touch, s, p if p < NONE else -1.0, gap, (nx, ny, nz), (0.0, 0.0, 0.0), lane, lanes)


@kernel
def place_candidate(touch, slot, contact, time_step, lane, lanes):
    """Make a candidate a contact; without one (``slot`` negative), one that exerts nothing."""
    point, sign, gap = -1.0, 0.0, APART
    nx, ny, nz, x, y, z = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if slot >= 0:
        t = SPACE * slot * lanes + lane
        point, gap = 1.0 * touch.candidate[slot * lanes + lane], 1.0 * touch.space[t]
        sign = -1.0 if slot < touch.count[0] else 0.0
        nx, ny, nz = touch.space[t + lanes], touch.space[t + 2 * lanes], touch.space[t + 3 * lanes]
        x, y, z = touch.space[t + 4 * lanes], touch.space[t + 5 * lanes], touch.space[t + 6 * lanes]
    touch.point[(contact - RESTING) * lanes + lane] = point
    _place(touch, contact, sign, (nx, ny, nz), (x, y, z), gap, time_step, lane, lanes)


@kernel
def free_cube(touch, gravity, drag, time_step, lane, lanes):
    """Twist of the cube at the end of a step without contacts; see ``fem.rigid_body.free_twist``."""
    shrink = 1.0 / (1.0 + time_step * drag[lane])
    for i in range(3):
        velocity = touch.cube[(7 + i) * lanes + lane] + time_step * gravity[i * lanes + lane]
        touch.twist[i * lanes + lane] = velocity * shrink
        touch.twist[(3 + i) * lanes + lane] = touch.cube[(10 + i) * lanes + lane] * shrink


@kernel
def move_cube(touch, time_step, lane, lanes):
    """Let the cube move on with ``after``; see ``fem.rigid_body.moved``. Returns False if that leads nowhere."""
    wx, wy, wz = (
        0.5 * time_step * touch.after[3 * lanes + lane],
        0.5 * time_step * touch.after[4 * lanes + lane],
        0.5 * time_step * touch.after[5 * lanes + lane],
    )
    square = wx * wx + wy * wy + wz * wz
    angle = math.sqrt(square)
    share = math.sin(angle) / angle if square > 0.0 else 1.0
    scalar, wx, wy, wz = math.cos(angle), share * wx, share * wy, share * wz
    x, y = touch.cube[3 * lanes + lane], touch.cube[4 * lanes + lane]
    z, w = touch.cube[5 * lanes + lane], touch.cube[6 * lanes + lane]
    qx = scalar * x + w * wx + wy * z - wz * y
    qy = scalar * y + w * wy + wz * x - wx * z
    qz = scalar * z + w * wz + wx * y - wy * x
    qw = scalar * w - wx * x - wy * y - wz * z
    length = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    px = touch.cube[lane] + time_step * touch.after[lane]
    py = touch.cube[lanes + lane] + time_step * touch.after[lanes + lane]
    pz = touch.cube[2 * lanes + lane] + time_step * touch.after[2 * lanes + lane]
    if not math.isfinite(px + py + pz + length):
        return False
    touch.cube[lane], touch.cube[lanes + lane], touch.cube[2 * lanes + lane] = px, py, pz
    touch.cube[3 * lanes + lane], touch.cube[4 * lanes + lane] = qx / length, qy / length
    touch.cube[5 * lanes + lane], touch.cube[6 * lanes + lane] = qz / length, qw / length
    for i in range(6):
        touch.cube[(7 + i) * lanes + lane] = touch.after[i * lanes + lane]
    return True
