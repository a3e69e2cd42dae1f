"""The compiled engine of rods: against a rod written down anew, closed forms, and itself in other batches."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.integrate import quad

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.native.rod_engine import NativeRod
from rfdropo_bayes.fem.native.rod_session import RodSession
from rfdropo_bayes.fem.section_loads import SectionLoads
from tests.fem import native_cases as cases
from tests.fem import rod_reference
from tests.fem.native_cases import (
    BATCH,
    STEPS,
    TIME_STEP,
    assert_same,
    displacements,
    engine,
    materials,
    rows_of,
    uneven_rod,
)

YOUNG, DENSITY, LENGTH, HALF = 1e6, 1000.0, 0.2, 0.005
ANYTHING = ["euler", "sdirk2", "quasi-static"]


def points_of(points: fem.PointMap, shape: rod_reference.Shape) -> np.ndarray:
    """Where points are."""
    frames = np.array([rod_reference.matrix(q) for q in shape.turn])
    there = points.weight[..., None] * shape.place[points.station]
    return np.sum(there + np.einsum("psij,psj->psi", frames[points.station], points.arm), axis=1)


@pytest.mark.parametrize("integrator", ["euler", "sdirk2"])
@pytest.mark.parametrize("clamped", [1, 2])
def test_steps_are_those_of_the_rod_written_down_anew(integrator, clamped):
    """Random materials and commands, from rest."""
    system, points = uneven_rod(clamped)
    material, displacement = materials(1), displacements(2)
    found = engine(integrator, clamped=clamped).rollout(material, displacement)
    assert np.ptp(found.position, axis=1).max() > 5e-3, "nothing moved"
    assert found.converged.all()
    for row in (0, 3):
        motion = rod_reference.Motion(system, rows_of(material, row), integrator)
        for step in range(STEPS):
            motion.step(displacement[row, step], TIME_STEP)
            there = points_of(points, motion.shape)
            np.testing.assert_allclose(found.position[row, step + 1], there, rtol=0.0, atol=1e-11)
            np.testing.assert_allclose(found.tension[row, step + 1], motion.tension, rtol=0.0, atol=1e-6)


def test_forces_of_the_rod_written_down_anew_are_the_derivatives_of_its_energy():
    """By central differences in twelve directions at random, far from the undeformed shape."""
    system, _ = uneven_rod()
    random, material = np.random.default_rng(5), rows_of(materials(3), 0)._replace(gravity=np.zeros(3))
    shape = rod_reference.Shape(system.body).moved(random.normal(size=(6, 6)) * ([2e-3] * 3 + [0.4] * 3))
    force = rod_reference.unbalanced(system._replace(clamped_stations=0), material, shape, np.zeros(3))
    for _ in range(12):
        way = random.normal(size=(6, 6)) * ([1e-7] * 3 + [1e-5] * 3)
        ahead, behind = (rod_reference.energy(system.body, material, shape.moved(s * way)) for s in (1.0, -1.0))
        assert (behind - ahead) / 2.0 == pytest.approx(np.sum(force * way), rel=1e-6)


def test_a_body_at_rest_is_in_balance():
    material, start = materials(3), 2.0 * displacements(4)[:, 0]
    found = engine().rollout(material, np.zeros((1, 3)), start=start, steps=0)
    assert found.imbalance.max() < 1e-8
    assert np.mean(found.tension > 0.0) > 0.2
    still = engine("quasi-static").rollout(material, start[:, None])
    assert still.converged.all()
    np.testing.assert_allclose(still.position[:, 1], found.position[:, 0], rtol=0.0, atol=1e-7)


def bar(elements: int = 20) -> tuple[fem.System, fem.PointMap]:
    """A slender bar without cables, and its tip with a point beside it."""
    body = fem.uniform_rod(LENGTH, HALF, HALF, elements)
    return fem.System(body, fem.without_cables()), fem.attach(body, np.array([[0.0, 0.0, LENGTH], [HALF, 0.0, LENGTH]]))


def bar_material(elements: int = 20, **changes) -> fem.Material:
    """Of one bar."""
    values = {
        "young_modulus": YOUNG, "poisson_ratio": 0.0, "density": 1e-6, "rayleigh_mass": 0.0, "rayleigh_stiffness": 0.0,
        "gravity": np.zeros(3), "stiffness_scale": np.ones(elements), "point_mass": np.zeros(elements + 1),
    }  # fmt: skip
    return fem.Material(**(values | changes))


def pushed(force: np.ndarray, rows: int, elements: int = 20) -> SectionLoads:
    """A force [N] on the tip in every row."""
    none = np.zeros((1, rows))
    return SectionLoads(np.tile(force, (1, rows, 1, 1)), none, none, np.zeros((1, rows, 3)), (elements,))


STIFFNESS = YOUNG * (2.0 * HALF) ** 4 / 12.0  # of bending


def test_an_end_load_bends_a_cantilever_as_bisshopp_and_drucker_found():
    """P L^2 / E I = 2 moves the tip by 0.49346 and 0.16064 lengths (1945, Q. Appl. Math. 3:272, by their integrals)."""
    motion = NativeRod(*bar(), TIME_STEP, threads=1, integrator="quasi-static")
    steps, load = 4, 2.0 * STIFFNESS / LENGTH**2
    force = np.linspace(0.0, load, steps + 1)[:, None, None] * np.array([1.0, 0.0, 0.0])
    loads = pushed(np.zeros(3), steps + 1)._replace(force=force[None])
    found = motion.rollout(bar_material(), np.zeros((1, steps, 0)), loads=loads)
    assert found.converged.all()
    tip = found.position[0, -1, 0]
    assert tip[0] / LENGTH == pytest.approx(0.49346, rel=2e-3)
    assert 1.0 - tip[2] / LENGTH == pytest.approx(0.16064, rel=4e-3)


@pytest.mark.slow
def test_a_bar_sags_as_a_chain_of_mujoco():
    """Fifty rigid links with springs of E I between them, half a link at both ends, under their own weight: a tip that
    hangs down by two thirds of the length is where ours is, within 1 %."""
    mujoco = pytest.importorskip("mujoco")
    links, spring = 50, STIFFNESS * 50 / LENGTH
    link, bodies = LENGTH / links, ""
    for number in range(links):
        half = link / 4.0 if number == links - 1 else link / 2.0
        bodies += f"""<body pos="{link if number else link / 2.0} 0 0">
            <joint type="hinge" axis="0 1 0" stiffness="{spring}" damping="{0.03 * spring}"/>
            <geom type="box" pos="{half} 0 0" size="{half} {HALF} {HALF}" density="{DENSITY}" contype="0"/>"""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.005" gravity="0 0 -9.81" integrator="implicitfast"/>
        <worldbody>{bodies}{"</body>" * links}</worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    for _ in range(1600):
        mujoco.mj_step(model, data)
    theirs = data.xpos[-1] + data.xmat[-1].reshape(3, 3)[:, 0] * link / 2.0
    rest = NativeRod(*bar(), TIME_STEP, threads=1, integrator="quasi-static")
    found = rest.rollout(bar_material(density=DENSITY, gravity=np.array([-9.81, 0.0, 0.0])), np.zeros((1, 1, 0)))
    x, _, z = found.position[0, -1, 0]
    assert found.converged.all()
    np.testing.assert_allclose([z, 0.0, x], theirs, atol=0.01 * LENGTH)


def test_a_bar_swings_at_its_first_frequency():
    """1.8751^2 sqrt(E I / rho A L^4), of a bar that is let go; shear and rotary inertia take less than 1 %."""
    system, points = bar()
    shape = 1.8751041**2 * np.sqrt(STIFFNESS / (DENSITY * 4.0 * HALF**2 * LENGTH**4))
    period, steps = 2.0 * np.pi / shape, 200
    step = NativeRod(system, points, 2.0 * period / steps, threads=1, integrator="sdirk2")
    small = pushed(0.05 * STIFFNESS / LENGTH**2 * np.array([1.0, 0.0, 0.0]), steps + 1)
    small.force[:, 1:] = 0.0
    found = step.rollout(bar_material(density=DENSITY), np.zeros((1, steps, 0)), start=np.zeros(0), loads=small)
    way = found.position[0, :, 0, 0]
    crossings = np.flatnonzero(np.diff(np.sign(way)))
    shares = way[crossings] / (way[crossings] - way[crossings + 1])
    assert 2.0 * np.mean(np.diff(crossings + shares)) * 2.0 / steps == pytest.approx(1.0, abs=0.01)


def test_coupled_bending_twists_the_tip():
    """A small load at the tip turns it by the compliance of the section times the integral of the moment, F L^2 / 2."""
    force, twist = 1e-3 * STIFFNESS / LENGTH**2, 0.3
    law = fem.BodyEffects(bending=fem.BendingLaw(0.0, 0.2, 0.1, twist, -0.1))
    rest = NativeRod(*bar(), TIME_STEP, threads=1, integrator="quasi-static")
    loads = pushed(np.array([0.0, force, 0.0]), 2)
    found = rest.rollout(bar_material(effects=law), np.zeros((1, 1, 0)), loads=loads).position[0, -1]
    body = bar()[0].body
    plain = np.array([STIFFNESS, STIFFNESS, 0.5 * YOUNG * body.torsion_constant[0]])
    coupling = np.array([[np.exp(-0.1), 0.1, twist], [0.1, np.exp(0.1), -0.1], [twist, -0.1, 1.0]])
    section = coupling * np.sqrt(plain[:, None] * plain)
    turn = np.linalg.solve(section, [-force * LENGTH**2 / 2.0, 0.0, 0.0])
    assert (found[1] - found[0])[1] / HALF == pytest.approx(turn[2], rel=1e-3)


@pytest.mark.parametrize(("c", "stretch"), [(-1.0, 0.03), (0.7, 0.2), (1.5, 0.35)])
def test_fibres_stiffen_or_soften_with_stretch(c, stretch):
    """Pulled along its axis a bar answers E A times the integral of (r - h)^2, h = 3 c x / 2, r^2 = 1 + h^2. At the
    last stretch the polynomial 1 - 3 c x is below zero."""
    area = 4.0 * HALF**2
    force = YOUNG * area * quad(lambda x: (np.hypot(1.0, 1.5 * c * x) - 1.5 * c * x) ** 2, 0.0, stretch)[0]
    law = fem.BodyEffects(bending=fem.BendingLaw(c))
    rest = NativeRod(*bar(), TIME_STEP, threads=1, integrator="quasi-static")
    found = rest.rollout(bar_material(effects=law), np.zeros((1, 1, 0)), loads=pushed(np.array([0.0, 0.0, force]), 2))
    assert found.position[0, -1, 0, 2] / LENGTH - 1.0 == pytest.approx(stretch, rel=1e-6)


def test_rows_at_rest_take_few_solves():
    """Commands that move as slowly as recorded ones."""
    way = 3e-3 * (1.0 - np.cos(np.linspace(0.0, 3.0, 60)))[:, None] * np.array([1.0, 0.3, 0.0])
    found = engine("quasi-static").rollout(materials(9), way, start=way[0])
    assert found.converged.all()
    assert np.mean(found.solves) / len(way) <= 4.0
    assert np.ptp(found.position[:, :, 0, 0], axis=1).min() > 3e-3


def test_a_load_bends_a_thin_bar_at_once_in_few_solves():
    """A bar 200 times as long as thick, bent by P L^2 / E I = 3 from its straight shape (Bisshopp and Drucker: 0.6033
    lengths). With stresses of second order in an iteration's turn 30 solves are too few."""
    half = LENGTH / 400.0
    body = fem.uniform_rod(LENGTH, half, half, 20)
    tip = fem.attach(body, np.array([[0.0, 0.0, LENGTH]]))
    motion = NativeRod(fem.System(body, fem.without_cables()), tip, TIME_STEP, threads=1, integrator="quasi-static")
    load = 3.0 * YOUNG * (2.0 * half) ** 4 / 12.0 / LENGTH**2
    found = motion.rollout(bar_material(), np.zeros((1, 1, 0)), loads=pushed(np.array([0.0, load, 0.0]), 2))
    assert found.converged.all()
    assert found.position[0, -1, 0, 1] / LENGTH == pytest.approx(0.6033, rel=3e-3)
    assert found.solves[0] <= 12


