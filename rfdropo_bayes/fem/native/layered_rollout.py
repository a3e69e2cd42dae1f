"""Rollouts of a layered body: one lane block from its parameters to the recorded motion, or on from where it stands."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from rfdropo_bayes.fem.integrators import EULER, Stage
from rfdropo_bayes.fem.native.cube_motion import predict_cubes, record_cubes, start_cubes
from rfdropo_bayes.fem.native.fields import clear, fill_lanes, point
from rfdropo_bayes.fem.native.kernel_cache import named_by
from rfdropo_bayes.fem.native.layered_assembly import follow_branch, layer_frame
from rfdropo_bayes.fem.native.layered_constraints import constrained_stage
from rfdropo_bayes.fem.native.layered_effects import BRANCH, DECAY, EFFECTS, FLAGS, LAW, LOADED
from rfdropo_bayes.fem.native.layered_records import Factors, LayeredSamples, LayeredWork
from rfdropo_bayes.fem.native.layered_statics import finish_settling, start_settling, take_increment
from rfdropo_bayes.fem.native.layered_step import set_factors, solve_statics
from rfdropo_bayes.fem.native.section_modes import LayeredTables, border_panels
from rfdropo_bayes.fem.native.simd import addresses, aligned_zeros, fill, fma, kernel, load, store, whole
from rfdropo_bayes.fem.native.slip_rows import start_slip


class Batch(NamedTuple):
    """Parameters and commands of a batch in the precision of the kernels, one row a rollout; commands may be one
    row for all."""

    moduli: Float[np.ndarray, "batch 3"]
    density: Float[np.ndarray, "batch 1"]
    damping: Float[np.ndarray, "batch 2"]
    gravity: Float[np.ndarray, "batch 3"]
    layer_scale: Float[np.ndarray, "batch layers"]
    point_mass: Float[np.ndarray, "batch stations"]
    law: Float[np.ndarray, "batch layer_rows"]
    effects: Float[np.ndarray, "batch rows"]
    present: Int[np.ndarray, " flags"]
    start: Float[np.ndarray, "rows cables"]  # displacements before the first step, those of the initial equilibrium
    displacement: Float[np.ndarray, "rows steps cables"]
    loads: Float[np.ndarray, "rows values"]  # forces at the places, two factors and gravity, of each step
    place: Int[np.ndarray, " places"]  # stations that forces act on
    places: int
    count: int
    start_pitch: int  # from one row to the next, 0 where one serves all
    displacement_pitch: int
    loads_pitch: int


class LayeredOutput(NamedTuple):
    """What a batch returns; recorded row 0 is the initial state."""

    position: Float[np.ndarray, "batch records points 3"]
    tension: Float[np.ndarray, "batch records cables"]
    diverged: UInt8[np.ndarray, " batch"]
    converged: UInt8[np.ndarray, " batch"]  # 0 where the impulses of a step were not found
    imbalance: Float[np.ndarray, " batch"]  # relative force out of balance in the initial equilibrium
    records: int


class LayeredSchedule(NamedTuple):
    """How a rollout runs."""

    time_step: float
    steps: int
    stride: int  # steps from one recorded row to the next
    static_iterations: int  # 0 leaves out the equilibrium
    settled: float  # relative change of the velocities that ends the iterations of a step
    softness: float  # of the cables, relative to W
    missed: float  # [m/s] velocity at which surfaces may meet that were not taken to
    refinements: int  # of every stage's linear solution
    count: int = 1  # stages of a step
    stages: tuple[Stage, Stage] = (EULER, EULER)  # in seconds; the first ``count`` of them
    resumed: int = 0  # 1 goes on from the state in ``LayeredWork`` instead of starting anew


def storage(tables: LayeredTables, lanes: int, dtype: type) -> tuple[LayeredSamples, Factors, LayeredWork]:
    """Zeroed, aligned storage of one lane block."""
    modes, stations, cables = tables.modes, tables.stations, tables.cables
    size, panels, layers = 3 * modes, border_panels(cables), stations - 1

    def rows(**sizes: int) -> dict[str, np.ndarray]:
        return {name: aligned_zeros((max(count, 1), lanes), dtype) for name, count in sizes.items()}

    values, section = stations * size, 2 * size
    web = 2 * modes // 3 + 1  # panels of the modes of a layer and of a lever
    samples = rows(
        moduli=3, density=1, layer_scale=layers, point_mass=stations, stiffness=layers * tables.entries,
        station_mass=tables.station_mass.size, layer_mass=tables.layer_mass.size, gravity=3, damping=2,
        law=LAW * layers, effects=EFFECTS,
    )  # fmt: skip
    work = rows(
        position=values, velocity=values, pivot=values * size, coupling=values * size, border=3 * panels * values,
        condensed=9 * panels * panels, solution=values, field=values, correction=values, weight=3 * panels,
        axes=9 * layers, dyads=54, local=section, reaction=section, pull=3 * (len(tables.guide_first) - 1),
        slack=cables, tension=cables, commanded=cables, points=3 * tables.points, before=values, sudden=values,
        beyond=3 * layers, held=layers, string=2 * layers * cables, ways=3 * web * cables,
        pulled=3 * web * cables, web=9 * web**2, branch=layers * section, slope=6 * layers,
        around=3 * stations, unsolved=1, accepted=1, lost=1, failed=1, relaxation=1, imbalance=1, softness=1,
        firmness=1, loss=1, pushed=3 * stations, given=max(3 * stations, 3),
    )  # fmt: skip
    factors = Factors(**rows(**dict.fromkeys(Factors._fields, 1)))
    return LayeredSamples(**samples, present=np.zeros(FLAGS, dtype=np.int64)), factors, LayeredWork(**work)


@kernel
def _prepare(tables, samples, token):
    """Stiffness and mass of a block's rollouts."""
    for layer in range(tables.stations - 1):
        scale = load(samples.layer_scale, layer, token)
        lame, shear = scale * load(samples.moduli, 0, token), scale * load(samples.moduli, 1, token)
        condensed = scale * load(samples.moduli, 2, token)
        for e in range(layer * tables.entries, (layer + 1) * tables.entries):
            value = shear * tables.stiffness[3 * e + 1]
            value = fma(lame, fill(tables.stiffness[3 * e], lame, token), value)
            store(samples.stiffness, e, fma(condensed, fill(tables.stiffness[3 * e + 2], lame, token), value))
    density = load(samples.density, 0, token)
    for station in range(tables.stations):
        lumped = load(samples.point_mass, station, token)
        for p in range(tables.pairs):
            value = density * tables.station_mass[station * tables.pairs + p]
            value = fma(lumped, fill(tables.lumped[p], lumped, token), value)
            store(samples.station_mass, station * tables.pairs + p, value)
    for p in range((tables.stations - 1) * tables.coupled):
        store(samples.layer_mass, p, density * tables.layer_mass[p])


