"""Effects of the body against closed forms. One compiled function with every effect present serves all tests."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.fem.cable_friction import wrap_angles
from rfdropo_bayes.fem.cables import guide_matrix, segments
from rfdropo_bayes.fem.dynamics import remembering
from rfdropo_bayes.fem.effects import BodyEffects
from rfdropo_bayes.fem.rollouts import roll
from rfdropo_bayes.fem.surroundings import WALL_SOFTNESS, drag_areas, section_load

LENGTH, HALF, LAYERS = 0.4, 0.004, 8
MODULUS, AREA = 1e6, (2 * HALF) ** 2
EI = MODULUS * AREA * HALF**2 / 3.0
NULL = BodyEffects(
    bending=fem.BendingLaw(),
    viscoelasticity=fem.Viscoelasticity(0.0, 1.0),
    softening_rate=0.0,
    drag=0.0,
    wall=fem.Wall(0.0, 0.5, 0.0),
    cable_compliance=0.0,
    coulomb_friction=0.0,
    capstan_friction=0.0,
)


@functools.cache
def bar() -> fem.System:
    """A slender bar with one cable on its axis, and one that zigzags about it."""
    body = fem.uniform_body(LENGTH, HALF, HALF, LAYERS)
    height = np.linspace(0.05, LENGTH, 8)
    straight = np.array([[0.0, 0.0, LENGTH]])
    side = 0.003 * (-1.0) ** np.arange(len(height)) * np.linspace(0.4, 1.0, len(height))
    zigzag = np.column_stack([side, np.zeros_like(side), height])
    return fem.System(body, fem.cable_layout(body, np.array([[0.0, 0.0, -0.05]] * 2), [straight, zigzag]))


def material(effects: BodyEffects, density=100.0, gravity=(0.0, 0.0, 0.0)) -> fem.Material:
    plain = fem.material(bar(), young_modulus=MODULUS, poisson_ratio=0.0, density=density, gravity=gravity)
    return plain._replace(effects=jax.tree.map(lambda value: jnp.asarray(value, dtype=float), effects))


SLACK = np.array([-0.5, -0.5])


@jax.jit
def settled(material, displacement, force):
    return fem.static_equilibrium(bar(), fem.prepare(bar(), material), displacement, force)


@jax.jit
def moved(material, state, displacement, time_step, force):
    """The body held at its base through 100 steps: positions of the tip, tensions, last state."""
    tip = fem.attach(bar().body, np.array([[0.0, 0.0, LENGTH]]))
    prepared = fem.prepare(bar(), material)

    def take(before, commanded):
        return fem.step(bar(), prepared, before, commanded, time_step, force)

    rollout = roll(take, remembering(bar(), prepared, state), displacement[:, None, :], tip)
    return rollout.position[:, 0], rollout.tension, rollout.state, rollout.diverged


def move(effects, displacement=SLACK, time_step=0.01, force=None, state=None):
    displacement = np.broadcast_to(np.asarray(displacement, float), (100, 2))
    force = np.zeros((bar().body.nodes, 3)) if force is None else force
    state = fem.state_at_rest(bar()) if state is None else state
    found = moved(material(effects), state, displacement, time_step, force)
    assert not found[-1]
    return found[:3]


def tip_force(force) -> np.ndarray:
    """A force in equal parts on the nodes of the last station."""
    nodal = np.zeros((bar().body.nodes, 3))
    nodal[-4:] = np.asarray(force) / 4.0
    return nodal


def tip(effects, displacement=SLACK, force=(0.0, 0.0, 0.0)):
    """Tip in equilibrium relative to its place at rest, its four nodes, and the tensions."""
    nodal = force if np.ndim(force) == 2 else tip_force(force)
    state, info = settled(material(effects), np.asarray(displacement, float), nodal)
    assert info.converged
    nodes = np.asarray(state.position[-4:])
    return nodes.mean(0) - [0.0, 0.0, LENGTH], nodes, np.asarray(state.tension)


def bent(law: fem.BendingLaw, force):
    return tip(NULL._replace(bending=law), force=force)


@pytest.mark.slow
def test_anisotropy_divides_the_planes():
    """Deflections P L^3 / 3 EI in the two planes, EI exp(a / 2) and EI exp(-a / 2)."""
    load = 1e-4
    for axis, sign in ((0, 1.0), (1, -1.0)):
        force = load * np.eye(3)[axis]
        plain = bent(fem.BendingLaw(), force)[0][axis]
        changed = bent(fem.BendingLaw(anisotropy=0.6), force)[0][axis]
        np.testing.assert_allclose(plain, load * LENGTH**3 / (3 * EI), rtol=5e-3)
        np.testing.assert_allclose(changed / plain, np.exp(-0.3 * sign), rtol=2e-3)


def test_coupled_planes_and_twist():
    """Curvature is S^-1 M with S the matrix of EI and GJ: sideways deflection, and twist P L^2 / 2 of its entry."""
    load, cross, twist = 1e-5, 0.3, 0.2
    torsion = MODULUS / 2.0 * fem.solid_torsion_constant(HALF, HALF)
    root = np.sqrt([EI, EI, torsion])
    stiffness = (np.eye(3) + np.array([[0, cross, 0], [cross, 0, twist], [0, twist, 0]])) * root[:, None] * root
    compliance = np.linalg.inv(stiffness)
    # A force along x makes a moment about y, and rotation about x moves the tip against y.
    moved_tip, nodes, _ = bent(fem.BendingLaw(cross_plane=cross, twist_y=twist), (load, 0.0, 0.0))
    np.testing.assert_allclose(moved_tip[0], load * LENGTH**3 / 3 * compliance[1, 1], rtol=5e-3)
    np.testing.assert_allclose(moved_tip[1], -load * LENGTH**3 / 3 * compliance[0, 1], rtol=5e-3)
    along_x = nodes[1] - nodes[0]
    np.testing.assert_allclose(along_x[1] / along_x[0], load * LENGTH**2 / 2 * compliance[2, 1], rtol=2e-2)


def test_bending_stiffens_with_the_cube():
    """An end couple M = EI / L (a + k a^3) bends the bar by the angle a in all."""
    stiffening, lever = 20.0, np.zeros((bar().body.nodes, 3))
    lever[[-4, -2], 2], lever[[-3, -1], 2] = 0.5, -0.5
    force = 0.05
    _, nodes, _ = bent(fem.BendingLaw(stiffening=stiffening), force * lever)
    edge = nodes[1] - nodes[0]
    angle = np.arctan2(-edge[2], edge[0])
    moment = force * edge[0]  # the forces keep their direction, and the lever turns
    assert angle > 0.15
    np.testing.assert_allclose(moment * LENGTH / EI, angle + stiffening * angle**3, rtol=5e-3)


def test_cable_stretches_with_its_tension():
    """Displacement u = T (L / EA + c) of a cable on the axis of a bar."""
    compliance, pull = 3e-3, 1e-4
    _, _, tension = tip(NULL._replace(cable_compliance=compliance), (pull, -0.5))
    np.testing.assert_allclose(tension[0], pull / (LENGTH / (MODULUS * AREA) + compliance), rtol=1e-3)
    _, tensions, _ = move(NULL._replace(cable_compliance=compliance), (pull, -0.5), time_step=0.2)
    np.testing.assert_allclose(tensions[-1, 0], tension[0], rtol=1e-5)


def test_prony_branch_creeps():
    """Strain under a constant load: 1 - g / (1 + g) exp(-t / tau (1 + g)) of its last value."""
    fraction, time = 0.5, 0.4
    load = 1e-2
    effects = NULL._replace(viscoelasticity=fem.Viscoelasticity(fraction, time))
    position, _, _ = move(effects, time_step=0.01, force=tip_force((0.0, 0.0, load)))
    clock = 0.01 * np.arange(1, 101)
    expected = 1.0 - fraction / (1.0 + fraction) * np.exp(-clock / (time * (1.0 + fraction)))
    stretch = (np.asarray(position[:, 2]) - LENGTH) / (load * LENGTH / (MODULUS * AREA))
    np.testing.assert_allclose(stretch[20:], expected[20:], rtol=1e-2)  # the axial wave has died out by then


def test_softening_follows_the_clock():
    """Stretch under a constant load grows as exp(r t)."""
    rate, load = 0.05, 1e-2
    position, _, state = move(NULL._replace(softening_rate=rate), time_step=0.1, force=tip_force((0.0, 0.0, load)))
    stretch = (np.asarray(position[:, 2]) - LENGTH) / (load * LENGTH / (MODULUS * AREA))
    np.testing.assert_allclose(state.memory.clock, 10.0)
    np.testing.assert_allclose(stretch[[49, 99]], np.exp(rate * np.array([5.0, 10.0])), rtol=1e-3)


def wrap(position) -> np.ndarray:
    """Angles at the guides of the zigzag cable, by arc cosines."""
    layout = bar().cables
    points = np.einsum("gk,gki->gi", layout.guide_weight[1], np.asarray(position)[layout.guide_node[1]])
    step = np.diff(np.vstack([layout.anchor[1], points]), axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    return np.arccos(np.sum(step[1:] * step[:-1], axis=1))


@pytest.mark.parametrize("friction", [0.1, 0.5])
def test_capstan_ratio(friction):
    """T_tip / T_drive = exp(-mu sum of angles) when the cable is pulled, exp(+mu sum of angles) when it gives way."""
    effects = NULL._replace(capstan_friction=friction)
    pull = np.concatenate([np.linspace(0.0, 6e-3, 40), np.linspace(6e-3, 1e-3, 50), np.full(10, 1e-3)])
    displacement = np.column_stack([np.full(100, -0.5), pull])
    for steps, sign in ((40, -1.0), (100, 1.0)):
        short = np.where(np.arange(100)[:, None] < steps, displacement, displacement[steps - 1])
        _, _, state = move(effects, short, time_step=0.05)
        angles = wrap(state.position)
        assert angles.sum() > 0.5
        segment = np.asarray(state.memory.segment[1])
        np.testing.assert_allclose(segment[-1] / segment[0], np.exp(sign * friction * angles.sum()), rtol=2e-2)


def test_coulomb_friction_takes_its_force_at_every_guide_and_holds_it():
    """Seven guides before the last, each with its full force when the cable slides; at rest that stays."""
    force = 0.05
    effects = NULL._replace(coulomb_friction=force)
    for last, tolerance in ((100, 3e-3), (40, 1e-2)):
        pull = np.minimum(np.arange(1, 101) / last, 1.0) * 6e-3
        _, _, state = move(effects, np.column_stack([np.full(100, -0.5), pull]), time_step=0.05)
        segment = np.asarray(state.memory.segment[1])
        middle = 0.5 * (segment[1:] + segment[:-1])
        np.testing.assert_allclose(-np.diff(segment), force * middle / (middle + 0.1), rtol=tolerance)


def test_wrap_angles_agree_with_arc_cosines():
    layout = bar().cables
    state = fem.state_at_rest(bar())
    found = wrap_angles(segments(layout, jnp.asarray(guide_matrix(layout, bar().body.nodes)), state.position)[1])
    np.testing.assert_allclose(found[1, :-1], wrap(state.position), rtol=1e-4)


def test_drag_and_wall_forces():
    """-c A |v| v in all; a wall that is one-sided, and linear beyond its softness."""
    body = bar().body
    centre = np.column_stack([np.full(LAYERS + 1, 0.01), np.zeros(LAYERS + 1), body.station])
    velocity = np.tile([0.3, -0.4, 0.0], (LAYERS + 1, 1))
    fluid = section_load(body, BodyEffects(drag=100.0), jnp.asarray(centre), jnp.asarray(velocity))
    np.testing.assert_allclose(fluid.force.sum(0), -100.0 * 2 * HALF * LENGTH * 0.5 * velocity[0], rtol=1e-9)
    np.testing.assert_allclose(drag_areas(body).sum(), 2 * HALF * LENGTH)
    for depth, share in ((-2e-3, 0.0), (0.0, WALL_SOFTNESS / 4), (5e-3, 5e-3)):
        wall = BodyEffects(wall=fem.Wall(1e3, 0.01 - depth, 0.0))
        load = section_load(body, wall, jnp.asarray(centre), jnp.zeros_like(velocity))
        np.testing.assert_allclose(load.force.sum(0), [-1e3 * LENGTH * share, 0.0, 0.0], atol=1e-12)


@pytest.mark.slow
def test_terminal_velocity():
    """A free bar falls sideways no faster than sqrt(m g / c A)."""
    free = bar()._replace(clamped_stations=0)
    fluid = material(BodyEffects(drag=100.0), gravity=(9.81, 0.0, 0.0))
    prepared = fem.prepare(free, fluid)
    step = jax.jit(lambda state: fem.step(free, prepared, state, jnp.asarray([-5.0, -5.0]), 0.02)[0])
    state = fem.state_at_rest(free)
    for _ in range(40):
        state = step(state)
    expected = np.sqrt(100.0 * AREA * 9.81 / (100.0 * 2 * HALF))
    np.testing.assert_allclose(state.velocity[:, 0], expected, rtol=1e-3)
