"""The compiled engine against the reference engine, and against itself in other batches, lanes and threads."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.native.layered_engine import NativeLayered
from rfdropo_bayes.fem.native.layered_session import LayeredSession

TIME_STEP = 0.01
STEPS = 25
AGREEMENT = {"float64": 1e-9, "float32": 3e-5}  # [m]


@functools.cache
def body_with_cables(nodes_across: int, layers: int = 5, clamped: int = 1) -> tuple[fem.System, fem.PointMap]:
    """A body without any symmetry along its axis, three cables of different reach, two recorded points."""
    random = np.random.default_rng(11)
    station = np.concatenate([[0.0], np.cumsum(0.01 + 0.005 * random.random(layers))])
    area = 4e-4 * (0.5 + random.random(layers))
    moment = area[:, None] * 1e-4 * (0.2 + random.random((layers, 2)))
    body = fem.profile_body(
        station=station,
        half_width=0.01 + 0.01 * random.random((layers + 1, 2)),
        axial_area=area,
        bending_moment_area=moment,
        torsion_constant=0.8 * moment.sum(axis=1),
        mass_area=1.2 * area,
        mass_moment_area=1.1 * moment,
        nodes_across=nodes_across,
    )
    tip = station[-1]
    anchors = np.array([[0.01, 0.0, -0.01], [0.0, -0.01, -0.01], [-0.01, 0.001, -0.01]])
    guides = [
        np.array([[0.008, 0.0, 0.02], [0.007, 0.0, tip]]),
        np.array([[0.0, -0.007, 0.6 * tip]]),
        np.array([[-0.008, 0.0, 0.02], [-0.008, 0.0, 0.04], [-0.007, 0.001, tip]]),
    ]
    system = fem.System(body, fem.cable_layout(body, anchors, guides), clamped)
    return system, fem.attach(body, np.array([[0.0, 0.0, tip], [0.003, 0.002, 0.03]]))


def random_materials(system: fem.System, batch: int, seed: int) -> fem.Material:
    """Soft and stiff, light and heavy, nearly incompressible and beyond."""
    random = np.random.default_rng(seed)
    layers = len(system.body.station) - 1
    return fem.Material(
        young_modulus=4e5 * np.exp(0.5 * random.normal(size=batch)),
        poisson_ratio=random.uniform(0.0, 0.51, batch),
        density=random.uniform(500.0, 1500.0, batch),
        rayleigh_mass=random.uniform(0.0, 1.0, batch),
        rayleigh_stiffness=random.uniform(0.0, 0.1, batch),
        gravity=np.array([0.0, 0.0, 9.81]) + random.normal(size=(batch, 3)),
        stiffness_scale=random.uniform(0.5, 1.5, (batch, layers)),
        point_mass=random.uniform(0.0, 0.002, (batch, layers + 1)),
    )


def random_displacements(system: fem.System, batch: int, seed: int, scale: float = 1e-3) -> np.ndarray:
    """Pulling and slackening at random, (batch, STEPS, cables)."""
    moves = np.random.default_rng(seed).normal(size=(batch, STEPS, len(system.cables.anchor)))
    return np.cumsum(scale * moves, axis=1)


VARIED = tuple(name for name in fem.Material._fields if name != "effects")


@functools.cache
def reference(nodes_across: int, clamped: int = 1, settle: bool = False):
    """The reference engine on a batch, compiled once: position, tension, residual; row 0 is the initial state."""
    system, points = body_with_cables(nodes_across, clamped=clamped)

    def rollout(material, displacement, start):
        prepared = fem.prepare(system, material)
        state, residual = fem.state_at_rest(system), jnp.zeros(())
        if settle:
            state, info = fem.static_equilibrium(system, prepared, start)
            residual = info.residual
        motion = fem.simulate(system, prepared, state, displacement[:, None], TIME_STEP, points)
        first = fem.point_positions(points, state.position)
        position = jnp.concatenate([first[None], motion.position])
        return position, jnp.concatenate([state.tension[None], motion.tension]), residual, motion.diverged

    return jax.jit(jax.vmap(rollout))


@functools.cache
def engine(nodes_across: int, precision: str, threads: int = 1, lanes: int | None = None, clamped: int = 1):
    """The compiled engine."""
    system, points = body_with_cables(nodes_across, clamped=clamped)
    return NativeLayered(system, points, TIME_STEP, precision=precision, threads=threads, lanes=lanes)


@pytest.mark.parametrize(
    ("nodes_across", "precision"),
    [(2, "float64"), pytest.param(2, "float32", marks=pytest.mark.slow), (3, "float64"), (3, "float32")],
)
def test_agrees_with_reference(nodes_across, precision):
    """Random materials and commands, a batch that leaves lanes empty, from rest."""
    system, _ = body_with_cables(nodes_across)
    batch = 11
    material, displacement = random_materials(system, batch, 1), random_displacements(system, batch, 2)
    position, tension, _, diverged = reference(nodes_across)(material, displacement, displacement[:, 0])
    found = engine(nodes_across, precision).rollout(material, displacement)
    assert np.ptp(position, axis=1).max() > 5e-3, "nothing moved"
    assert np.mean(tension > 0.0) > 0.2
    assert np.mean(np.asarray(tension) == 0.0) > 0.1
    np.testing.assert_allclose(found.position, position, rtol=0.0, atol=AGREEMENT[precision])
    np.testing.assert_allclose(found.tension, tension, rtol=0.0, atol=1e5 * AGREEMENT[precision])
    assert not np.any(diverged)
    assert not found.diverged.any()
    assert found.converged.all()
    assert not found.imbalance.any()


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("nodes_across", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_settles_like_the_reference(nodes_across, precision):
    """Static equilibrium under random cable displacements, and the motion from there."""
    system, _ = body_with_cables(nodes_across)
    batch = 5
    material, displacement = random_materials(system, batch, 3), random_displacements(system, batch, 4)
    start = 2.0 * displacement[:, 0]
    position, tension, residual, _ = reference(nodes_across, settle=True)(material, displacement, start)
    found = engine(nodes_across, precision).rollout(material, displacement, start=start)
    assert np.ptp(position, axis=1).max() > 2e-3, "nothing moved"
    np.testing.assert_allclose(found.position, position, rtol=0.0, atol=AGREEMENT[precision])
    np.testing.assert_allclose(found.tension, tension, rtol=0.0, atol=1e5 * AGREEMENT[precision])
    assert found.imbalance.max() < (1e-9 if precision == "float64" else 1e-3)
    assert np.max(residual) < 1e-9


@pytest.mark.parametrize("clamped", [0, 2])
def test_free_and_doubly_clamped_bodies(clamped):
    """Other numbers of held stations than one."""
    system, _ = body_with_cables(2, clamped=clamped)
    material, displacement = random_materials(system, 3, 5), random_displacements(system, 3, 6, 2e-4)
    position, tension, _, _ = reference(2, clamped=clamped)(material, displacement, displacement[:, 0])
    found = engine(2, "float64", clamped=clamped).rollout(material, displacement)
    np.testing.assert_allclose(found.position, position, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.tension, tension, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_lane_batch_and_threads_do_not_matter(precision):
    """Bit for bit: alone, in any order, on two threads."""
    system, _ = body_with_cables(2)
    batch = 19
    material, displacement = random_materials(system, batch, 7), random_displacements(system, batch, 8)
    start = displacement[:, 0]
    whole = engine(2, precision).rollout(material, displacement, start=start)
    order = np.random.default_rng(9).permutation(batch)
    shuffled = jax.tree.map(lambda value: value[order], material)
    for other in (
        engine(2, precision).rollout(shuffled, displacement[order], start=start[order]),
        engine(2, precision, threads=2).rollout(shuffled, displacement[order], start=start[order]),
    ):
        for one, two in zip(jax.tree.leaves(whole), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(one[order], two)
    single = jax.tree.map(lambda value: value[4], material)
    alone = engine(2, precision).rollout(single, displacement[4], start=start[4])
    for one, two in zip(jax.tree.leaves(whole), jax.tree.leaves(alone), strict=True):
        np.testing.assert_array_equal(one[4:5], two)


@pytest.mark.slow
def test_number_of_lanes_does_not_matter():
    """Bit for bit: registers of another width give the same numbers."""
    system, _ = body_with_cables(2)
    material, displacement = random_materials(system, 5, 7), random_displacements(system, 5, 8)
    wide = engine(2, "float64").rollout(material, displacement)
    narrow = engine(2, "float64", lanes=2).rollout(material, displacement)
    for one, two in zip(jax.tree.leaves(wide), jax.tree.leaves(narrow), strict=True):
        np.testing.assert_array_equal(one, two)


def test_a_command_that_is_no_number_is_a_lost_rollout_as_in_the_reference_engine():
    """It would be a slack cable: of the way, of its beginning, and of a session, whose other lanes go on."""
    system, _ = body_with_cables(2)
    material, displacement = random_materials(system, 4, 10), random_displacements(system, 4, 11)
    lost = displacement.copy()
    lost[1, 3, 0] = np.nan
    start = np.zeros_like(displacement[:, 0])
    start[2, 1] = np.nan
    found = engine(2, "float64").rollout(material, lost, before=start)
    np.testing.assert_array_equal(found.diverged, [False, True, True, False])
    assert not engine(2, "float64").rollout(material, lost, steps=3).diverged.any()  # it comes later
    session = LayeredSession(engine(2, "float64"), 4)
    session.reset(np.arange(4), material)
    np.testing.assert_array_equal(session.advance(lost).diverged, [False, True, False, False])
    both = material._replace(**{name: getattr(material, name)[1:3] for name in VARIED})
    again = session.reset(np.array([1, 2]), both, start=start[1:3])
    np.testing.assert_array_equal(again.diverged, [False, True])


def test_lost_rollout_leaves_its_neighbours_alone():
    """A parameter that is not a number, and one far too soft, are marked and touch no other lane."""
    system, _ = body_with_cables(2)
    batch = 6
    material, displacement = random_materials(system, batch, 10), random_displacements(system, batch, 11)
    good = engine(2, "float64").rollout(material, displacement)
    modulus = material.young_modulus.copy()
    modulus[2] = np.nan
    modulus[3] = 1e-6
    displacement = displacement.copy()
    displacement[3] += 0.5
    found = engine(2, "float64").rollout(material._replace(young_modulus=modulus), displacement)
    assert found.diverged[2]
    assert found.diverged[3]
    for value in jax.tree.leaves(found):
        assert np.all(np.isfinite(value))
    keep = [0, 1, 4, 5]
    np.testing.assert_array_equal(found.position[keep], good.position[keep])
    np.testing.assert_array_equal(found.diverged[keep], good.diverged[keep])
    settled = engine(2, "float64").rollout(
        material._replace(young_modulus=modulus), displacement, start=displacement[:, 0]
    )
    assert settled.imbalance[2] > 1.0
    assert np.all(np.isfinite(settled.position))


def test_records_what_was_asked_for():
    """Strides, prefixes and shared commands are slices of the same motion."""
    system, _ = body_with_cables(2)
    material, displacement = random_materials(system, 5, 12), random_displacements(system, 5, 13)
    run = engine(2, "float64").rollout
    shared = run(material, displacement[0])
    each = run(material, np.repeat(displacement[:1], 5, axis=0))
    np.testing.assert_array_equal(shared.position, each.position)
    strided = run(material, displacement[0], stride=4)
    np.testing.assert_array_equal(strided.position, shared.position[:, ::4])
    np.testing.assert_array_equal(strided.tension, shared.tension[:, ::4])
    prefix = run(material, displacement[0], steps=7)
    np.testing.assert_array_equal(prefix.position, shared.position[:, :8])


def test_cables_that_share_a_route():
    """Two equal cables make the tension problem singular; both engines still find the same motion."""
    system, points = body_with_cables(2)
    twice = fem.CableLayout(*(np.concatenate([part, part[:1]]) for part in system.cables))
    system = system._replace(cables=twice)
    material = random_materials(system, 4, 14)
    pull = np.linspace(0.0, 4e-3, STEPS)[None, :, None] * np.array([1.0, 0.5, 0.0, 1.0])
    displacement = np.repeat(pull, 4, axis=0)

    @jax.jit
    @jax.vmap
    def expected(material, displacement):
        prepared, state = fem.prepare(system, material), fem.state_at_rest(system)
        return fem.simulate(system, prepared, state, displacement[:, None], TIME_STEP, points).position

    for precision, atol in AGREEMENT.items():
        found = NativeLayered(system, points, TIME_STEP, precision=precision, threads=1).rollout(material, displacement)
        assert found.converged.all()
        assert not found.diverged.any()
        np.testing.assert_allclose(found.position[:, 1:], expected(material, displacement), rtol=0.0, atol=atol)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"displacement": np.zeros((STEPS, 2))}, "3 cables"),
        ({"start": np.zeros(4)}, "3 cables"),
        ({"displacement": np.zeros((3, STEPS, 3))}, "batch axes"),
        ({"density": np.zeros((2, 2))}, "density"),
    ],
)
def test_bad_shapes_are_named(change, message):
    """What does not fit is said in one line."""
    system, _ = body_with_cables(2)
    material = random_materials(system, 2, 15)
    arguments = {"displacement": np.zeros((STEPS, 3))} | change
    if "density" in change:
        material = material._replace(density=arguments.pop("density"))
    with pytest.raises(InputError, match=message):
        engine(2, "float64").rollout(material, **arguments)


def test_bad_settings_are_named():
    """Precision and threads."""
    system, points = body_with_cables(2)
    with pytest.raises(InputError, match="float16"):
        NativeLayered(system, points, TIME_STEP, precision="float16")
    with pytest.raises(InputError, match="threads"):
        NativeLayered(system, points, TIME_STEP, threads=0)


def test_single_precision_while_nearly_incompressible():
    """A long soft body whose resistance to volume change drowns that to bending in single precision, unless refined.

    It is up to 500 times that to shear, and rounding counts as much more: 5.0e-6 m.
    """
    layers, batch = 20, 4
    body = fem.uniform_body(0.195, 0.01, 0.01, layers)
    angle = 2.0 * np.pi * np.arange(4) / 4
    circle = 0.009 * np.stack([np.cos(angle), np.sin(angle), np.zeros(4)], axis=1)
    guides = [place + np.array([0.0, 0.0, 1.0]) * body.station[2::2, None] for place in circle]
    system = fem.System(body, fem.cable_layout(body, circle - [0.0, 0.0, 0.01], guides))
    points = fem.attach(body, np.array([[0.0, 0.0, 0.195]]))
    material = random_materials(system, batch, 16)._replace(
        poisson_ratio=np.array([0.45, 0.48, 0.49, 0.499]), rayleigh_stiffness=np.full(batch, 0.01)
    )
    displacement = np.cumsum(5e-4 * np.random.default_rng(17).normal(size=(batch, 100, 4)), axis=1)
    double, single = (
        NativeLayered(system, points, TIME_STEP, precision=precision, threads=1).rollout(material, displacement)
        for precision in AGREEMENT
    )
    assert np.ptp(double.position, axis=1).max() > 0.03, "nothing moved"
    np.testing.assert_allclose(single.position, double.position, rtol=0.0, atol=1e-5)