@kernel
def start_rollouts(tables, batch, samples, work, first, token):
    """Parameters of a block's rollouts; at rest, without tension."""
    count, values = batch.count, 3 * tables.modes * tables.stations
    fill_lanes(batch.moduli, 3, 0, 3, first, count, samples.moduli, token)
    fill_lanes(batch.density, 1, 0, 1, first, count, samples.density, token)
    fill_lanes(batch.damping, 2, 0, 2, first, count, samples.damping, token)
    fill_lanes(batch.gravity, 3, 0, 3, first, count, samples.gravity, token)
    layers = tables.stations - 1
    fill_lanes(batch.layer_scale, layers, 0, layers, first, count, samples.layer_scale, token)
    fill_lanes(batch.point_mass, layers + 1, 0, layers + 1, first, count, samples.point_mass, token)
    fill_lanes(batch.law, LAW * layers, 0, LAW * layers, first, count, samples.law, token)
    fill_lanes(batch.effects, EFFECTS, 0, EFFECTS, first, count, samples.effects, token)
    for flag in range(FLAGS):
        samples.present[flag] = batch.present[flag]
    _prepare(tables, samples, token)
    for row in range(values):
        store(work.position, row, fill(tables.rest[row], work.position, token))
    clear(work.tension, 0, tables.cables, token)
    clear(work.velocity, 0, values, token)
    clear(work.branch, 0, 6 * tables.modes * layers, token)
    clear(work.solution, 0, values, token)
    clear(work.lost, 0, 1, token)
    clear(work.failed, 0, 1, token)
    clear(work.imbalance, 0, 1, token)
    store(work.softness, 0, fill(1.0, work.softness, token))
    clear(work.pushed, 0, 3 * tables.stations, token)


