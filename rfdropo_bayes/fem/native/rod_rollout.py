"""Rollouts of a rod: one lane block, from parameters or from a state to the recorded motion."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from rfdropo_bayes.fem.integrators import EULER, Stage
from rfdropo_bayes.fem.native.chain_cholesky import BLOCK, PANEL
from rfdropo_bayes.fem.native.cube_motion import predict_cubes, record_cubes, start_cubes
from rfdropo_bayes.fem.native.fields import clear, fill_lanes, point
from rfdropo_bayes.fem.native.kernel_cache import kept, named_by
from rfdropo_bayes.fem.native.rod_assembly import measure_element
from rfdropo_bayes.fem.native.rod_constraints import constrained_stage
from rfdropo_bayes.fem.native.rod_effects import BRANCH, DECAY, EFFECTS, FLAGS, LAW, LOADED, follow_branch
from rfdropo_bayes.fem.native.rod_records import ELEMENT, Factors, RodSamples, RodWork
from rfdropo_bayes.fem.native.rod_statics import come_to_rest, go_to_rest, keep_found, measure_imbalance, put_at_rest
from rfdropo_bayes.fem.native.rod_step import predict_stations, set_factors
from rfdropo_bayes.fem.native.rod_tables import FRAME, INNER, SECTION, SIZE, RodTables
from rfdropo_bayes.fem.native.simd import addresses, aligned_zeros, any_greater, fill, fma, kernel, load, store, whole
from rfdropo_bayes.fem.native.slip_rows import kinds_present, start_slip
from rfdropo_bayes.fem.rod import SHEAR

ROW_ITERATIONS = 60
"""Most iterations of a row of quasi-static motion."""


class Batch(NamedTuple):
    """Parameters and commands of a batch in the precision of the kernels, one row a rollout; commands may be one
    row for all."""

    moduli: Float[np.ndarray, "batch 3"]
    density: Float[np.ndarray, "batch 1"]
    damping: Float[np.ndarray, "batch 2"]
    gravity: Float[np.ndarray, "batch 3"]
    scale: Float[np.ndarray, "batch elements"]
    point_mass: Float[np.ndarray, "batch stations"]
    law: Float[np.ndarray, "batch element_rows"]
    effects: Float[np.ndarray, "batch rows"]
    present: Int[np.ndarray, " flags"]
    start: Float[np.ndarray, "rows drives"]  # before the first step, of the initial equilibrium
    drive: Float[np.ndarray, "rows steps drives"]  # displacements of cables [m], pressures of chambers [Pa]
    loads: Float[np.ndarray, "rows values"]  # forces at the places, two factors and gravity, of each step
    place: Int[np.ndarray, " places"]  # stations that forces act on
    places: int
    count: int
    start_pitch: int  # from one row to the next, 0 if a single row serves all
    drive_pitch: int
    loads_pitch: int


class RodOutput(NamedTuple):
    """Output of a batch; recorded row 0 is the initial state."""

    position: Float[np.ndarray, "batch records points 3"]
    tension: Float[np.ndarray, "batch records cables"]
    diverged: UInt8[np.ndarray, " batch"]
    converged: UInt8[np.ndarray, " batch"]  # 0 if the impulses of a step, or the equilibrium of a row, were not found
    imbalance: Float[np.ndarray, " batch"]  # relative force out of balance in the initial equilibrium
    solves: Float[np.ndarray, " batch"]  # of the equilibria of all rows
    records: int


class RodSchedule(NamedTuple):
    """How a rollout runs."""

    time_step: float
    steps: int
    stride: int  # steps from one recorded row to the next
    static_iterations: int  # 0 leaves out the equilibrium
    settled: float  # relative change of the velocities that ends the iterations of a step
    softness: float  # of the cables, relative to W
    missed: float  # [m/s] velocity at which surfaces may meet that were not taken to
    at_start: float  # largest increment over the body's length, and turn [rad], of the initial equilibrium
    at_rest: float  # and of a row at rest
    count: int = 1  # stages of a step
    stages: tuple[Stage, Stage] = (EULER, EULER)  # in seconds; the first ``count`` of them
    still: int = 0  # 1 for a quasi-static motion: a step is a row at rest
    resumed: int = 0  # 1 goes on from the state in ``RodWork`` instead of starting anew


def storage(tables: RodTables, lanes: int, dtype: type) -> tuple[RodSamples, Factors, RodWork]:
    """Zeroed, aligned storage of one lane block."""
    stations, cables, panels = tables.stations, tables.cables, tables.panels
    elements, guides = stations - 1, len(tables.guide_first) - 1

    def rows(**sizes: int) -> dict[str, np.ndarray]:
        return {name: aligned_zeros((max(count, 1), lanes), dtype) for name, count in sizes.items()}

    samples = rows(
        moduli=3, density=1, scale=elements, point_mass=stations, section=SECTION * elements, inner=INNER * elements,
        gravity=3, damping=2, law=LAW * elements, effects=EFFECTS,
    )  # fmt: skip
    state = dict.fromkeys(("velocity", "solution", "field", "before", "sudden", "branch", "stress"), stations * SIZE)
    once = (
        "unsolved", "accepted", "lost", "failed", "moving", "largest", "shift", "least", "pace", "solves",
        "imbalance", "softness", "firmness", "loss",
    )  # fmt: skip
    work = rows(
        turn=4 * stations, frame=FRAME * stations, pivot=BLOCK * stations, coupling=BLOCK * stations,
        border=PANEL * panels * stations, condensed=9 * panels**2, weight=3 * panels, element=ELEMENT,
        lever=3 * len(tables.guide_station), offset=3 * guides, direction=3 * guides,
        course=guides, inverse=guides, sharp=guides, slack=tables.drives, tension=cables,
        commanded=tables.drives, points=3 * tables.points, pushed=3 * stations, given=3 * stations, **state,
        **dict.fromkeys(once, 1),
    )  # fmt: skip
    factors = Factors(**rows(**dict.fromkeys(Factors._fields, 1)))
    return RodSamples(**samples, present=np.zeros(FLAGS, dtype=np.int64)), factors, RodWork(**work)


@kernel
def _prepare(tables, samples, token):
    """Stiffness of the sections of a block's rollouts."""
    young, shear, axial = load(samples.moduli, 0, token), load(samples.moduli, 1, token), load(samples.moduli, 2, token)
    one = fill(1.0, samples.moduli, token)
    for element in range(tables.stations - 1):
        scale, e = load(samples.scale, element, token), SECTION * element
        for i in range(SECTION):
            modulus = scale * (shear if i < 2 or i == SECTION - 1 else (axial if i == 2 else young))
            store(samples.section, e + i, modulus * tables.area[e + i])
        soft, inner = SHEAR * shear / young, INNER * element
        curl = 1.0 - one / soft
        store(samples.inner, inner, curl)
        for i in range(2):
            ratio = shear / young * tables.ratio[2 * element + i]
            share = one / (one + ratio)
            store(samples.section, e + i, share * load(samples.section, e + i, token))
            share = share * share * ratio / tables.length[element]
            steep = share * (1.0 - soft)
            store(samples.inner, inner + 1 + i, fma(0.6 * ratio, share, steep))
            store(samples.inner, inner + 3 + i, 0.5 * curl * steep / tables.length[element])