@pytest.mark.slow
def test_equilibria_are_found_as_fast_by_both_engines():
    """The thin bar of the test before, and bodies with cables: the same numbers in as many solves, but for one."""
    half = LENGTH / 400.0
    body = fem.uniform_rod(LENGTH, half, half, 20)
    thin, points = fem.System(body, fem.without_cables()), fem.attach(body, np.array([[0.0, 0.0, LENGTH]]))
    load = np.array([0.0, 3.0 * YOUNG * (2.0 * half) ** 4 / 12.0 / LENGTH**2, 0.0])
    force = np.zeros((21, 6))
    force[-1, :3] = load
    compared = (
        (thin, points, [bar_material()], np.zeros((1, 0)), force, pushed(load, 1)),
        (*uneven_rod(), [rows_of(materials(3), k) for k in range(BATCH)], 2.0 * displacements(4)[:, 0], 0.0, None),
    )
    for system, shown, each, start, wrench, loads in compared:
        motion = NativeRod(system, shown, TIME_STEP, threads=1)

        @jax.jit
        def settle(material, start, system=system, wrench=wrench):
            return fem.static_equilibrium(system, fem.prepare(system, material), start, wrench)

        for material, commands in zip(each, start, strict=True):
            state, info = settle(material, commands)
            found = motion.rollout(material, commands[None], start=commands, steps=0, loads=loads)
            assert info.converged
            assert info.iterations <= 14
            position = fem.point_positions(shown, state.position, state.orientation)
            np.testing.assert_allclose(position, found.position[0, 0], rtol=0.0, atol=1e-8)
            np.testing.assert_allclose(state.tension, found.tension[0, 0], rtol=0.0, atol=1e-6)


