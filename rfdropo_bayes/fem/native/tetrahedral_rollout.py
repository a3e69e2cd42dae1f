"""Rollouts of a tetrahedral body in SIMD lanes: cables, the stages of a step, and one lane block through all steps.

In single precision the elimination loses digits that the motion of a long soft body needs. In single precision each
stage is therefore refined once. Its residual costs one pass over the elements, without tangents, and the factor is used
again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.fem.integrators import Stage
from rfdropo_bayes.fem.native.block_cholesky import (
    back_substitute,
    condense,
    condensed_entry,
    factor,
    forward_substitute,
)
from rfdropo_bayes.fem.native.cube_motion import predict_cubes, record_cubes, start_cubes
from rfdropo_bayes.fem.native.kernel_cache import kept, named_by
from rfdropo_bayes.fem.native.simd import (
    addresses,
    fill,
    fma,
    load,
    mesh_part,
    square_root,
    store,
    where_greater,
    whole,
)
from rfdropo_bayes.fem.native.tetrahedral import assemble, elastic_forces, gone_on
from rfdropo_bayes.fem.native.tetrahedral_constraints import add_forces, end_stage, hold, hold_again, meet

LARGEST = 1e12
"""[N] A tension beyond means that the rollout has diverged."""


class Cables(NamedTuple):
    """Static cable data; the points of cable c are ``first[c]:first[c + 1]``, the first of them fixed in space."""

    first: Int[np.ndarray, " cables_1"]
    node: Int[np.ndarray, "points weights"]
    weight: Float[np.ndarray, "points weights"]
    anchor: Float[np.ndarray, "cables 3"]
    rest_segment: Float[np.ndarray, " points"]  # from the previous point to this point, at rest [m]; 0 for the first
    limit: Float[np.ndarray, " cables"]  # largest displacement [m]
    rate: float  # largest change of the displacement in a step, against the displacement measured a step before [m]


class TetrahedralSchedule(NamedTuple):
    """Settings of a rollout."""

    time_step: float
    stride: int  # steps between recorded rows
    settled: float  # relative change of the velocities that ends the iterations of a step
    softness: float  # of the cables, relative to W
    reach: float  # largest distance of a node from its place at rest [m]
    refined: bool  # solve every stage twice
    count: int  # stages of a step
    stages: tuple[Stage, Stage]  # in seconds; the first ``count`` of them


class TetrahedralOutput(NamedTuple):
    """Recorded states of a lane block; the last axis is the lane."""

    node: Int[np.ndarray, "points weights"]
    weight: Float[np.ndarray, "points weights"]
    position: Float[np.ndarray, "rows points 3 lanes"]
    tension: Float[np.ndarray, "rows cables lanes"]


@mesh_part
def _point(cables, p, c, field, fixed, token):
    """Position or velocity of a cable's point; the anchor's is ``fixed``."""
    if p == cables.first[c]:
        zero = fill(0.0, field, token)
        return (
            zero + cables.anchor[c, 0] * fixed,
            zero + cables.anchor[c, 1] * fixed,
            zero + cables.anchor[c, 2] * fixed,
        )
    x, y, z = fill(0.0, field, token), fill(0.0, field, token), fill(0.0, field, token)
    for k in range(cables.node.shape[1]):
        n, w = 3 * cables.node[p, k], cables.weight[p, k]
        x = x + load(field, n, token) * w
        y = y + load(field, n + 1, token) * w
        z = z + load(field, n + 2, token) * w
    return x, y, z


@mesh_part
def _pull(pattern, mesh, cables, p, row, work, x, y, z, token):
    """Add a force on a cable's point to the cable's border row."""
    for k in range(cables.node.shape[1]):
        node, w = cables.node[p, k], cables.weight[p, k]
        if node < mesh.free and w != 0.0:
            t = 9 * (pattern.first[node + 1] - pattern.border + row // 3) + 3 * (row % 3)
            store(work.lower, t, load(work.lower, t, token) + x * w, load(work.lower, t + 1, token) + y * w)
            store(work.lower, t + 2, load(work.lower, t + 2, token) + z * w)


@mesh_part
def set_targets(cables, commanded, share, work, token):
    """Displacement that a stage imposes on every cable, a share of the way to the commanded one.

    The commanded displacement may differ from the displacement measured a step before by at most ``rate``, and never
    exceeds the limit.
    """
    one = fill(1.0, work.position, token)
    for c in range(len(cables.limit)):
        target, before, past = load(commanded, c, token), load(work.measured, c, token), load(work.commanded, c, token)
        if share < 1.0:
            target = fma(target - past, share, past)
        store(work.commanded, c, target)
        target = where_greater(target, before + cables.rate, before + cables.rate, target)
        target = where_greater(before - cables.rate, target, before - cables.rate, target)
        limit = one * cables.limit[c]
        store(work.target, c, where_greater(target, limit, limit, target))


@mesh_part
def gather_cables(pattern, mesh, cables, work, stage, token):
    """Border rows -dl/dx of all cables, and their slack [m] at the end of the stage if nothing changed the velocity."""
    one = fill(1.0, work.position, token)
    for c in range(len(cables.limit)):
        row = c + 1
        x, y, z = _point(cables, cables.first[c], c, work.position, 1.0, token)
        vx, vy, vz = _point(cables, cables.first[c], c, work.velocity, 0.0, token)
        # The sum of small differences keeps digits that the difference of the lengths would lose.
        shortening, growth = fill(0.0, work.position, token), fill(0.0, work.position, token)
        for p in range(cables.first[c] + 1, cables.first[c + 1]):
            px, py, pz = _point(cables, p, c, work.position, 1.0, token)
            wx, wy, wz = _point(cables, p, c, work.velocity, 0.0, token)
            dx, dy, dz = px - x, py - y, pz - z
            segment = square_root(fma(dx, dx, fma(dy, dy, dz * dz)))
            shortening = shortening + (cables.rest_segment[p] - segment)
            scale = one / segment
            dx, dy, dz = dx * scale, dy * scale, dz * scale
            growth = growth + (dx * (wx - vx) + dy * (wy - vy) + dz * (wz - vz))
            _pull(pattern, mesh, cables, p, row, work, -dx, -dy, -dz, token)
            if p - 1 > cables.first[c]:
                _pull(pattern, mesh, cables, p - 1, row, work, dx, dy, dz, token)
            x, y, z, vx, vy, vz = px, py, pz, wx, wy, wz
        store(work.measured, c, shortening)
        slack = shortening
        if not stage.predicted:
            slack = slack - stage.length * growth
        store(work.slack, c, slack - load(work.target, c, token))


@mesh_part
def substitute(pattern, mesh, work, token):
    """Add A^-1 times the weighted border rows to the velocity."""
    back_substitute(pattern, work.pivot, work.lower, work.weight, work.solution, token)
    for i in range(3 * mesh.free):
        store(work.velocity, i, load(work.velocity, i, token) + load(work.solution, i, token))


@mesh_part
def _keep_border(pattern, work, token):
    """Copy the border, which the factorisation overwrites, to ``load``: 9 ``border`` rows a node."""
    size = 9 * pattern.border
    for node in range(len(pattern.first) - 1):
        t = 9 * (pattern.first[node + 1] - pattern.border)
        for k in range(size):
            store(work.load, size * node + k, load(work.lower, t + k, token))


@mesh_part
def unbalance(pattern, mesh, samples, work, count, stage, token):
    """Write the residual forces of the stage to border row 0, and the remaining slack of the cables."""
    elastic_forces(mesh, samples, work, stage, token)
    time_step = stage.length * load(work.wide, 0, token)
    drag, size = load(samples.rayleigh_mass, 0, token), 9 * pattern.border
    for c in range(count):
        store(work.slack, c, load(work.measured, c, token) - load(work.target, c, token))
    for node in range(mesh.free):
        mass = load(samples.mass, node, token)
        for i in range(3):
            velocity = load(work.velocity, 3 * node + i, token)
            force = load(work.force, 3 * node + i, token) + mass * (load(samples.gravity, i, token) - drag * velocity)
            for c in range(count):
                row = load(work.load, size * node + 3 * (c + 1) + i, token)
                force = fma(row, load(work.tension, c, token), force)
                moving = velocity
                if stage.predicted:
                    moving = moving - load(work.begun, 3 * node + i, token)
                store(work.slack, c, fma(row, time_step * moving, load(work.slack, c, token)))
            right = time_step * force - mass * load(work.solution, 3 * node + i, token)
            if stage.carried > 0.0:
                right = right + gone_on(samples, work, node, i, token)
            store(work.lower, 9 * (pattern.first[node + 1] - pattern.border) + i, right)


@mesh_part
def _moved(work, i, stage, token):
    """Displacement of a coordinate in a stage."""
    length = stage.length * load(work.wide, 0, token)
    if stage.predicted:
        return length * (load(work.velocity, i, token) - load(work.begun, i, token))
    return length * load(work.velocity, i, token)


@mesh_part
def accept(rest, count, work, schedule, stage, token):
    """Take the stage; failed lanes stay in place, at rest without tension."""
    one, zero = fill(1.0, work.position, token), fill(0.0, work.position, token)
    accepted, reach = one, fill(schedule.reach, work.position, token)
    for i in range(work.solution.shape[0]):
        away = load(work.position, i, token) + _moved(work, i, stage, token) - rest[i]
        accepted = where_greater(reach, where_greater(away, zero, away, -away), accepted, zero)
    for c in range(count):
        accepted = where_greater(zero + LARGEST, load(work.tension, c, token), accepted, zero)
    for i in range(work.solution.shape[0]):
        x, v, moved = load(work.position, i, token), load(work.velocity, i, token), _moved(work, i, stage, token)
        begun = load(work.begun, i, token)
        store(work.before, i, where_greater(accepted, zero, v - begun, zero))
        store(work.velocity, i, where_greater(accepted, zero, v, zero))
        stayed = x - stage.elapsed * begun if stage.predicted else x
        store(work.position, i, where_greater(accepted, zero, x + moved, stayed))
    for c in range(count):
        store(work.tension, c, where_greater(accepted, zero, load(work.tension, c, token), zero))
    store(work.accepted, 0, accepted)
    store(work.lost, 0, where_greater(accepted, zero, load(work.lost, 0, token), one))


@mesh_part
def begin_stage(work, stage, token):
    """Position at which a stage takes its forces."""
    one = fill(1.0, work.wide, token)
    store(work.wide, 0, one)
    store(work.narrow, 0, one)
    store(work.going, 0, stage.carried * one)
    for i in range(work.begun.shape[0]):
        velocity = load(work.velocity, i, token)
        store(work.begun, i, velocity)
        if stage.predicted:
            store(work.position, i, load(work.position, i, token) + stage.elapsed * velocity)


@mesh_part
def condense_stage(pattern, mesh, cables, samples, work, schedule, stage, token):
    """Assemble and factorise the matrix of a stage, and set up the problem of its tensions."""
    count, rows = len(cables.limit), 3 * pattern.border
    assemble(pattern, mesh, samples, work, stage, token)
    gather_cables(pattern, mesh, cables, work, stage, token)
    if schedule.refined:
        _keep_border(pattern, work, token)
    factor(pattern, work.pivot, work.lower, token)
    condense(pattern, work.lower, work.condensed, token)
    for i in range(count):
        free = load(work.slack, i, token) * (1.0 / stage.length) * load(work.narrow, 0, token)
        store(work.slack, i, free + load(work.condensed, (i + 1) * rows, token))


@mesh_part
def record_body(work, output, row, token):
    for p in range(output.node.shape[0]):
        for i in range(3):
            total = fill(0.0, work.position, token)
            for k in range(output.node.shape[1]):
                total = total + load(work.position, 3 * output.node[p, k] + i, token) * output.weight[p, k]
            store(output.position[row, p], i, total)
    for c in range(output.tension.shape[1]):
        store(output.tension[row], c, load(work.tension, c, token))


def compile_rollout(sources: str) -> Callable:
    """The kernel of one lane block; ``sources``, a digest of the kernels' sources, names its cache.

    It steps through ``commands`` (steps, cables, lanes) and records after every ``schedule.stride`` steps; ``rest`` are
    the nodes' coordinates at rest. ``scene``, ``cubes``, ``touch`` and ``poses`` are None without a cube.
    """

    @kept
    @whole
    @named_by(sources)
    def rollout(
        pattern, mesh, cables, scene, rest, commands, cubes, samples, work, touch, rows, problem, reached, schedule,
        output, poses, first, count, token,
    ):  # fmt: skip
        bare, bare_pattern, bare_samples = addresses(work), addresses(pattern), addresses(samples)
        extra, p, contacts = addresses(rows), addresses(problem), 0
        around = None if scene is None else addresses(scene)
        meeting = None if scene is None else addresses(touch)
        drives, records = len(cables.limit), 1 + commands.shape[0] // schedule.stride
        if scene is not None:
            start_cubes(around, addresses(cubes), count, meeting, first, token)
            record_cubes(meeting, addresses(poses), records, 0, first, count, token)
        for step in range(commands.shape[0]):
            for number in range(schedule.count):
                stage, last = schedule.stages[number], number + 1 == schedule.count
                share = 1.0 if last else stage.elapsed / schedule.time_step
                begin_stage(work, stage, token)
                if scene is not None:
                    if stage.predicted:
                        predict_cubes(meeting, stage.elapsed, token)
                    meet(around, bare_samples, meeting, bare, stage, token)
                set_targets(cables, commands[step], share, work, token)
                condense_stage(pattern, mesh, cables, samples, work, schedule, stage, token)
                contacts = hold(
                    bare_pattern, around, bare_samples, meeting, bare, extra, p, reached, drives, mesh.free, stage,
                    schedule, token,
                )  # fmt: skip
                substitute(pattern, mesh, work, token)
                if schedule.refined:
                    unbalance(pattern, mesh, samples, work, drives, stage, token)
                    if scene is not None:
                        add_forces(bare_pattern, around, meeting, bare, p, drives, contacts, mesh.free, token)
                    forward_substitute(pattern, work.pivot, work.lower, token)
                    for i in range(drives):
                        free = load(work.slack, i, token) * (1.0 / stage.length) * load(work.narrow, 0, token)
                        store(work.slack, i, free + condensed_entry(pattern, work.lower, i + 1, 0, token))
                    hold_again(
                        bare_pattern, around, meeting, bare, extra, p, reached, drives, contacts, mesh.free, stage,
                        schedule, token,
                    )  # fmt: skip
                    substitute(pattern, mesh, work, token)
                accept(rest, drives, work, schedule, stage, token)
                if scene is not None:
                    later = 0.0 if last else schedule.stages[number + 1].carried
                    end_stage(around, meeting, bare, p, drives, contacts, mesh.free, schedule, stage, later, token)
            if (step + 1) % schedule.stride == 0:
                row = (step + 1) // schedule.stride
                record_body(work, output, row - 1, token)
                if scene is not None:
                    record_cubes(meeting, addresses(poses), records, row, first, count, token)

    return rollout
