"""Rollouts of a layered body: one lane block from its parameters to the recorded motion."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.fem.native.layered_assembly import Factors, Samples, Work, clear
from rfdropo_bayes.fem.native.layered_step import accept, solve_increment
from rfdropo_bayes.fem.native.section_modes import LayeredTables, border_panels
from rfdropo_bayes.fem.native.simd import aligned_zeros, fill, load, store, where_greater


class Batch(NamedTuple):
    """Parameters and commands of a batch in the precision of the kernels, one row a rollout; commands may be one row
    for all."""

    moduli: Float[np.ndarray, "batch 3"]
    density: Float[np.ndarray, "batch 1"]
    damping: Float[np.ndarray, "batch 2"]
    gravity: Float[np.ndarray, "batch 3"]
    layer_scale: Float[np.ndarray, "batch layers"]
    point_mass: Float[np.ndarray, "batch stations"]
    position: Float[np.ndarray, "rows values"]  # initial, in section modes
    tension: Float[np.ndarray, "rows cables"]  # initial
    displacement: Float[np.ndarray, "rows steps cables"]


class Output(NamedTuple):
    """What a batch returns; recorded row 0 is the initial state."""

    position: Float[np.ndarray, "batch records points 3"]
    tension: Float[np.ndarray, "batch records cables"]
    diverged: Bool[np.ndarray, " batch"]
    cables_converged: Bool[np.ndarray, " batch"]


class Schedule(NamedTuple):
    """How a rollout runs."""

    time_step: float
    steps: int
    stride: int  # steps from one recorded row to the next
    tolerance: float  # relative, of the tension problem
    regularisation: float  # relative compliance of every cable


class Storage(NamedTuple):
    """Everything one lane block works on."""

    samples: Samples
    factors: Factors
    work: Work


def storage(tables: LayeredTables, lanes: int, dtype: type) -> Storage:
    """Zeroed, aligned storage of one lane block."""
    modes, stations, cables = len(tables.parity), len(tables.station_mass), len(tables.rest_length)
    size, panels, layers = 3 * modes, border_panels(cables), stations - 1

    def rows(count: int) -> np.ndarray:
        return aligned_zeros((max(count, 1), lanes), dtype)

    samples = Samples(
        moduli=rows(3),
        density=rows(1),
        layer_scale=rows(layers),
        point_mass=rows(stations),
        stiffness=rows(layers * tables.stiffness.shape[1]),
        station_mass=rows(tables.station_mass.size),
        layer_mass=rows(tables.layer_mass.size),
        gravity=rows(3),
        damping=rows(2),
    )
    work = Work(
        position=rows(stations * size),
        velocity=rows(stations * size),
        pivot=rows(stations * size * size),
        coupling=rows(stations * size * size),
        border=rows(stations * 3 * panels * size),
        condensed=rows(9 * panels * panels),
        solution=rows(stations * size),
        field=rows(stations * size),
        weight=rows(cables + 1),
        axes=rows(9),
        dyads=rows(54),
        local=rows(2 * size),
        reaction=rows(2 * size),
        slack=rows(cables),
        scale=rows(cables),
        compliance=rows(cables * cables),
        active=rows(cables),
        tension=rows(cables),
        pivoting=rows(cables * (cables + 1)),
        commanded=rows(cables),
        unsolved=rows(1),
        accepted=rows(1),
        lost=rows(1),
        failed=rows(1),
        points=rows(3 * (len(tables.point_first) - 1)),
    )
    return Storage(samples, Factors(*(rows(1) for _ in Factors._fields)), work)


@numba.njit(nogil=True, error_model="numpy")
def _fill_lanes(source, first, target):
    """Spread rows of a batch over lanes; lanes beyond the batch repeat its last row, and one row serves all."""
    for lane in range(target.shape[1]):
        row = min(first + lane, source.shape[0] - 1)
        for i in range(source.shape[1]):
            target[i, lane] = source[row, i]


@numba.njit(nogil=True, error_model="numpy")
def _prepare(tables, batch, samples, first, token):
    """Stiffness and mass of a block's rollouts."""
    _fill_lanes(batch.moduli, first, samples.moduli)
    _fill_lanes(batch.density, first, samples.density)
    _fill_lanes(batch.damping, first, samples.damping)
    _fill_lanes(batch.gravity, first, samples.gravity)
    _fill_lanes(batch.layer_scale, first, samples.layer_scale)
    _fill_lanes(batch.point_mass, first, samples.point_mass)
    layers, entries = tables.stiffness.shape[0], tables.stiffness.shape[1]
    for layer in range(layers):
        scale = load(samples.layer_scale, layer, token)
        lame, shear = scale * load(samples.moduli, 0, token), scale * load(samples.moduli, 1, token)
        condensed = scale * load(samples.moduli, 2, token)
        for e in range(entries):
            k = tables.stiffness[layer, e]
            store(samples.stiffness, layer * entries + e, lame * k[0] + shear * k[1] + condensed * k[2])
    density = load(samples.density, 0, token)
    pairs = tables.station_mass.shape[1]
    for station in range(layers + 1):
        lumped = load(samples.point_mass, station, token)
        for p in range(pairs):
            value = density * tables.station_mass[station, p] + lumped * tables.lumped[p]
            store(samples.station_mass, station * pairs + p, value)
    coupled = tables.layer_mass.shape[1]
    for layer in range(layers):
        for p in range(coupled):
            store(samples.layer_mass, layer * coupled + p, density * tables.layer_mass[layer, p])