@kernel
def take_loads(batch, samples, work, row, first, token):
    """What acts on the body in a step: forces on sections, factors on stiffness and damping, and gravity."""
    if samples.present[LOADED]:
        pitch, count, forces = batch.loads_pitch, batch.count, 3 * batch.places
        at = row * (forces + 5)
        fill_lanes(batch.loads, pitch, at, forces, first, count, work.given, token)
        for p in range(batch.places):
            for i in range(3):
                store(work.pushed, 3 * batch.place[p] + i, load(work.given, 3 * p + i, token))
        fill_lanes(batch.loads, pitch, at + forces, 1, first, count, work.firmness, token)
        fill_lanes(batch.loads, pitch, at + forces + 1, 1, first, count, work.loss, token)
        fill_lanes(batch.loads, pitch, at + forces + 2, 3, first, count, work.given, token)
        fill_lanes(batch.gravity, 3, 0, 3, first, count, samples.gravity, token)
        for i in range(3):
            store(samples.gravity, i, load(samples.gravity, i, token) + load(work.given, i, token))
    else:
        store(work.firmness, 0, fill(1.0, work.firmness, token))
        store(work.loss, 0, fill(1.0, work.loss, token))


@kernel
def _relax_branches(tables, samples, factors, work, token):
    """Let the dashpots of the Prony branches follow all the strain of the initial shape."""
    if samples.present[BRANCH]:
        store(factors.share, 0, fill(1.0, factors.share, token))
        _follow_branches(tables, factors, work, token)


@kernel
def _follow_branches(tables, factors, work, token):
    """Let the dashpots of all layers follow the strain."""
    for layer in range(tables.stations - 1):
        layer_frame(tables, layer, work, token)
        follow_branch(tables, factors, layer, work, token)


@kernel
def _take_commands(tables, batch, work, step, share, first, token):
    """Commands at the end of a stage: a share of the way from those before to those of the step."""
    pitch, offset, cables = batch.displacement_pitch, step * tables.cables, tables.cables
    if share < 1.0:
        fill_lanes(batch.displacement, pitch, offset, cables, first, batch.count, work.slack, token)
        for c in range(cables):
            before = load(work.commanded, c, token)
            store(work.commanded, c, fma(load(work.slack, c, token) - before, share, before))
    else:
        fill_lanes(batch.displacement, pitch, offset, cables, first, batch.count, work.commanded, token)


@kernel
def begin_stage(tables, batch, samples, factors, work, touch, schedule, step, number, first, token):
    """Factors and commands of a stage, and the place where its forces are taken."""
    stage = schedule.stages[number]
    if number == 0:
        take_loads(batch, samples, work, step + 1, first, token)
    store(work.softness, 0, load(work.softness, 0, token) * load(samples.effects, DECAY + number, token))
    set_factors(samples, factors, work, stage, fill(1.0, work.softness, token), token)
    share = 1.0 if number + 1 == schedule.count else stage.elapsed / schedule.time_step
    _take_commands(tables, batch, work, step, share, first, token)
    if samples.present[BRANCH]:
        _follow_branches(tables, factors, work, token)
    if stage.predicted:
        for row in range(3 * tables.modes * tables.stations):
            ahead = fma(load(work.velocity, row, token), stage.elapsed, load(work.position, row, token))
            store(work.position, row, ahead)
        if touch is not None:
            predict_cubes(touch, stage.elapsed, token)