@kernel
def start_rollouts(tables, batch, samples, work, first, token):
    """Parameters of a block's rollouts; at rest, without tension."""
    count, values, nothing = batch.count, SIZE * tables.stations, fill(0.0, work.frame, token)
    fill_lanes(batch.moduli, 3, 0, 3, first, count, samples.moduli, token)
    fill_lanes(batch.density, 1, 0, 1, first, count, samples.density, token)
    fill_lanes(batch.damping, 2, 0, 2, first, count, samples.damping, token)
    fill_lanes(batch.gravity, 3, 0, 3, first, count, samples.gravity, token)
    elements = tables.stations - 1
    fill_lanes(batch.scale, elements, 0, elements, first, count, samples.scale, token)
    fill_lanes(batch.point_mass, elements + 1, 0, elements + 1, first, count, samples.point_mass, token)
    fill_lanes(batch.law, LAW * elements, 0, LAW * elements, first, count, samples.law, token)
    fill_lanes(batch.effects, EFFECTS, 0, EFFECTS, first, count, samples.effects, token)
    for flag in range(FLAGS):
        samples.present[flag] = batch.present[flag]
    _prepare(tables, samples, token)
    put_at_rest(tables, nothing, work, token)
    clear(work.tension, 0, tables.cables, token)
    clear(work.velocity, 0, values, token)
    clear(work.branch, 0, values, token)
    clear(work.solution, 0, values, token)
    clear(work.lost, 0, 1, token)
    clear(work.failed, 0, 1, token)
    clear(work.imbalance, 0, 1, token)
    store(work.softness, 0, fill(1.0, work.softness, token))
    clear(work.pushed, 0, 3 * tables.stations, token)


@kernel
def take_loads(batch, samples, work, row, first, token):
    """Load the forces of a step: forces on sections, factors on stiffness and damping, and gravity."""
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
        _follow_branches(tables, samples, factors, work, token)


@kernel
def _follow_branches(tables, samples, factors, work, token):
    """Let the dashpots of all elements follow the strain."""
    for element in range(tables.stations - 1):
        measure_element(tables, samples, element, work, token)
        follow_branch(factors, element, work, token)


