"""Cubes of a lane block: from the start of a rollout, through the contacts and the motion of a step, to the record."""

from __future__ import annotations

from rfdropo_bayes.fem.native.contact_records import CUBE_STATE, CUBE_VALUES
from rfdropo_bayes.fem.native.contact_rows import (
    free_cube,
    list_lying,
    list_pushing,
    move_cube,
    place_resting,
    turn_cube,
)
from rfdropo_bayes.fem.native.contact_search import search
from rfdropo_bayes.fem.native.layered_rollout import fill_lanes
from rfdropo_bayes.fem.native.simd import kernel


@kernel
def find_candidates(scene, position, gravity, drag, touch, time_step, token):
    """The cube's contacts, and the trunk's candidates, from positions; returns how many candidates there are."""
    lanes = len(token)
    for lane in range(lanes):
        turn_cube(touch, lane, lanes)
        free_cube(touch, gravity, drag, time_step, lane, lanes)
        place_resting(scene, touch, time_step, lane, lanes)
    search(scene, position, touch, token)
    for lane in range(lanes):
        list_pushing(scene, touch, position, lane, lanes)
        list_lying(scene, touch, position, lane, lanes)
    return touch.count[0] + touch.count[1]


@kernel
def take_cube_step(touch, accepted, lost, time_step, lane, lanes):
    """Move the cube on where the body's step was taken, else stop it; marks lanes where that leads nowhere."""
    fine = accepted[lane] > 0.0 and move_cube(touch, time_step, lane, lanes)
    if not fine:
        for i in range(6):
            touch.cube[(7 + i) * lanes + lane] = 0.0
        lost[lane] = 1.0
    elif touch.stuck[lane] > 0.0:
        touch.failed[lane] = 1.0


@kernel
def start_cubes(cubes, count, touch, first, token):
    """Cubes of a lane block at the start."""
    fill_lanes(cubes.state, CUBE_STATE, 0, CUBE_STATE, first, count, touch.cube, token)
    fill_lanes(cubes.values, CUBE_VALUES, 0, CUBE_VALUES, first, count, touch.values, token)
    for lane in range(len(token)):
        touch.failed[lane] = 0.0


@kernel
def record_cubes(touch, poses, records, row, first, count, token):
    """Write the poses of the lanes that belong to the batch."""
    lanes = len(token)
    for lane in range(min(lanes, count - first)):
        at = 7 * ((first + lane) * records + row)
        for k in range(7):
            poses.pose[at + k] = touch.cube[k * lanes + lane]


@kernel
def finish_cubes(touch, poses, first, count, token):
    """Write the result codes of the lanes that belong to the batch."""
    for lane in range(min(len(token), count - first)):
        poses.converged[first + lane] = 0 if touch.failed[lane] > 0.0 else 1
