"""Data of a lane block of rods: its parameters, the factors of a solve, its state, scratch, and the friction of its
cables.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.fem.cable_friction import run_members
from rfdropo_bayes.fem.cables import CableLayout
from rfdropo_bayes.fem.native.simd import aligned_zeros

KINDS = 2
"""Coulomb's friction and the capstan's."""
DIRECTOR, TILTED, CHORD, GRADIENT, BOW, LEAN, STRAIN, RATE, STRESS, SLOPE, FIRM, HELD = (
    0,
    9,
    18,
    21,
    24,
    27,
    30,
    36,
    43,
    49,
    58,
    64,
)
"""First rows of an element's scratch: directors in its middle, these times W, chord, g, b, derivatives of the
stretch by the middle section's strains, strains, their rates and the stresses; the section's tangent, of shear
twice, stretch, and bending and twist as 00, 01, 02, 11, 12, 22; and the last six without the law of fibres; and how
taut cables hold it in space: its force by stretch and shear (lower half, by columns), that by bending and twist
(columns), and the moment by these (lower half); and the force and moment of the section and of these cables in
space."""
ALONG = RATE + 6
NET = HELD + 21
ELEMENT = NET + 6


class RodSamples(NamedTuple):
    """Rollout parameters of one lane block; the last axis is the lane."""

    moduli: Float[np.ndarray, "3 lanes"]  # of Young, of shear, and of Young in tension [Pa]
    density: Float[np.ndarray, "1 lanes"]
    scale: Float[np.ndarray, "elements lanes"]  # of the stiffness
    point_mass: Float[np.ndarray, "stations lanes"]
    section: Float[np.ndarray, "elements6 lanes"]  # stiffness over length, see ``rod_tables.SECTION``
    inner: Float[np.ndarray, "elements5 lanes"]  # see ``rod_tables.INNER``
    gravity: Float[np.ndarray, "3 lanes"]
    damping: Float[np.ndarray, "2 lanes"]  # Rayleigh, of mass and of stiffness
    law: Float[np.ndarray, "element_rows lanes"]
    effects: Float[np.ndarray, "rows lanes"]
    present: Int[np.ndarray, " flags"]  # which effects the batch has; the same for all lanes


class Factors(NamedTuple):
    """Factors that make a solve a time step or a static iteration; (1, lanes) each."""

    elasticity: Float[np.ndarray, "1 lanes"]  # of K in the matrix
    held: Float[np.ndarray, "1 lanes"]  # of the stiffness of taut cables
    inertia: Float[np.ndarray, "1 lanes"]  # of M in the matrix
    force: Float[np.ndarray, "1 lanes"]  # of weight, surroundings and gyroscopic moments in the right-hand side
    strain: Float[np.ndarray, "1 lanes"]  # of the elastic force there
    strain_rate: Float[np.ndarray, "1 lanes"]  # of -K v there
    drag: Float[np.ndarray, "1 lanes"]  # of -M v there
    branch: Float[np.ndarray, "1 lanes"]  # of the elastic force of the Prony branch
    share: Float[np.ndarray, "1 lanes"]  # of its strain that its dashpot follows
    give: Float[np.ndarray, "1 lanes"]  # of a cable's length per impulse, over the time step
    wide: Float[np.ndarray, "1 lanes"]  # length of the stage for its impacts, in units of the other stage's
    narrow: Float[np.ndarray, "1 lanes"]  # its inverse
    going: Float[np.ndarray, "1 lanes"]  # share of the change of velocity in the stage before that is carried on


class RodWork(NamedTuple):
    """State and scratch of one lane block; the last axis is the lane. Values are the six velocities of every station,
    or quantities of the same layout.
    """

    turn: Float[np.ndarray, "stations4 lanes"]  # unit quaternion (w, x, y, z) of every section
    frame: Float[np.ndarray, "stations12 lanes"]  # position and directors
    velocity: Float[np.ndarray, "values lanes"]
    pivot: Float[np.ndarray, "station_block lanes"]
    coupling: Float[np.ndarray, "station_block lanes"]
    border: Float[np.ndarray, "station_panels lanes"]
    condensed: Float[np.ndarray, "panels2 lanes"]
    solution: Float[np.ndarray, "values lanes"]
    field: Float[np.ndarray, "values lanes"]  # right-hand side without cables
    weight: Float[np.ndarray, "rows lanes"]
    element: Float[np.ndarray, "rows lanes"]  # scratch of an element
    lever: Float[np.ndarray, "guide_entries3 lanes"]  # arms of the guides in space [m]
    offset: Float[np.ndarray, "guides3 lanes"]  # sums of these
    direction: Float[np.ndarray, "guides3 lanes"]  # derivative of the way to a guide by its place
    course: Float[np.ndarray, "guides lanes"]  # length of the way [m]
    inverse: Float[np.ndarray, "guides lanes"]  # its second derivative is inverse - sharp * direction direction' [1/m]
    sharp: Float[np.ndarray, "guides lanes"]
    slack: Float[np.ndarray, "drives lanes"]  # of the cables
    tension: Float[np.ndarray, "cables lanes"]
    commanded: Float[np.ndarray, "drives lanes"]
    unsolved: Float[np.ndarray, "1 lanes"]  # 1 if the impulses of the last step were not found
    accepted: Float[np.ndarray, "1 lanes"]  # 1 if the last step was accepted
    lost: Float[np.ndarray, "1 lanes"]  # 1 once a step was not taken
    failed: Float[np.ndarray, "1 lanes"]  # 1 once impulses, or an equilibrium, were not found
    points: Float[np.ndarray, "point_values lanes"]
    before: Float[np.ndarray, "values lanes"]  # the change of velocity in the stage before, or a static increment
    sudden: Float[np.ndarray, "values lanes"]  # impulses of contacts that began in the stage before
    moving: Float[np.ndarray, "1 lanes"]  # 1 in the lanes that have not come to rest
    largest: Float[np.ndarray, "1 lanes"]  # increment of the static iteration before [m]
    shift: Float[np.ndarray, "1 lanes"]  # share of M in the matrix of an equilibrium [1/s2]
    least: Float[np.ndarray, "1 lanes"]  # its least value but zero
    pace: Float[np.ndarray, "1 lanes"]  # share of it that was gone; 0 if the matrix has changed its kind since
    solves: Float[np.ndarray, "1 lanes"]  # of static iterations, all together
    imbalance: Float[np.ndarray, "1 lanes"]
    softness: Float[np.ndarray, "1 lanes"]  # remaining share of the moduli after the time
    firmness: Float[np.ndarray, "1 lanes"]  # factor on the stiffness in a step, and on the damping
    loss: Float[np.ndarray, "1 lanes"]
    pushed: Float[np.ndarray, "stations3 lanes"]  # forces on the sections in a step [N]
    given: Float[np.ndarray, "stations3 lanes"]
    branch: Float[np.ndarray, "values lanes"]  # strains of the dashpots, times the elements' length
    stress: Float[np.ndarray, "values lanes"]  # of the elements, as it turns in the matrix of an equilibrium


class Runs(NamedTuple):
    """Runs of neighbouring guides that slide as one, the same for every kind of friction; guides count over all
    cables, as in ``rod_tables.RodTables``."""

    cable: Int[np.ndarray, " runs"]
    first: Int[np.ndarray, " runs"]  # guide of the run
    last: Int[np.ndarray, " runs"]  # guide after it
    count: int
    guides: int


class Friction(NamedTuple):
    """Friction of one lane block; rows are the runs of every kind that is present, one kind after the other."""

    mobilised: Float[np.ndarray, "rows lanes"]  # share of the friction, at the start of the step
    segment: Float[np.ndarray, "guides lanes"]  # tension in front of every guide [N]
    weight: Float[np.ndarray, "kinds_guides lanes"]  # friction of every guide per coefficient [N]
    whole: Float[np.ndarray, "rows lanes"]  # its sum over a run
    trial: Float[np.ndarray, "rows lanes"]  # share that a solve starts from, as if nothing could slide
    ended: Float[np.ndarray, "rows lanes"]  # share mobilised after a row at rest
    begun: Float[np.ndarray, "guides lanes"]  # ways of the cables when the row began [m]
    lost: Float[np.ndarray, "guides lanes"]  # impulse that a cable has lost before and at a guide


def runs_of(layout: CableLayout) -> Runs:
    """Runs of cables; runs without a guide are left out."""
    first_guide = np.concatenate([[0], np.cumsum(layout.used.sum(axis=1))])
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
        "mobilised": rows, "segment": runs.guides, "weight": KINDS * runs.guides,
        "whole": rows, "trial": rows, "ended": rows, "begun": runs.guides, "lost": runs.guides,
    }  # fmt: skip
    return Friction(**{name: aligned_zeros((max(size, 1), lanes), dtype) for name, size in sizes.items()})