def test_friction_of_rows_at_rest_keeps_its_path():
    """A cable that is pulled and let go again: its tension at the same command differs by twice its friction."""
    up = np.linspace(1e-3, 4e-3, 8)
    way = np.concatenate([up, up[::-1][1:]])[:, None] * np.array([0.0, 0.0, 1.0])
    material = materials(10)
    plain = engine("quasi-static").rollout(material, way)
    found = engine("quasi-static").rollout(material._replace(effects=cases.rubbing(11)), way)
    assert found.converged.all()
    there, back = slice(3, 8), slice(13, 8, -1)
    gap = found.tension[:, there, 2] - found.tension[:, back, 2]
    assert np.all(gap > 1e-3)
    np.testing.assert_allclose(plain.tension[:, there, 2], plain.tension[:, back, 2], rtol=1e-3)
    assert np.mean(found.solves) / len(way) <= 6.0


def test_a_row_at_rest_that_a_jump_leads_astray_is_found_from_the_undeformed_body():
    """Two rows of long pulls, each by other cables; Newton's method from the first row misses the second."""
    way = 12.0 * displacements(105)[:, :2]
    way[:, 0] = np.roll(way[:, 1], 1, axis=1)
    material, way = rows_of(materials(5), 4), way[4]
    found = engine("quasi-static").rollout(material, way)
    assert found.converged.all()
    alone = engine().rollout(material, np.zeros((1, 3)), start=way[1], steps=0)
    np.testing.assert_allclose(found.position[0, -1], alone.position[0, 0], rtol=0.0, atol=1e-6)


