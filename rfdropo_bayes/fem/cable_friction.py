"""Friction of cables in their guides: Coulomb's with a constant force, and the capstan's.

At guide j the tension drops from T_j to T_j+1 = T_j - D_j as the cable slides towards its drive, and rises as it slides
away. Coulomb: D = F z. Capstan: D = mu theta (T_j + T_j+1) / 2 z, with the wrap angle theta of the current shape; for
full sliding that is (2 - mu theta) / (2 + mu theta), the exponential to third order in mu theta of a guide.

z in [-1, 1] is the share of the friction that is mobilised: a Prandtl element, dz = slip / PRESLIDING until it slides.
It sticks at rest and holds its force there. The end of a step is implicit in z, see ``fem.constraints``. Guides next to
each other share one z, in at most ``RUNS`` runs a cable; the slip of a run is weighted as its friction is, which makes
the condensed problem symmetric and the friction dissipate.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rfdropo_bayes.fem.cables import CableLayout, courses, patterns, threads
from rfdropo_bayes.fem.components import dot, rotation
from rfdropo_bayes.fem.effects import BodyEffects, Memory, Scalar

RUNS = 4
"""Runs of neighbouring guides of a cable that slide as one, at most."""
PRESLIDING = 1e-4
"""Slip [m] that mobilises all of the friction."""
FADING = 0.1
"""Coulomb's friction fades if the tension [N] falls below this: a slack cable exerts no pressure."""
SLACK = 1e-9
"""[N] Added to every tension that presses on a guide: a slack cable slides as one with little friction does, whatever
rounding leaves of its tension."""
STRAIGHT = 1e-6
"""Smallest wrap angle [rad]; keeps its derivative finite for a straight cable."""


class Slip(NamedTuple):
    """Friction of one step before its size is known; runs of every kind and cable."""

    weight: Float[Array, "kinds cables cable_runs guides"]  # of the segment in front of each guide in the run's slip
    strength: Float[Array, " runs"]  # friction force [N] if all of it is mobilised
    drop: Float[Array, "kinds cables guides"]  # the same at each guide
    mobilised: Float[Array, " runs"]  # z at the start of the step


def run_members(layout: CableLayout) -> Bool[np.ndarray, "cables cable_runs guides"]:
    """Mask of the guides in each run of their cable; the last guide, to which the cable is tied, is in none."""
    cables, guides = layout.used.shape
    members = np.zeros((cables, RUNS, guides), dtype=bool)
    for cable, used in enumerate(layout.used):
        for run, part in enumerate(np.array_split(np.arange(int(used.sum()) - 1), RUNS)):
            members[cable, run, part] = True
    return members


def wrap_angles(direction: Float[Array, "3 cables guides"]) -> Float[Array, "cables guides"]:
    """Angle [rad] by which a cable turns at each guide; meaningless at its last. 3e-5 short at 60 degrees."""
    change = jnp.concatenate([direction[:, :, 1:], direction[:, :, -1:]], axis=2) - direction
    square = dot(change, change) + STRAIGHT**2
    series = 1.0 + square * (1 / 24 + square * (3 / 640 + square * (5 / 7168 + square * 35 / 294912)))
    return jnp.sqrt(square) * series


def start_slip(layout: CableLayout, effects: BodyEffects, tension: Float[Array, " cables"]) -> Memory:
    """Memory of cables whose friction is not mobilised yet."""
    kinds = len(_coefficients(effects))
    if not kinds:
        return Memory()
    cables, guides = layout.used.shape
    return Memory(slip=jnp.zeros((kinds, cables, RUNS)), segment=jnp.repeat(tension[:, None], guides, axis=1))


def _coefficients(effects: BodyEffects) -> list[Scalar]:
    return [value for value in (effects.coulomb_friction, effects.capstan_friction) if value is not None]


def slip_problem(
    layout: CableLayout,
    effects: BodyEffects,
    mobilised: Float[Array, "kinds cables cable_runs"],
    segment: Float[Array, "cables guides"],
    position: Float[Array, "stations 3"],
    orientation: Float[Array, "stations 4"],
) -> Slip:
    """Friction of a step from the shape at its start, the friction mobilised then, and the tension in front of every
    guide [N]."""
    members = run_members(layout)
    middle = 0.5 * (segment + jnp.concatenate([segment[:, 1:], segment[:, -1:]], axis=1)) + SLACK
    weights = []
    if effects.coulomb_friction is not None:
        weights.append(middle / (middle + FADING))
    if effects.capstan_friction is not None:
        course = courses(layout, threads(layout), position.T, rotation(orientation.T))
        weights.append(middle * wrap_angles(course.direction))
    weight = jnp.stack(weights)[:, :, None, :] * members
    whole = jnp.sum(weight, axis=-1)
    share = weight / jnp.where(whole > 0.0, whole, 1.0)[..., None]
    coefficient = jnp.stack([jnp.asarray(value, dtype=float) for value in _coefficients(effects)])
    return Slip(
        weight=(jnp.cumsum(share, axis=-1) - share) * layout.used[:, None],
        strength=(coefficient[:, None, None] * whole).ravel(),
        drop=coefficient[:, None, None] * jnp.sum(weight, axis=2),
        mobilised=mobilised.ravel(),
    )


def slip_rows(
    layout: CableLayout, slip: Slip, position: Float[Array, "stations 3"], orientation: Float[Array, "stations 4"]
) -> tuple[Float[Array, "stations 6 runs"], Float[Array, " runs"]]:
    """Negative derivatives of the runs' slip by the motion of the stations, and the corresponding lengths [m]."""
    thread = threads(layout)
    course = courses(layout, thread, position.T, rotation(orientation.T))
    kinds, cables, runs, guides = slip.weight.shape
    # (kinds and runs, cables, guides): every run is a line of guides of its cable.
    weight = jnp.swapaxes(slip.weight, 1, 2).reshape(-1, cables, guides)
    weighted = weight * course.direction[:, None]
    pull = weighted - jnp.concatenate([weighted[..., 1:], jnp.zeros_like(weighted[..., :1])], axis=-1)
    rows = patterns(layout, thread, course.lever, pull, len(position)).reshape(len(position), 6, kinds, runs, cables)
    length = jnp.sum(slip.weight * course.length[:, None], axis=-1)
    return jnp.swapaxes(rows, 3, 4).reshape(len(position), 6, -1), length.ravel()


def slipped(
    layout: CableLayout, slip: Slip, share: Float[Array, " runs"], tension: Float[Array, " cables"]
) -> tuple[Float[Array, "kinds cables cable_runs"], Float[Array, "cables guides"]]:
    """Mobilised friction and the tension in front of every guide, after a step."""
    members = run_members(layout)
    kinds = len(slip.drop)
    share = share.reshape(kinds, len(members), RUNS)
    drop = jnp.sum(slip.drop * jnp.einsum("kcr,crg->kcg", share, members), axis=0)
    before = jnp.cumsum(drop, axis=1) - drop
    return share, jnp.maximum(tension[:, None] - before, 0.0)
