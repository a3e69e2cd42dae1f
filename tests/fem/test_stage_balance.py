"""Forces and energies of steps of SDIRK2, against momentum, work, and those that implicit Euler's states tell."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.balance import layered_balance
from rfdropo_bayes.fem.dynamics import mass_times
from rfdropo_bayes.fem.pushing import layered_spheres, push_scene
from rfdropo_bayes.fem.rigid_body import Cube, cube_at
from rfdropo_bayes.fem.stage_balance import stepped_balance

GRAVITY = np.array([1.0, -9.81, 2.0])
SILICONE = {"young_modulus": 0.3e6, "poisson_ratio": 0.45, "density": 1050.0, "gravity": GRAVITY}
SIDE, PLATE, DISTANCE = 0.03, -0.055, 0.005


def path(system, prepared, state, displacement, time_step, integrator, **around):
    """State after every step."""
    state = fem.dynamics.remembering(system, prepared, state, around.get("scene"), integrator)

    def one(before, given):
        after, info = fem.step(system, prepared, before, given, time_step, integrator=integrator, **around)
        return after, (after, info)

    states, info = jax.jit(lambda: jax.lax.scan(one, state, jnp.asarray(displacement))[1])()
    assert not np.any(info.diverged)
    assert np.all(info.converged)
    return states


def momenta(system, prepared, states) -> np.ndarray:
    return np.asarray(jax.vmap(lambda v: mass_times(system, prepared, v).sum(axis=0))(states.velocity))


@pytest.mark.slow
def test_base_and_weight_change_the_momentum_of_a_body_that_is_let_go(trunk):
    """Slack cables, no drag: in every step, to rounding; and nothing is said to touch it."""
    prepared = fem.prepare(trunk, fem.material(trunk, **SILICONE, rayleigh_stiffness=0.01))
    slack = np.full((40, 3), -0.1)
    start = fem.state_at_rest(trunk)._replace(commanded=jnp.full(3, -0.1))
    momentum = momenta(trunk, prepared, path(trunk, prepared, start, slack, 0.01, "sdirk2"))
    found = jax.jit(partial(stepped_balance, trunk, prepared, integrator="sdirk2"))(start, slack, 0.01)
    weight = np.asarray(prepared.weight).sum(axis=0)
    change = np.diff(np.concatenate([np.zeros((1, 3)), momentum]), axis=0) / 0.01
    assert np.abs(change).max() > 0.1 * np.linalg.norm(weight)
    np.testing.assert_allclose(found.base_force[1:], change - weight, atol=1e-8)
    np.testing.assert_allclose(found.base_force[0], -np.asarray(prepared.weight)[:4].sum(axis=0), atol=1e-8)
    assert np.abs(found.contact_force).max() < 1e-8
    np.testing.assert_array_equal(found.cable_work, 0.0)


@pytest.mark.slow
def test_stepwise_and_from_states_implicit_euler_is_the_same(trunk):
    prepared = fem.prepare(trunk, fem.material(trunk, **SILICONE, rayleigh_mass=2.0, rayleigh_stiffness=0.01))
    pulls = 5e-3 * np.sin(np.arange(1, 31)[:, None] / 20.0 + np.arange(3)) ** 2
    start = fem.state_at_rest(trunk)
    states = path(trunk, prepared, start, pulls, 0.01, "euler")
    position = jnp.concatenate([start.position[None], states.position])
    tension = jnp.concatenate([start.tension[None], states.tension])
    told = layered_balance(trunk, prepared, position, tension, 0.01)
    found = stepped_balance(trunk, prepared, start, jnp.asarray(pulls), 0.01, "euler")
    for name, one, other in zip(told._fields, found, told, strict=True):
        scale = max(1e-3, float(np.abs(other).max()))
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-8 * scale, err_msg=name)


@pytest.mark.slow
def test_little_is_lost_in_steps_of_second_order(trunk):
    """Halving the step changes what is lost by 0.2 % of the work, where it changes what implicit Euler loses by ten
    times as much. The 0.6 % that stay are of the corotational forces, which have no exact potential."""
    material = fem.material(trunk, **SILICONE, rayleigh_mass=2.0, rayleigh_stiffness=0.01)
    prepared, share = fem.prepare(trunk, material), {}
    start = fem.state_at_rest(trunk)._replace(commanded=jnp.zeros(3))
    for integrator in ("euler", "sdirk2"):
        run = jax.jit(partial(stepped_balance, trunk, prepared, integrator=integrator))
        lost = []
        for time_step, rows in ((0.004, 50), (0.002, 100)):
            time = time_step * np.arange(1, rows + 1)
            pulls = 0.1 * time[:, None] ** 2 * np.array([1.0, 0.4, 0.0])
            given = start if integrator == "sdirk2" else start._replace(commanded=None)
            found = run(given, pulls, time_step)
            lost.append(float(found.other_loss[-1] / found.cable_work[-1]))
            assert found.damping_loss[-1] > 0.0
        share[integrator] = lost
    assert abs(share["sdirk2"][1]) < 0.01
    assert abs(share["sdirk2"][0] - share["sdirk2"][1]) < 2e-3
    assert abs(share["euler"][0] - share["euler"][1]) > 2e-2


@pytest.mark.slow
def test_the_cube_is_pushed_by_what_touches_the_body(trunk):
    """Without friction only the body moves a cube along the plate, impacts included."""
    up = np.array([0.0, 1.0, 0.0])
    scene = push_scene(layered_spheres(trunk.body), plate_normal=up, plate_height=PLATE, contact_distance=DISTANCE)
    place = np.array([0.004, PLATE + DISTANCE + SIDE / 2, 0.09])
    cube = Cube(*map(jnp.asarray, (0.05, SIDE, SIDE / np.sqrt(6.0), 0.0)))
    material = fem.material(trunk, **{**SILICONE, "gravity": np.array([0.0, -9.81, 0.0])}, rayleigh_stiffness=0.01)
    prepared = fem.prepare(trunk, material)
    start = fem.state_at_rest(trunk)._replace(cube=cube_at(jnp.asarray(place), 0.0, scene.plate_normal))
    pulls = np.linspace(0.0, 8e-3, 60)[:, None] * np.array([0.0, 0.0, 1.0])
    around = {"scene": scene, "cube": cube}
    states = path(trunk, prepared, start, pulls, 0.01, "sdirk2", **around)
    found = jax.jit(partial(stepped_balance, trunk, prepared, integrator="sdirk2", **around))(start, pulls, 0.01)
    pushed = 0.05 * np.diff(np.concatenate([np.zeros((1, 3)), states.cube.velocity]), axis=0) / 0.01
    along = np.asarray(found.contact_force)[1:, [0, 2]]
    assert np.abs(along).max() > 0.01
    np.testing.assert_allclose(pushed[:, [0, 2]], -along, atol=1e-8)


def test_friction_of_the_cables_is_refused_here_too(trunk):
    material = fem.material(trunk, **SILICONE)._replace(effects=fem.BodyEffects(coulomb_friction=jnp.asarray(0.1)))
    with pytest.raises(InputError, match="coulomb friction"):
        stepped_balance(
            trunk, fem.prepare(trunk, material), fem.state_at_rest(trunk), jnp.zeros((1, 3)), 0.01, "sdirk2"
        )