def test_opposed_cables_press_a_bar_together():
    """Four cables through guides at every station, pulled alike to half of the bar's length, under a slight weight to
    the side: the bar stays straight, shorter by what was pulled, and each cable holds a quarter of E A e."""
    elements, pull, area = 20, 0.5 * LENGTH, 4.0 * HALF**2
    body, side = fem.uniform_rod(LENGTH, HALF, HALF, elements), HALF * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    anchors = np.concatenate([side, np.zeros((4, 1))], axis=1)
    guides = [anchor + body.station[1:, None] * np.array([0.0, 0.0, 1.0]) for anchor in anchors]
    system, tip = fem.System(body, fem.cable_layout(body, anchors, guides)), fem.attach(body, [[0.0, 0.0, LENGTH]])
    material = bar_material(elements, density=DENSITY, rayleigh_stiffness=0.02, gravity=np.array([0.002, 0.0, 0.0]))
    way = np.minimum(np.linspace(0.0, 2.0 * pull, 200), pull)[:, None] * np.ones(4)
    found = NativeRod(system, tip, TIME_STEP, threads=1, integrator="sdirk2").rollout(material, way)
    assert not found.diverged.any()
    np.testing.assert_allclose(found.position[0, -1, 0], [0.0, 0.0, LENGTH - pull], rtol=0.0, atol=1e-3 * LENGTH)
    np.testing.assert_allclose(found.tension[0, -1], 0.25 * YOUNG * area * pull / LENGTH, rtol=2e-3)


