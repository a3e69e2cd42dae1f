"""Effects of the body as the rows of numbers that the kernels of ``rod_effects`` read."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from rfdropo_bayes.fem.effects import BodyEffects
from rfdropo_bayes.fem.integrators import Stage
from rfdropo_bayes.fem.native import rod_effects as at
from rfdropo_bayes.fem.native.rod_tables import section_areas
from rfdropo_bayes.fem.rod import Rod
from rfdropo_bayes.fem.section_loads import SectionLoads


def _each(function: Callable[[float], float], values: ArrayLike, count: int) -> Float[np.ndarray, " batch"]:
    """A function of each number on its own: NumPy's results depend in the last bit on the index of a number."""
    return np.array([function(float(value)) for value in np.broadcast_to(values, count)])


def _decay(time: float, rate: float) -> float:
    """Remaining share of the moduli after a time."""
    return math.exp(-rate * time)


def effect_rows(
    effects: BodyEffects, count: int, stages: Sequence[Stage], time_step: float
) -> Float[np.ndarray, "batch rows"]:
    """Numbers of the effects beside the bending of sections, zero without effects."""
    rows, length = np.zeros((count, at.EFFECTS)), stages[0].length * time_step
    rows[:, at.DECAY : at.LATER_DECAY + 1] = 1.0
    if effects.bending is not None:
        rows[:, at.FIBRE] = effects.bending.fibre
    if effects.viscoelasticity is not None:
        fraction, time = (np.asarray(value, float) for value in effects.viscoelasticity)
        rows[:, at.SHARE] = length / (time + length)
        rows[:, at.GAIN] = fraction * (1.0 - rows[:, at.SHARE])
    if effects.softening_rate is not None:
        for k, stage in enumerate(stages):
            rows[:, at.DECAY + k] = _each(partial(_decay, stage.elapsed * time_step), effects.softening_rate, count)
    if effects.drag is not None:
        rows[:, at.DRAG] = effects.drag
    if effects.wall is not None:
        rows[:, at.WALL], rows[:, at.DISTANCE] = effects.wall.stiffness, effects.wall.distance
        rows[:, at.NORMAL_X] = _each(math.cos, effects.wall.azimuth, count)
        rows[:, at.NORMAL_Y] = _each(math.sin, effects.wall.azimuth, count)
    if effects.cable_compliance is not None:
        rows[:, at.GIVE] = effects.cable_compliance
    if effects.coulomb_friction is not None:
        rows[:, at.COULOMB] = effects.coulomb_friction
    if effects.capstan_friction is not None:
        rows[:, at.CAPSTAN] = effects.capstan_friction
    return rows


def law_rows(
    effects: BodyEffects,
    body: Rod,
    young_modulus: Float[np.ndarray, " batch"],
    shear_modulus: Float[np.ndarray, " batch"],
    scale: Float[np.ndarray, "batch elements"],
) -> Float[np.ndarray, "batch element_rows"]:
    """Contribution of the bending law to the stiffness of every element over its length; see ``fem.bending_law``."""
    law = effects.bending
    rows = np.zeros((*scale.shape, at.LAW))
    if law is None:
        return rows.reshape(len(rows), -1)
    modulus = np.stack([young_modulus, young_modulus, shear_modulus], axis=1)
    root = np.sqrt(scale[:, :, None] * section_areas(body)[:, 3:] * modulus[:, None, :])
    anisotropy, cross, twist_x, twist_y = (
        np.broadcast_to(value, len(rows))[:, None]
        for value in (law.anisotropy, law.cross_plane, law.twist_x, law.twist_y)
    )
    about_x, about_y = (_each(math.expm1, sign * anisotropy[:, 0], len(rows))[:, None] for sign in (-0.5, 0.5))
    entries = ((0, 0, about_x), (0, 1, cross), (0, 2, twist_x), (1, 1, about_y), (1, 2, twist_y))
    for k, (i, j, value) in enumerate(entries):
        rows[:, :, k] = value * root[:, :, i] * root[:, :, j]
    return rows.reshape(len(rows), -1)


def effect_flags(effects: BodyEffects) -> Int[np.ndarray, " flags"]:
    """Flags of a batch's effects, by which absent effects are skipped."""
    flags = np.zeros(at.FLAGS, dtype=np.int64)
    flags[at.BENDING] = effects.bending is not None
    flags[at.BRANCH] = effects.viscoelasticity is not None
    flags[at.SURROUNDED] = effects.drag is not None or effects.wall is not None
    flags[at.FRICTION] = effects.coulomb_friction is not None
    flags[at.FRICTION + 1] = effects.capstan_friction is not None
    return flags


def load_rows(loads: SectionLoads | None) -> tuple[Float[np.ndarray, "batch values"], Int[np.ndarray, " places"]]:
    """Loads on the body in the kernels' layout, row by row, and the stations with forces."""
    if loads is None:
        return np.zeros((1, 1)), np.zeros(1, dtype=np.int64)
    force = np.asarray(loads.force, float)
    batch, rows = force.shape[:2]
    factors = [np.exp(np.asarray(part, float))[..., None] for part in (loads.stiffness, loads.damping)]
    columns = [force.reshape(batch, rows, -1), *factors, np.asarray(loads.gravity, float)]
    return np.concatenate(columns, axis=-1).reshape(batch, -1), np.array(loads.station, dtype=np.int64)
