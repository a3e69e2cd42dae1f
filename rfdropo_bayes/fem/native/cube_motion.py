"""Cubes of a lane block: their part of a stage's constraints, their motion, and the record."""

from __future__ import annotations

import math

from rfdropo_bayes.fem.constraints import APART
from rfdropo_bayes.fem.native.contact_geometry import cube_rate, cube_row, impact, kind_of
from rfdropo_bayes.fem.native.contact_records import CORNERS, CUBE_STATE, CUBE_VALUES
from rfdropo_bayes.fem.native.fields import fill_lanes
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, store, where_greater


@kernel
def start_cubes(scene, cubes, count, touch, first, token):
    """Cubes of a lane block at the start."""
    fill_lanes(cubes.state, CUBE_STATE, 0, CUBE_STATE, first, count, touch.cube, token)
    fill_lanes(cubes.values, CUBE_VALUES, 0, CUBE_VALUES, first, count, touch.values, token)
    for i in range(3 * (CORNERS + 2 * scene.spheres)):
        store(touch.memory, i, fill(0.0, touch.cube, token))


@kernel
def add_cube(touch, p, lines, contacts, time_step, wide, narrow, token):
    """Add the cube to the problem of a step: W, the velocities without impulses, openings, and the start of the
    iterations.
    """
    zero, one, n = fill(0.0, touch.cube, token), fill(1.0, touch.cube, token), lines + 3 * contacts
    light = one / load(touch.values, 0, token)
    gyration = load(touch.values, 2, token)
    nimble = light / (gyration * gyration)
    store(p.friction, 0, load(touch.values, 3, token))
    for c in range(contacts):
        slot = touch.contact[c]
        kind, chosen = kind_of(touch, slot), load(touch.chosen, slot, token)
        opening = load(touch.gap, slot, token) * (1.0 / time_step) * narrow
        store(p.opening, c, where_greater(chosen, zero, opening, one * APART))
        for r in range(3):
            i = lines + 3 * c + r
            row = cube_row(touch, slot, r, kind, token)
            rate = load(p.free, i, token)
            for k, value in enumerate(row):
                store(touch.on_cube, 18 * c + 6 * r + k, value)
                rate = fma(value, load(touch.twist, k, token), rate)
            store(p.free, i, where_greater(chosen, zero, rate, zero))  # others' contacts are no measure of a lane's
            before = zero
            for k in range(3):
                remembered = load(touch.memory, 3 * touch.pair[slot] + k, token)
                before = fma(remembered, load(touch.frame, 9 * slot + 3 * r + k, token), before)
            before = where_greater(chosen, zero, before * wide, zero)
            store(p.impulse, i, before)
            if r > 0:
                store(p.held, 2 * c + r - 1, before)
    for i in range(3 * contacts):
        for j in range(i + 1):
            value, turning = zero, zero
            for k in range(3):
                value = fma(load(touch.on_cube, 6 * i + k, token), load(touch.on_cube, 6 * j + k, token), value)
                t, s = 6 * i + 3 + k, 6 * j + 3 + k
                turning = fma(load(touch.on_cube, t, token), load(touch.on_cube, s, token), turning)
            t, s = (lines + i) * n + lines + j, (lines + j) * n + lines + i
            value = load(p.matrix, t, token) + fma(nimble, turning, light * value)
            store(p.matrix, t, value)
            store(p.matrix, s, value)


@kernel
def stop_cube(touch, p, lines, contacts, token):
    """The cube's twist ``after`` the contacts' impulses."""
    light = fill(1.0, touch.cube, token) / load(touch.values, 0, token)
    gyration = load(touch.values, 2, token)
    for k in range(6):
        total = fill(0.0, touch.cube, token)
        for i in range(3 * contacts):
            total = fma(load(touch.on_cube, 6 * i + k, token), load(p.impulse, lines + i, token), total)
        share = light if k < 3 else light / (gyration * gyration)
        store(touch.after, k, fma(share, total, load(touch.twist, k, token)))


@kernel
def remember_impulses(scene, touch, p, lines, contacts, narrow, accepted, token):
    """Keep the impulses of an accepted step, in space. The next step starts from these impulses, so that friction
    continues.
    """
    zero, taken = fill(0.0, touch.cube, token), load(accepted, 0, token)
    for i in range(3 * (CORNERS + 2 * scene.spheres)):
        store(touch.memory, i, zero)
    for c in range(contacts):
        slot = touch.contact[c]
        for k in range(3):
            total = zero
            for r in range(3):
                impulse = load(p.impulse, lines + 3 * c + r, token)
                total = fma(impulse, load(touch.frame, 9 * slot + 3 * r + k, token), total)
            store(touch.memory, 3 * touch.pair[slot] + k, where_greater(taken, zero, total * narrow, zero))