@pytest.mark.parametrize("integrator", ANYTHING)
@pytest.mark.parametrize("effects", [cases.all_effects(7), cases.rubbing(8)], ids=["effects", "friction"])
def test_lane_batch_and_threads_do_not_matter(integrator, effects):
    """Bit for bit: alone, in any order, on two threads; and a batch without effects after one with them."""
    material, displacement = materials(7), displacements(8)
    extended, start, one = material._replace(effects=effects), displacement[:, 0], engine(integrator)
    before = one.rollout(material, displacement)
    whole = one.rollout(extended, displacement, start=start)
    assert np.abs(whole.position - before.position).max() > 1e-4, "the effects do nothing"
    assert_same(before, one.rollout(material, displacement))
    order = np.random.default_rng(9).permutation(BATCH)
    other = engine(integrator, threads=2)
    assert_same(rows_of(whole, order), other.rollout(rows_of(extended, order), displacement[order], start=start[order]))
    assert_same(rows_of(whole, slice(4, 5)), one.rollout(rows_of(extended, 4), displacement[4], start=start[4]))


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ANYTHING)
def test_single_precision(integrator):
    """All effects, from equilibrium: rounding counts for 10 um."""
    material, displacement = materials(12)._replace(effects=cases.all_effects(13)), displacements(14)
    double, single = (
        engine(integrator, precision=precision).rollout(material, displacement, start=displacement[:, 0])
        for precision in ("float64", "float32")
    )
    np.testing.assert_allclose(single.position, double.position, rtol=0.0, atol=1e-5)
    assert single.converged.all()
    assert not single.diverged.any()


@pytest.mark.slow
def test_number_of_lanes_does_not_matter():
    """Bit for bit: registers of another width give the same numbers."""
    narrow = NativeRod(*uneven_rod(), TIME_STEP, threads=1, lanes=2)
    material, displacement = materials(7), displacements(8)
    assert_same(engine().rollout(material, displacement), narrow.rollout(material, displacement))


def test_null_effects_change_nothing():
    material, displacement = materials(4), displacements(5)
    effects = cases.all_effects(6)
    null = rows_of(effects, slice(None))
    null = fem.BodyEffects(
        bending=fem.BendingLaw(*(np.zeros(BATCH) for _ in range(5))),
        viscoelasticity=effects.viscoelasticity._replace(fraction=np.zeros(BATCH)),
        softening_rate=np.zeros(BATCH),
        drag=np.zeros(BATCH),
        wall=fem.Wall(np.zeros(BATCH), *effects.wall[1:]),
        cable_compliance=np.zeros(BATCH),
    )
    run, start = engine("sdirk2").rollout, displacement[:, 0]
    plain, present = (run(material._replace(effects=e), displacement, start=start) for e in (fem.BodyEffects(), null))
    np.testing.assert_allclose(plain.position, present.position, rtol=0.0, atol=1e-13)