@numba.njit(nogil=True, error_model="numpy")
def _start(batch, work, first, token):
    """The initial state, not moving."""
    _fill_lanes(batch.position, first, work.position)
    _fill_lanes(batch.tension, first, work.tension)
    clear(work.velocity, 0, work.velocity.shape[0], token)
    clear(work.solution, 0, work.solution.shape[0], token)
    clear(work.lost, 0, 1, token)
    clear(work.failed, 0, 1, token)


@numba.njit(nogil=True, error_model="numpy")
def _step_factors(samples, factors, time_step, token):
    """Factors of an implicit Euler step."""
    lookahead = time_step + load(samples.damping, 1, token)
    one = fill(1.0, samples.damping, token)
    store(factors.elasticity, 0, time_step * lookahead)
    store(factors.inertia, 0, one + time_step * load(samples.damping, 0, token))
    store(factors.force, 0, one * time_step)
    store(factors.strain_rate, 0, time_step * lookahead)
    store(factors.drag, 0, time_step * load(samples.damping, 0, token))


@numba.njit(nogil=True, error_model="numpy")
def _record(tables, work, output, first, row, token):
    """Write points and tensions of the lanes that belong to the batch."""
    points, cables = len(tables.point_first) - 1, len(tables.rest_length)
    for p in range(points):
        for i in range(3):
            total = fill(0.0, work.position, token)
            for k in range(tables.point_first[p], tables.point_first[p + 1]):
                total = total + load(work.position, tables.point_place[k] + i, token) * tables.point_weight[k]
            store(work.points, 3 * p + i, total)
    for lane in range(min(len(token), output.position.shape[0] - first)):
        for p in range(points):
            for i in range(3):
                output.position[first + lane, row, p, i] = work.points[3 * p + i, lane]
        for c in range(cables):
            output.tension[first + lane, row, c] = work.tension[c, lane]


@numba.njit(nogil=True, error_model="numpy")
def _finish(work, output, first):
    """Write the result codes of the lanes that belong to the batch."""
    for lane in range(min(work.lost.shape[1], output.position.shape[0] - first)):
        output.diverged[first + lane] = work.lost[0, lane] > 0.0
        output.cables_converged[first + lane] = not work.failed[0, lane] > 0.0


@numba.njit(nogil=True, error_model="numpy")
def _advance(tables, samples, factors, work, schedule, token):
    """One time step, and what went wrong in it."""
    solve_increment(
        tables, samples, factors, work, 1.0 / schedule.time_step, schedule.tolerance, schedule.regularisation, token
    )
    accept(tables, work, schedule.time_step, token)
    zero, one = fill(0.0, work.lost, token), fill(1.0, work.lost, token)
    store(work.lost, 0, where_greater(load(work.accepted, 0, token), zero, load(work.lost, 0, token), one))
    store(work.failed, 0, where_greater(load(work.unsolved, 0, token), zero, one, load(work.failed, 0, token)))


def compile_rollout(sources: str) -> Callable:
    """The kernel of one lane block; ``sources``, a digest of the kernels' sources, is part of the key it is cached
    under."""

    @numba.njit(nogil=True, cache=True, error_model="numpy")
    def rollout(tables, batch, storage, schedule, output, first, token):
        _ = sources
        samples, factors, work = storage
        _prepare(tables, batch, samples, first, token)
        _start(batch, work, first, token)
        _step_factors(samples, factors, schedule.time_step, token)
        _record(tables, work, output, first, 0, token)
        for step in range(schedule.steps):
            _fill_lanes(batch.displacement[:, step], first, work.commanded)
            _advance(tables, samples, factors, work, schedule, token)
            if (step + 1) % schedule.stride == 0:
                _record(tables, work, output, first, (step + 1) // schedule.stride, token)
        _finish(work, output, first)

    return rollout
