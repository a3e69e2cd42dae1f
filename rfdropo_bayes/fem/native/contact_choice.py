"""Which of the trunk's candidates are contacts of a step, lane by lane.

Most points near a surface do not touch it in the step, and every contact costs a solve with the factor of the body. A
lane starts with the candidates that its velocities would close; what then turns out to close as well is added, and the
step solved again. A lane that is done finds its own solution again, bit for bit, while others go on.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.contact_records import SPACE
from rfdropo_bayes.fem.native.contact_rows import place_candidate, surface_point
from rfdropo_bayes.fem.native.simd import kernel
from rfdropo_bayes.fem.pushing import ALARM, RESTING

EAGER = 0.02
"""[m/s] A candidate is a contact from the start if it would open more slowly than this; it saves solves, no more."""
PATIENCE = 4
"""Solves of a step after which a lane that is not done takes all its candidates."""


@kernel
def _opening_rate(scene, touch, slot, field, twist, first, lane, lanes):
    """Velocity at which a candidate opens, by a velocity field of the body and six rows of the cube's twist."""
    t, u = SPACE * slot * lanes + lane, first * lanes + lane
    nx, ny, nz = touch.space[t + lanes], touch.space[t + 2 * lanes], touch.space[t + 3 * lanes]
    x, y, z = surface_point(scene, int(touch.candidate[slot * lanes + lane]), field, lane, lanes)
    if slot < touch.count[0]:
        ax, ay, az = touch.space[t + 4 * lanes], touch.space[t + 5 * lanes], touch.space[t + 6 * lanes]
        wx, wy, wz = twist[u + 3 * lanes], twist[u + 4 * lanes], twist[u + 5 * lanes]
        x, y, z = (
            x - twist[u] - (wy * az - wz * ay),
            y - twist[u + lanes] - (wz * ax - wx * az),
            z - twist[u + 2 * lanes] - (wx * ay - wy * ax),
        )
    return nx * x + ny * y + nz * z


@kernel
def _present(touch, slot, lane, lanes):
    """Whether a lane has this candidate."""
    return touch.candidate[slot * lanes + lane] >= 0.0 and touch.space[SPACE * slot * lanes + lane] < ALARM


@kernel
def choose_closing(scene, touch, candidates, velocity, time_step, lane, lanes):
    """Choose the candidates that the velocities of the step's start would close."""
    for slot in range(candidates):
        chosen = False
        if _present(touch, slot, lane, lanes):
            opening = touch.space[SPACE * slot * lanes + lane] / time_step
            chosen = opening + _opening_rate(scene, touch, slot, velocity, touch.cube, 7, lane, lanes) < EAGER
        touch.chosen[slot * lanes + lane] = 1.0 if chosen else 0.0


@kernel
def choose_all(touch, candidates, lane, lanes):
    """Choose all candidates."""
    for slot in range(candidates):
        touch.chosen[slot * lanes + lane] = 1.0 if _present(touch, slot, lane, lanes) else 0.0


@kernel
def choose_missed(scene, touch, candidates, velocity, increment, time_step, tolerance, lane, lanes):
    """Add the candidates that the step's solution closes beyond ``tolerance`` [m/s]; returns whether there are any."""
    missed = False
    for slot in range(candidates):
        if touch.chosen[slot * lanes + lane] > 0.0 or not _present(touch, slot, lane, lanes):
            continue
        opening = touch.space[SPACE * slot * lanes + lane] / time_step
        opening += _opening_rate(scene, touch, slot, velocity, touch.after, 0, lane, lanes)
        x, y, z = surface_point(scene, int(touch.candidate[slot * lanes + lane]), increment, lane, lanes)
        t = SPACE * slot * lanes + lane
        nx, ny, nz = touch.space[t + lanes], touch.space[t + 2 * lanes], touch.space[t + 3 * lanes]
        if opening + nx * x + ny * y + nz * z < -tolerance:
            touch.chosen[slot * lanes + lane] = 1.0
            missed = True
    return missed


@kernel
def place_chosen(touch, candidates, time_step, lanes):
    """Make contacts of every lane's choice, in ascending order; returns how many the trunk takes part in."""
    panels = 0
    for lane in range(lanes):
        count = 0
        for slot in range(candidates):
            count += 1 if touch.chosen[slot * lanes + lane] > 0.0 else 0
        panels = max(panels, count)
    for lane in range(lanes):
        slot = -1
        for panel in range(panels):
            slot += 1
            while slot < candidates and not touch.chosen[slot * lanes + lane] > 0.0:
                slot += 1
            place_candidate(touch, slot if slot < candidates else -1, RESTING + panel, time_step, lane, lanes)
    return panels