@kernel
def _take_commands(tables, batch, work, step, share, first, token):
    """Commands at the end of a stage: interpolated between the previous and the present step."""
    pitch, offset, drives = batch.drive_pitch, step * tables.drives, tables.drives
    if share < 1.0:
        fill_lanes(batch.drive, pitch, offset, drives, first, batch.count, work.slack, token)
        for c in range(drives):
            before = load(work.commanded, c, token)
            store(work.commanded, c, fma(load(work.slack, c, token) - before, share, before))
    else:
        fill_lanes(batch.drive, pitch, offset, drives, first, batch.count, work.commanded, token)


@kernel
def begin_stage(tables, batch, samples, factors, work, touch, schedule, step, number, first, token):
    """Factors and commands of a stage, and the position at which its forces are taken."""
    stage = schedule.stages[number]
    if number == 0:
        take_loads(batch, samples, work, step + 1, first, token)
    store(work.softness, 0, load(work.softness, 0, token) * load(samples.effects, DECAY + number, token))
    set_factors(samples, factors, work, stage, fill(1.0, work.softness, token), token)
    share = 1.0 if number + 1 == schedule.count else stage.elapsed / schedule.time_step
    _take_commands(tables, batch, work, step, share, first, token)
    if samples.present[BRANCH]:
        _follow_branches(tables, samples, factors, work, token)
    if stage.predicted:
        predict_stations(tables, stage.elapsed, work, token)
        if touch is not None:
            predict_cubes(touch, stage.elapsed, token)


@kernel
def record_body(tables, work, output, row, first, count, token):
    """Write points and tensions of the lanes that belong to the batch."""
    points, cables, lanes = tables.points, tables.cables, len(token)
    for p in range(points):
        x, y, z = point(tables.point_first, tables.point_place, tables.point_weight, p, work.frame, token)
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
        output.solves[first + lane] = work.solves[lane]


@kernel
def settle(tables, runs, batch, samples, factors, work, friction, rows, p, schedule, first, token):
    """Parameters and initial state of a block's rollouts: as given, or in equilibrium; unchanged if they continue."""
    start_rollouts(tables, batch, samples, work, first, token)
    take_loads(batch, samples, work, 0, first, token)
    fill_lanes(batch.start, batch.start_pitch, 0, tables.drives, first, batch.count, work.commanded, token)
    if schedule.static_iterations > 0:
        most, bound = schedule.static_iterations, schedule.at_start
        store(work.moving, 0, fill(1.0, work.moving, token))
        come_to_rest(tables, runs, samples, factors, work, friction, rows, p, 0, most, bound, schedule, token)
        measure_imbalance(tables, samples, factors, work, token)
        keep_found(tables, work, True, token)
    _relax_branches(tables, samples, factors, work, token)
    if runs is not None:
        start_slip(tables, runs, friction, work, token)


@kernel
def take_row(tables, runs, batch, samples, factors, work, friction, rows, p, schedule, step, first, token):
    """One row of a quasi-static motion: the equilibrium at its commands, found from the row before, or else, without
    friction, from the undeformed body. A lane without an equilibrium in an earlier row stays: its rollout failed.
    """
    slips = 0
    if runs is not None:
        slips = kinds_present(samples)[0] * runs.count
    take_loads(batch, samples, work, step + 1, first, token)
    _take_commands(tables, batch, work, step, 1.0, first, token)
    most, bound = ROW_ITERATIONS, schedule.at_rest
    store(work.moving, 0, fill(1.0, work.moving, token) - load(work.failed, 0, token))
    come_to_rest(tables, runs, samples, factors, work, friction, rows, p, slips, most, bound, schedule, token)
    if slips == 0:
        go_to_rest(tables, work, token)
        if any_greater(load(work.moving, 0, token), fill(0.0, work.moving, token)):
            come_to_rest(tables, runs, samples, factors, work, friction, rows, p, 0, most, bound, schedule, token)
    keep_found(tables, work, False, token)


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

    ``runs`` with ``friction``, and ``scene`` with ``cubes``, ``touch`` and ``poses``, are None without friction of
    cables and without a cube: the compiled kernel then lacks these parts.
    """

    @kept
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
        if not schedule.resumed:
            settle(body, rubbing, given, material, factor, state, slips, extra, p, schedule, first, token)
        if scene is not None and not schedule.resumed:
            start_cubes(around, addresses(cubes), given.count, meeting, first, token)
        shown = None if scene is None else addresses(poses)
        clear(state.solves, 0, 1, token)
        step = 0
        while begin_step(body, given, state, meeting, schedule, record, shown, step, first, token):
            if schedule.still:
                take_row(
                    body, rubbing, given, material, factor, state, slips, extra, p, schedule, step, first, token
                )  # fmt: skip
            for number in range(0 if schedule.still else schedule.count):
                begin_stage(body, given, material, factor, state, meeting, schedule, step, number, first, token)
                constrained_stage(
                    body, rubbing, around, material, factor, state, slips, meeting, extra, p, schedule, number, token
                )
            step += 1
        finish_rollouts(state, record, first, given.count, token)

    return rollout
