"""Rods, materials and commands that the tests of the compiled engine share."""

from __future__ import annotations

import functools

import jax
import numpy as np

from rfdropo_bayes import fem
from rfdropo_bayes.fem.native.rod_engine import NativeRod

TIME_STEP, BATCH, STEPS = 0.01, 6, 8


@functools.cache
def uneven_rod(clamped: int = 1) -> tuple[fem.System, fem.PointMap]:
    """A rod without any symmetry along its axis, three cables of different reach, two recorded points."""
    random, elements = np.random.default_rng(11), 5
    station = np.concatenate([[0.0], np.cumsum(0.01 + 0.005 * random.random(elements))])
    area = 4e-4 * (0.5 + random.random(elements))
    moment = area[:, None] * 1e-4 * (0.2 + random.random((elements, 2)))
    body = fem.profile_rod(
        station=station,
        half_width=0.01 + 0.01 * random.random((elements + 1, 2)),
        axial_area=area,
        bending_moment_area=moment,
        torsion_constant=0.8 * moment.sum(axis=1),
        mass_area=1.2 * area,
        mass_moment_area=1.1 * moment,
    )
    tip = station[-1]
    anchors = np.array([[0.01, 0.0, -0.01], [0.0, -0.01, -0.01], [-0.01, 0.001, -0.01]])
    ring = np.array([[-0.008, 0.0, 0.0], [0.0, 0.0, 1.0]])
    guides = [
        np.array([[0.008, 0.0, 0.02], [0.007, 0.0, tip]]),
        np.array([[0.0, -0.007, 0.6 * tip]]),
        ring[0] + np.array([0.008, 0.02, 0.04, 0.05, tip])[:, None] * ring[1],
    ]
    system = fem.System(body, fem.cable_layout(body, anchors, guides), clamped)
    return system, fem.attach(body, np.array([[0.0, 0.0, tip], [0.003, 0.002, 0.03]]))


def materials(seed: int, batch: int = BATCH) -> fem.Material:
    """Soft and stiff, light and heavy."""
    random, elements = np.random.default_rng(seed), uneven_rod()[0].body.elements
    return fem.Material(
        young_modulus=4e5 * np.exp(0.5 * random.normal(size=batch)),
        poisson_ratio=random.uniform(0.0, 0.5, batch),
        density=random.uniform(500.0, 1500.0, batch),
        rayleigh_mass=random.uniform(0.0, 1.0, batch),
        rayleigh_stiffness=random.uniform(0.0, 0.1, batch),
        gravity=np.array([0.0, 0.0, 9.81]) + random.normal(size=(batch, 3)),
        stiffness_scale=random.uniform(0.5, 1.5, (batch, elements)),
        point_mass=random.uniform(0.0, 0.002, (batch, elements + 1)),
    )


def displacements(seed: int, batch: int = BATCH) -> np.ndarray:
    """Pulling and slackening at random [m], (batch, STEPS, cables)."""
    return 5e-4 + np.cumsum(1e-3 * np.random.default_rng(seed).normal(size=(batch, STEPS, 3)), axis=1)


def all_effects(seed: int, batch: int = BATCH) -> fem.BodyEffects:
    """Every effect but friction of the cables, of either sign if the sign is free."""
    random = np.random.default_rng(seed)

    def drawn(low: float, high: float) -> np.ndarray:
        return random.uniform(low, high, batch)

    return fem.BodyEffects(
        bending=fem.BendingLaw(drawn(-1.0, 1.0), *(drawn(-0.3, 0.3) for _ in range(4))),
        viscoelasticity=fem.Viscoelasticity(drawn(0.1, 1.0), drawn(0.05, 1.0)),
        softening_rate=drawn(-0.5, 0.5),
        drag=drawn(0.0, 3e3),
        wall=fem.Wall(drawn(0.0, 1e4), drawn(-1e-3, 4e-3), drawn(-3.0, 3.0)),
        cable_compliance=drawn(0.0, 1e-2),
    )


def rubbing(seed: int, batch: int = BATCH) -> fem.BodyEffects:
    """Both kinds of friction."""
    random = np.random.default_rng(seed)
    return fem.BodyEffects(
        coulomb_friction=random.uniform(0.01, 0.3, batch), capstan_friction=random.uniform(0.05, 0.6, batch)
    )


@functools.cache
def engine(integrator: str = "euler", threads: int = 1, precision: str = "float64", clamped: int = 1) -> NativeRod:
    """The engine of the uneven rod."""
    made = {"threads": threads, "precision": precision, "integrator": integrator}
    return NativeRod(*uneven_rod(clamped), TIME_STEP, **made)


def rows_of(tree: object, rows: object) -> object:
    """Rows of every array of a tree."""
    return jax.tree.map(lambda value: np.asarray(value)[rows] if np.ndim(value) else value, tree)


def assert_same(one: object, two: object) -> None:
    """Bit for bit."""
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)
