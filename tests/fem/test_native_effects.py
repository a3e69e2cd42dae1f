"""Effects of the body on the compiled engine: the numbers of the reference engine, and nothing at null values."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.fem.effects import BodyEffects
from rfdropo_bayes.fem.native.layered_engine import NativeLayered

STEPS, BATCH, TIME_STEP = 25, 5, 0.01
AGREEMENT = {"float64": 1e-9, "float32": 3e-5}  # [m]


@functools.cache
def tapering_body() -> tuple[fem.System, fem.PointMap]:
    """Uneven layers and sections, and two cables."""
    random = np.random.default_rng(3)
    station = np.concatenate([[0.0], np.cumsum(0.01 + 0.005 * random.random(4))])
    area = 4e-4 * (0.5 + random.random(4))
    moment = area[:, None] * 1e-4 * (0.2 + random.random((4, 2)))
    body = fem.profile_body(
        station=station,
        half_width=0.01 + 0.01 * random.random((5, 2)),
        axial_area=area,
        bending_moment_area=moment,
        torsion_constant=0.8 * moment.sum(axis=1),
        mass_area=area,
        mass_moment_area=moment,
    )
    tip = station[-1]
    guides = [np.array([[0.008, 0.0, 0.02], [0.007, 0.0, tip]]), np.array([[-0.003, 0.007, 0.5 * tip]])]
    system = fem.System(body, fem.cable_layout(body, np.array([[0.01, 0.0, -0.01], [0.0, 0.01, -0.01]]), guides))
    return system, fem.attach(body, np.array([[0.0, 0.0, tip], [0.003, 0.002, 0.03]]))


def random_effects(seed: int) -> BodyEffects:
    """Every effect that the compiled engine knows, of either sign where the sign is free."""
    random = np.random.default_rng(seed)

    def drawn(low, high):
        return random.uniform(low, high, BATCH)

    return BodyEffects(
        bending=fem.BendingLaw(drawn(0.0, 1.0), *(drawn(-0.3, 0.3) for _ in range(4))),
        viscoelasticity=fem.Viscoelasticity(drawn(0.0, 1.0), drawn(0.05, 1.0)),
        softening_rate=drawn(-0.5, 0.5),
        drag=drawn(0.0, 3e3),
        wall=fem.Wall(drawn(0.0, 1e4), drawn(-1e-3, 4e-3), drawn(-3.0, 3.0)),
        cable_compliance=drawn(0.0, 1e-2),
    )


def case(seed: int) -> tuple[fem.Material, np.ndarray]:
    """Materials without effects and commands."""
    system, _ = tapering_body()
    random = np.random.default_rng(seed)
    material = fem.Material(
        young_modulus=4e5 * np.exp(0.5 * random.normal(size=BATCH)),
        poisson_ratio=random.uniform(0.0, 0.49, BATCH),
        density=random.uniform(500.0, 1500.0, BATCH),
        rayleigh_mass=random.uniform(0.0, 1.0, BATCH),
        rayleigh_stiffness=random.uniform(0.0, 0.1, BATCH),
        gravity=np.array([0.0, 0.0, 9.81]) + random.normal(size=(BATCH, 3)),
        stiffness_scale=random.uniform(0.5, 1.5, (BATCH, 4)),
        point_mass=random.uniform(0.0, 0.002, (BATCH, 5)),
    )
    return material, np.cumsum(1e-3 * random.normal(size=(BATCH, STEPS, len(system.cables.anchor))), axis=1)


def native(precision: str, threads: int = 1) -> NativeLayered:
    return NativeLayered(*tapering_body(), TIME_STEP, precision=precision, threads=threads)


@jax.jit
@jax.vmap
def reference(material, displacement, start):
    system, points = tapering_body()
    prepared = fem.prepare(system, material)
    state, info = fem.static_equilibrium(system, prepared, start)
    motion = fem.simulate(system, prepared, state, displacement[:, None], TIME_STEP, points)
    first = fem.point_positions(points, state.position)
    tension = jnp.concatenate([state.tension[None], motion.tension])
    return jnp.concatenate([first[None], motion.position]), tension, info.residual


@pytest.mark.slow
def test_agrees_with_the_reference():
    """All effects at once, random parameters and commands, from equilibrium, in both precisions."""
    material, displacement = case(1)
    extended, start = material._replace(effects=random_effects(2)), 2.0 * displacement[:, 0]
    position, tension, residual = reference(extended, displacement, start)
    assert np.max(residual) < 1e-9
    for precision, tolerance in AGREEMENT.items():
        found = native(precision).rollout(extended, displacement, start=start)
        np.testing.assert_allclose(found.position, position, rtol=0.0, atol=tolerance)
        np.testing.assert_allclose(found.tension, tension, rtol=0.0, atol=1e5 * tolerance)
        assert not found.diverged.any()
        assert found.imbalance.max() < (1e-9 if precision == "float64" else 1e-3)
    plain = native("float64").rollout(material, displacement, start=start)
    assert np.abs(plain.position - position).max() > 1e-3, "the effects do nothing"


@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_null_values_change_nothing(precision):
    material, displacement = case(4)
    effects = random_effects(5)
    null = jax.tree.map(np.zeros_like, effects)
    null = null._replace(viscoelasticity=effects.viscoelasticity._replace(fraction=np.zeros(BATCH)))
    run, start = native(precision).rollout, displacement[:, 0]
    plain, present = (run(material._replace(effects=e), displacement, start=start) for e in (BodyEffects(), null))
    np.testing.assert_array_equal(plain.position, present.position)


def test_batch_and_threads_do_not_matter():
    """Bit for bit: alone, in any order, on two threads; and a batch without effects after one with them."""
    material, displacement = case(6)
    extended = material._replace(effects=random_effects(7))
    engine = native("float64")
    before = engine.rollout(material, displacement)
    whole = engine.rollout(extended, displacement)
    for one, two in zip(before, engine.rollout(material, displacement), strict=True):
        np.testing.assert_array_equal(one, two)
    order = np.random.default_rng(8).permutation(BATCH)
    shuffled = jax.tree.map(lambda value: value[order], extended)
    other = native("float64", threads=2).rollout(shuffled, displacement[order])
    for one, two in zip(*map(jax.tree.leaves, (whole, other)), strict=True):
        np.testing.assert_array_equal(one[order], two)
    alone = engine.rollout(jax.tree.map(lambda value: value[3], extended), displacement[3])
    for one, two in zip(*map(jax.tree.leaves, (whole, alone)), strict=True):
        np.testing.assert_array_equal(one[3:4], two)


@functools.cache
def guided_body() -> tuple[fem.System, fem.PointMap]:
    """The tapering body with cables of eight, five and two guides."""
    body = tapering_body()[0].body
    height = np.linspace(0.005, body.station[-1], 8)[:, None] * np.array([0.0, 0.0, 1.0])
    places = np.array([[0.008, 0.0, 0.0], [-0.003, 0.007, 0.0], [-0.007, -0.004, 0.0]])
    guides = [height[:count] + place for count, place in zip((8, 5, 2), places, strict=True)]
    system = fem.System(body, fem.cable_layout(body, 1.2 * places - [0.0, 0.0, 0.01], guides))
    return system, tapering_body()[1]


def friction_case(seed: int) -> tuple[fem.Material, np.ndarray]:
    """Materials whose cables rub in both ways and stretch, one of each kind at its null value, and commands."""
    random = np.random.default_rng(seed)
    coulomb, capstan, give = (random.uniform(0.0, high, BATCH) for high in (0.3, 0.6, 3e-3))
    coulomb[0], capstan[1] = 0.0, 0.0
    effects = BodyEffects(coulomb_friction=coulomb, capstan_friction=capstan, cable_compliance=give)
    return case(seed)[0]._replace(effects=effects), 2e-3 + np.cumsum(
        1e-3 * random.normal(size=(BATCH, STEPS, 3)), axis=1
    )


@pytest.mark.slow
def test_friction_agrees_with_the_reference():
    """Both kinds at once, random coefficients, materials and commands, from equilibrium, in both precisions."""
    system, points = guided_body()
    material, displacement = friction_case(11)

    @jax.jit
    @jax.vmap
    def expected(material, displacement, start):
        prepared = fem.prepare(system, material)
        state, _ = fem.static_equilibrium(system, prepared, start)
        motion = fem.simulate(system, prepared, state, displacement[:, None], TIME_STEP, points)
        return motion.position, motion.tension, motion.converged

    start = displacement[:, 0]
    position, tension, solved = expected(material, displacement, start)
    for precision, tolerance in AGREEMENT.items():
        engine = NativeLayered(system, points, TIME_STEP, precision=precision, threads=1)
        found = engine.rollout(material, displacement, start=start)
        np.testing.assert_allclose(found.position[:, 1:], position, rtol=0.0, atol=tolerance)
        np.testing.assert_allclose(found.tension[:, 1:], tension, rtol=0.0, atol=1e5 * tolerance)
        np.testing.assert_array_equal(found.converged, solved)
        plain = engine.rollout(material._replace(effects=BodyEffects()), displacement, start=start)
        assert np.abs(plain.position - found.position).max() > 1e-3, "friction does nothing"


@pytest.mark.slow
def test_friction_alone_null_and_in_any_batch():
    """One kind gives what both give with the other null; null values are those of no friction; lanes never mix."""
    system, points = guided_body()
    material, displacement = friction_case(12)
    engine = NativeLayered(system, points, TIME_STEP, threads=1)

    def rolled(**effects):
        return engine.rollout(material._replace(effects=BodyEffects(**effects)), displacement)

    nothing = np.zeros(BATCH)
    for name in ("coulomb_friction", "capstan_friction"):
        value = getattr(material.effects, name)
        one, both = (
            rolled(**{name: value}),
            rolled(**({"coulomb_friction": nothing, "capstan_friction": nothing} | {name: value})),
        )
        np.testing.assert_allclose(one.position, both.position, rtol=0.0, atol=1e-12)
    none, null = rolled(), rolled(coulomb_friction=nothing, capstan_friction=nothing)
    np.testing.assert_allclose(null.position, none.position, rtol=0.0, atol=1e-12)
    # Differences about zero ask for strengths below it.
    below = rolled(coulomb_friction=nothing - 1e-6, capstan_friction=nothing - 1e-6)
    np.testing.assert_allclose(below.position, none.position, rtol=0.0, atol=1e-7)
    whole = engine.rollout(material, displacement)
    order = np.random.default_rng(13).permutation(BATCH)
    shuffled = jax.tree.map(lambda value: value[order], material)
    other = NativeLayered(system, points, TIME_STEP, threads=2).rollout(shuffled, displacement[order])
    for one, two in zip(*map(jax.tree.leaves, (whole, other)), strict=True):
        np.testing.assert_array_equal(one[order], two)
