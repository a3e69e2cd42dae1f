"""What one lane block of layered bodies works on: its parameters, the factors of a solve, its state, scratch, and the
friction of its cables."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.fem.cable_friction import run_members
from rfdropo_bayes.fem.cables import CableLayout
from rfdropo_bayes.fem.native.simd import aligned_zeros

KINDS = 2
"""Coulomb's friction and the capstan's."""


class LayeredSamples(NamedTuple):
    """Rollout parameters of one lane block; the last axis is the lane."""

    moduli: Float[np.ndarray, "3 lanes"]  # [Pa], see ``layer_moduli``
    density: Float[np.ndarray, "1 lanes"]
    layer_scale: Float[np.ndarray, "layers lanes"]
    point_mass: Float[np.ndarray, "stations lanes"]
    stiffness: Float[np.ndarray, "layer_entries lanes"]
    station_mass: Float[np.ndarray, "station_pairs lanes"]
    layer_mass: Float[np.ndarray, "layer_coupled lanes"]
    gravity: Float[np.ndarray, "3 lanes"]
    damping: Float[np.ndarray, "2 lanes"]  # Rayleigh, of mass and of stiffness
    law: Float[np.ndarray, "layer_rows lanes"]
    effects: Float[np.ndarray, "rows lanes"]
    present: Int[np.ndarray, " flags"]  # which effects the batch has; the same for all lanes


class Factors(NamedTuple):
    """What makes a solve a time step or a static iteration; (1, lanes) each."""

    elasticity: Float[np.ndarray, "1 lanes"]  # of K in the matrix
    inertia: Float[np.ndarray, "1 lanes"]  # of M in the matrix
    force: Float[np.ndarray, "1 lanes"]  # of the weight and of the surroundings in the right-hand side
    strain: Float[np.ndarray, "1 lanes"]  # of the elastic force there
    strain_rate: Float[np.ndarray, "1 lanes"]  # of -K v there
    drag: Float[np.ndarray, "1 lanes"]  # of -M v there
    fluid: Float[np.ndarray, "1 lanes"]  # of the fluid's drag, there and in the matrix
    branch: Float[np.ndarray, "1 lanes"]  # of the elastic force of the Prony branch
    share: Float[np.ndarray, "1 lanes"]  # of its strain that its dashpot follows
    give: Float[np.ndarray, "1 lanes"]  # of a cable's length per impulse, over the time step
    wide: Float[np.ndarray, "1 lanes"]  # length of the stage for its impacts, in that of the others
    narrow: Float[np.ndarray, "1 lanes"]  # its inverse
    going: Float[np.ndarray, "1 lanes"]  # share of the change of velocity in the stage before that is carried on


class LayeredWork(NamedTuple):
    """State and scratch of one lane block; the last axis is the lane."""

    position: Float[np.ndarray, "values lanes"]
    velocity: Float[np.ndarray, "values lanes"]
    pivot: Float[np.ndarray, "station_block lanes"]
    coupling: Float[np.ndarray, "station_block lanes"]
    border: Float[np.ndarray, "station_frame lanes"]
    condensed: Float[np.ndarray, "frame2 lanes"]
    solution: Float[np.ndarray, "values lanes"]
    field: Float[np.ndarray, "values lanes"]  # right-hand side without cables
    correction: Float[np.ndarray, "values lanes"]
    weight: Float[np.ndarray, "rows lanes"]
    axes: Float[np.ndarray, "layers9 lanes"]  # frame of every layer, row-major
    dyads: Float[np.ndarray, "54 lanes"]  # products of its columns
    local: Float[np.ndarray, "layer_values lanes"]
    reaction: Float[np.ndarray, "layer_values lanes"]
    pull: Float[np.ndarray, "guides3 lanes"]  # of a cable with unit tension on the body
    slack: Float[np.ndarray, "cables lanes"]
    tension: Float[np.ndarray, "cables lanes"]
    commanded: Float[np.ndarray, "cables lanes"]
    unsolved: Float[np.ndarray, "1 lanes"]  # 1 where the impulses of the last step were not found
    accepted: Float[np.ndarray, "1 lanes"]  # 1 where the last step was taken
    lost: Float[np.ndarray, "1 lanes"]  # 1 once a step was not taken
    failed: Float[np.ndarray, "1 lanes"]  # 1 once impulses were not found
    points: Float[np.ndarray, "point_values lanes"]
    before: Float[np.ndarray, "values lanes"]  # the increment of the stage or static iteration before
    sudden: Float[np.ndarray, "values lanes"]  # impulses of contacts that began in the stage before
    relaxation: Float[np.ndarray, "1 lanes"]
    beyond: Float[np.ndarray, "layers3 lanes"]  # force of the cables on the stations beyond each layer
    imbalance: Float[np.ndarray, "1 lanes"]
    held: Float[
        np.ndarray, "layers lanes"
    ]  # of layers in tension against lateral motion, in the matrix; first their force
    string: Float[np.ndarray, "layers_cables_2 lanes"]  # spring of every cable, in the matrix, and its lever [m]
    ways: Float[np.ndarray, "panel_cables lanes"]  # of the strings of a layer; panels as in ``chain_cholesky``
    pulled: Float[np.ndarray, "panel_cables lanes"]  # these times minus their springs
    web: Float[np.ndarray, "tiles lanes"]  # sums over the strings of a layer
    softness: Float[np.ndarray, "1 lanes"]  # what time has left of the moduli
    firmness: Float[np.ndarray, "1 lanes"]  # factor on the stiffness in a step, and on the damping
    loss: Float[np.ndarray, "1 lanes"]
    pushed: Float[np.ndarray, "stations3 lanes"]  # forces on the sections in a step [N]
    given: Float[np.ndarray, "stations3 lanes"]
    branch: Float[np.ndarray, "layer_values lanes"]  # strain of the dashpots, as displacements
    slope: Float[np.ndarray, "layers6 lanes"]  # derivatives of the bending law's moments
    around: Float[np.ndarray, "stations3 lanes"]  # wall and fluid in the matrix


class Runs(NamedTuple):
    """Runs of neighbouring guides that slide as one, the same for every kind of friction; guides count over all
    cables, as in ``section_modes.LayeredTables``."""

    cable: Int[np.ndarray, " runs"]
    first: Int[np.ndarray, " runs"]  # guide of the run
    last: Int[np.ndarray, " runs"]  # guide after it
    count: int
    guides: int


class Friction(NamedTuple):
    """Friction of one lane block; rows are the runs of every kind that is present, one kind after the other."""

    mobilised: Float[np.ndarray, "rows lanes"]  # share of the friction, at the start of the step
    segment: Float[np.ndarray, "guides lanes"]  # tension in front of every guide [N]
    direction: Float[np.ndarray, "guides3 lanes"]  # from the point before to a guide
    weight: Float[np.ndarray, "kinds_guides lanes"]  # friction of every guide per coefficient [N]
    whole: Float[np.ndarray, "rows lanes"]  # its sum over a run
    strength: Float[np.ndarray, "rows lanes"]  # impulse [N s] if all of it is mobilised
    lost: Float[np.ndarray, "guides lanes"]  # impulse that a cable has lost before and at a guide


def runs_of(layout: CableLayout) -> Runs:
    """Runs of cables; those without a guide are left out."""
    first_guide = np.concatenate([[0], np.cumsum(layout.guide_used.sum(axis=1))])
    runs = [
        (cable, first_guide[cable] + guides[0], first_guide[cable] + guides[-1] + 1)
        for cable, members in enumerate(run_members(layout))
        for guides in map(np.flatnonzero, members)
        if len(guides)
    ]
    cable, first, last = np.array(runs, dtype=np.int64).reshape(-1, 3).T.copy()
    return Runs(cable, first, last, len(runs), int(first_guide[-1]))


def friction_storage(runs: Runs, lanes: int, dtype: type) -> Friction:
    """Zeroed, aligned storage of one lane block."""
    rows = KINDS * runs.count
    sizes = {
        "mobilised": rows, "segment": runs.guides, "direction": 3 * runs.guides, "weight": KINDS * runs.guides,
        "whole": rows, "strength": rows, "lost": runs.guides,
    }  # fmt: skip
    return Friction(**{name: aligned_zeros((max(size, 1), lanes), dtype) for name, size in sizes.items()})
