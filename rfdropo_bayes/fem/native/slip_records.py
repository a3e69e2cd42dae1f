"""What the kernels of cable friction work on: runs of neighbouring guides, and the friction of a step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.fem.cable_friction import run_members
from rfdropo_bayes.fem.cables import CableLayout
from rfdropo_bayes.fem.native.simd import aligned_zeros

KINDS = 2
"""Coulomb's friction and the capstan's."""


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