def test_a_command_that_is_no_number_is_a_lost_rollout():
    """It would be a slack cable: of the way, of its beginning, and of a session, whose other lanes go on."""
    material, displacement = materials(10, 4), displacements(11, 4)
    lost, start = displacement.copy(), np.zeros_like(displacement[:, 0])
    lost[1, 3, 0], start[2, 1] = np.nan, np.nan
    found = engine().rollout(material, lost, before=start)
    np.testing.assert_array_equal(found.diverged, [False, True, True, False])
    assert not engine().rollout(material, lost, steps=3).diverged.any()  # it comes later
    session = RodSession(engine(), 4)
    session.reset(np.arange(4), material)
    np.testing.assert_array_equal(session.advance(lost).diverged, [False, True, False, False])
    again = session.reset(np.array([1, 2]), rows_of(material, slice(1, 3)), start=start[1:3])
    np.testing.assert_array_equal(again.diverged, [False, True])


@pytest.mark.parametrize("integrator", ANYTHING)
def test_a_lost_rollout_leaves_its_neighbours_alone(integrator):
    """A parameter that is not a number, and one far too soft, are marked and touch no other lane."""
    material, displacement = materials(10), displacements(11)
    good = engine(integrator).rollout(material, displacement)
    modulus, way = material.young_modulus.copy(), displacement.copy()
    modulus[2], modulus[3] = np.nan, 1e-6
    way[3] += 0.5
    found = engine(integrator).rollout(material._replace(young_modulus=modulus), way)
    assert found.diverged[2]
    for value in (found.position, found.tension):
        assert np.all(np.isfinite(value))
    keep = [0, 1, 4, 5]
    np.testing.assert_array_equal(found.position[keep], good.position[keep])
    np.testing.assert_array_equal(found.diverged[keep], good.diverged[keep])


def test_rows_steps_and_shared_commands():
    """Strides, prefixes and shared commands are slices of the same motion."""
    material, displacement = materials(12), displacements(13)
    run = engine().rollout
    shared = run(material, displacement[0])
    each = run(material, np.repeat(displacement[:1], BATCH, axis=0))
    np.testing.assert_array_equal(shared.position, each.position)
    strided = run(material, displacement[0], stride=4)
    np.testing.assert_array_equal(strided.position, shared.position[:, ::4])
    np.testing.assert_array_equal(strided.tension, shared.tension[:, ::4])
    np.testing.assert_array_equal(run(material, displacement[0], steps=5).position, shared.position[:, :6])


def test_cables_that_share_a_route():
    """Two equal cables make the tension problem singular; they share what one would pull."""
    system, points = uneven_rod()
    twice = fem.CableLayout(*(np.concatenate([part, part[:1]]) for part in system.cables))
    material = materials(14)
    pull = np.linspace(0.0, 4e-3, STEPS)[:, None] * np.array([1.0, 0.5, 0.0, 1.0])
    found = NativeRod(system._replace(cables=twice), points, TIME_STEP, threads=1).rollout(material, pull)
    one = engine().rollout(material, pull[:, :3])
    assert found.converged.all()
    np.testing.assert_allclose(found.position, one.position, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.tension[..., 0] + found.tension[..., 3], one.tension[..., 0], atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"drive": np.zeros((STEPS, 2))}, "3 drives"),
        ({"start": np.zeros(4)}, "3 drives"),
        ({"drive": np.zeros((3, STEPS, 3))}, "batch axes"),
        ({"density": np.zeros((2, 2))}, "density"),
    ],
)
def test_bad_shapes_are_named(change, message):
    """What does not fit is said in one line."""
    material = materials(15, 2)
    arguments = {"drive": np.zeros((STEPS, 3))} | change
    if "density" in change:
        material = material._replace(density=arguments.pop("density"))
    with pytest.raises(InputError, match=message):
        engine().rollout(material, **arguments)


def test_bad_settings_are_named():
    """Precision and threads."""
    with pytest.raises(InputError, match="float16"):
        NativeRod(*uneven_rod(), TIME_STEP, precision="float16")
    with pytest.raises(InputError, match="threads"):
        NativeRod(*uneven_rod(), TIME_STEP, threads=0)