@kernel
def find_impacts(touch, p, lines, contacts, token):
    """Copy the impact part of contact impulses, which changes the closing speed, into ``before``."""
    for c in range(contacts):
        slot, i = touch.contact[c], lines + 3 * c
        start = load(touch.rate, 3 * slot, token)
        start = start + cube_rate(touch, slot, kind_of(touch, slot), 0, touch.cube, 7, token)
        share = impact(load(p.velocity, i, token) - start, token)
        for r in range(3):
            store(p.before, i + r, share * load(p.impulse, i + r, token))


@kernel
def carry_cube(touch, p, lines, contacts, later, accepted, token):
    """The change of the cube's twist without impacts, a share of which a later stage carries on."""
    zero, taken = fill(0.0, touch.cube, token), load(accepted, 0, token)
    light = fill(1.0, touch.cube, token) / load(touch.values, 0, token)
    gyration = load(touch.values, 2, token)
    for k in range(6):
        total = zero
        for i in range(3 * contacts if later > 0.0 else 0):
            total = fma(load(touch.on_cube, 6 * i + k, token), load(p.before, lines + i, token), total)
        share = light if k < 3 else light / (gyration * gyration)
        change = load(touch.after, k, token) - load(touch.cube, 7 + k, token)
        change = where_greater(taken, zero, fnma(share, total, change), zero)
        store(touch.carried, k, change if later > 0.0 else zero)


@kernel
def predict_cubes(touch, time, token):
    """Let the cubes move on at their velocity and spin."""
    lanes = len(token)
    for lane in range(lanes):
        for i in range(6):
            touch.after[i * lanes + lane] = touch.cube[(7 + i) * lanes + lane]
        _move_cube(touch, time, 0.0, lane, lanes)


@kernel
def _move_cube(touch, time_step, moved, lane, lanes):
    """Move the cube with the velocity and spin ``after`` minus the share with which the cube has ``moved`` already; see
    ``fem.rigid_body.moved``. Returns False if that leads nowhere.
    """
    wx, wy, wz = (
        0.5 * time_step * (touch.after[3 * lanes + lane] - moved * touch.cube[10 * lanes + lane]),
        0.5 * time_step * (touch.after[4 * lanes + lane] - moved * touch.cube[11 * lanes + lane]),
        0.5 * time_step * (touch.after[5 * lanes + lane] - moved * touch.cube[12 * lanes + lane]),
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
    vx = touch.after[lane] - moved * touch.cube[7 * lanes + lane]
    vy = touch.after[lanes + lane] - moved * touch.cube[8 * lanes + lane]
    vz = touch.after[2 * lanes + lane] - moved * touch.cube[9 * lanes + lane]
    px = touch.cube[lane] + time_step * vx
    py = touch.cube[lanes + lane] + time_step * vy
    pz = touch.cube[2 * lanes + lane] + time_step * vz
    if not math.isfinite(px + py + pz + length):
        return False
    touch.cube[lane], touch.cube[lanes + lane], touch.cube[2 * lanes + lane] = px, py, pz
    touch.cube[3 * lanes + lane], touch.cube[4 * lanes + lane] = qx / length, qy / length
    touch.cube[5 * lanes + lane], touch.cube[6 * lanes + lane] = qz / length, qw / length
    for i in range(6):
        touch.cube[(7 + i) * lanes + lane] = touch.after[i * lanes + lane]
    return True


@kernel
def take_cube_stage(touch, accepted, lost, length, wide, predicted, token):
    """Move the cube if the body's stage was accepted, else stop it; marks lanes with a non-finite result."""
    lanes, moved = len(token), 1.0 if predicted else 0.0
    for lane in range(lanes):
        if not (accepted[lane] > 0.0 and _move_cube(touch, length * wide[lane], moved, lane, lanes)):
            for i in range(6):
                touch.cube[(7 + i) * lanes + lane] = 0.0
                touch.carried[i * lanes + lane] = 0.0
            lost[lane] = 1.0


@kernel
def record_cubes(touch, poses, records, row, first, count, token):
    """Write the poses of the lanes that belong to the batch."""
    lanes = len(token)
    for lane in range(min(lanes, count - first)):
        at = 7 * ((first + lane) * records + row)
        for k in range(7):
            poses.pose[at + k] = touch.cube[k * lanes + lane]