@kernel
def record_body(tables, work, output, row, first, count, token):
    """Write points and tensions of the lanes that belong to the batch."""
    points, cables, lanes = tables.points, tables.cables, len(token)
    for p in range(points):
        x, y, z = point(tables.point_first, tables.point_place, tables.point_weight, p, work.position, token)
        store(work.points, 3 * p, x, y, z)
    for lane in range(min(lanes, count - first)):
        at = (first + lane) * output.records + row
        for k in range(3 * points):
            output.position[at * 3 * points + k] = work.points[k * lanes + lane]
        for c in range(cables):
            output.tension[at * cables + c] = work.tension[c * lanes + lane]


@kernel
def finish_rollouts(work, output, first, count, token):
    """Write the result codes of the lanes that belong to the batch."""
    for lane in range(min(len(token), count - first)):
        output.diverged[first + lane] = 1 if work.lost[lane] > 0.0 else 0
        output.converged[first + lane] = 0 if work.failed[lane] > 0.0 else 1
        output.imbalance[first + lane] = work.imbalance[lane]


@kernel
def settle(tables, batch, samples, factors, work, p, schedule, first, token):
    """Parameters and initial state of a block's rollouts: as given, or in equilibrium; none where they go on."""
    if schedule.resumed:
        return
    start_rollouts(tables, batch, samples, work, first, token)
    take_loads(batch, samples, work, 0, first, token)
    fill_lanes(batch.start, batch.start_pitch, 0, tables.cables, first, batch.count, work.commanded, token)
    if schedule.static_iterations > 0:
        start_settling(tables, samples, factors, work, token)
        for _ in range(schedule.static_iterations):
            solve_statics(tables, samples, factors, work, p, schedule, token)
            take_increment(tables, work, token)
        finish_settling(tables, samples, factors, work, token)
    _relax_branches(tables, samples, factors, work, token)


@kernel
def begin_step(tables, batch, work, touch, schedule, output, poses, step, first, token):
    """Record the state that a step starts from; returns False after the last step."""
    if step % schedule.stride == 0:
        record_body(tables, work, output, step // schedule.stride, first, batch.count, token)
        if touch is not None:
            record_cubes(touch, poses, output.records, step // schedule.stride, first, batch.count, token)
    return step < schedule.steps


def compile_rollout(sources: str) -> Callable:
    """The kernel of one lane block; ``sources``, a digest of the kernels' sources, names its cache.

    ``runs`` with ``friction``, and ``scene`` with ``cubes``, ``touch`` and ``poses``, are None where cables do not rub
    and where there is no cube: what is None is no part of the kernel that is compiled.
    """

    @whole
    @named_by(sources)
    def rollout(
        tables, runs, scene, batch, cubes, samples, factors, work, friction, touch, rows, problem, schedule, output,
        poses, first, token,
    ):  # fmt: skip
        body, given, record = addresses(tables), addresses(batch), addresses(output)
        material, factor, state = addresses(samples), addresses(factors), addresses(work)
        extra, p = addresses(rows), addresses(problem)
        rubbing = None if runs is None else addresses(runs)
        slips = None if runs is None else addresses(friction)
        around = None if scene is None else addresses(scene)
        meeting = None if scene is None else addresses(touch)
        settle(body, given, material, factor, state, p, schedule, first, token)
        if runs is not None and not schedule.resumed:
            start_slip(body, rubbing, slips, state, token)
        if scene is not None and not schedule.resumed:
            start_cubes(around, addresses(cubes), given.count, meeting, first, token)
        shown = None if scene is None else addresses(poses)
        step = 0
        while begin_step(body, given, state, meeting, schedule, record, shown, step, first, token):
            for number in range(schedule.count):
                begin_stage(body, given, material, factor, state, meeting, schedule, step, number, first, token)
                constrained_stage(
                    body, rubbing, around, material, factor, state, slips, meeting, extra, p, schedule, number, token
                )
            step += 1
        finish_rollouts(state, record, first, given.count, token)

    return rollout
