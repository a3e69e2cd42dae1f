"""Forces and energies of rollouts against weight, momentum and work."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.balance import Balance, check_effects, layered_balance

SILICONE = {"young_modulus": 0.3e6, "poisson_ratio": 0.45, "density": 1050.0}
GRAVITY = np.array([1.0, -9.81, 2.0])
ROWS = 101


@pytest.fixture(scope="module")
def balance(trunk):
    """Function (material, start, states, time step, clamped=1) -> balance of a run of `trace`, with all its states."""
    runs = {}

    def run(material, start, states, time_step, clamped=1) -> Balance:
        system = trunk._replace(clamped_stations=clamped)
        if clamped not in runs:
            runs[clamped] = jax.jit(lambda m, *given: layered_balance(system, fem.prepare(system, m), *given))
        position = jnp.concatenate([start.position[None], states.position])
        tension = jnp.concatenate([start.tension[None], states.tension])
        return runs[clamped](material, position, tension, time_step, start.velocity)

    return run


def total_mass(prepared: fem.Prepared) -> float:
    """Mass of the body [kg]: a rigid motion of it all has the sum of all entries."""
    return float(jnp.sum(prepared.mass.diagonal) + 2.0 * jnp.sum(prepared.mass.lower))


def pulls_on_body(trunk: fem.System, positions: np.ndarray, tension: np.ndarray) -> np.ndarray:
    """Sum of the cables' forces on the body [N]: each pulls its first guide towards its anchor, the rest cancels."""
    layout = trunk.cables
    guide = np.einsum("ck,rcki->rci", layout.guide_weight[:, 0], positions[:, layout.guide_node[:, 0]])
    towards = layout.anchor - guide
    return np.einsum("rc,rci->ri", tension, towards / np.linalg.norm(towards, axis=-1, keepdims=True))


def held(states: fem.State) -> fem.State:
    """A hundred rows of one state."""
    return jax.tree.map(lambda value: jnp.broadcast_to(value, (ROWS - 1, *value.shape)), states)


@pytest.mark.slow
def test_the_base_carries_the_weight(trunk, settle, balance, prepare):
    """At rest: against the weight, and with a moment that holds it at its centre of mass."""
    material = fem.material(trunk, **SILICONE, gravity=GRAVITY)
    prepared = prepare(trunk, material)
    start, info = settle(trunk, material, [-1.0, -1.0, -1.0])
    assert info.converged
    found = balance(material, start, held(start), 0.01)
    weight = total_mass(prepared) * GRAVITY
    np.testing.assert_allclose(found.base_force, np.tile(-weight, (ROWS, 1)), rtol=1e-5)
    moment = np.cross(np.asarray(start.position), np.asarray(prepared.weight)).sum(axis=0)
    np.testing.assert_allclose(found.base_moment, np.tile(-moment, (ROWS, 1)), rtol=1e-4, atol=1e-6)
    assert np.abs(found.contact_force).max() < 1e-5 * np.linalg.norm(weight)
    np.testing.assert_array_equal(found.kinetic_energy, 0.0)


@pytest.mark.slow
def test_momentum_changes_by_what_acts(trunk, trace, balance, prepare):
    """Base, cables, weight and drag make up the change of momentum in every step of a moving body."""
    material = fem.material(trunk, **SILICONE, rayleigh_mass=2.0, rayleigh_stiffness=0.01, gravity=GRAVITY)
    material = material._replace(point_mass=jnp.zeros(7).at[6].set(0.01))
    start, time_step = fem.state_at_rest(trunk), 0.01
    pulls = 5e-3 * np.sin(np.arange(1, ROWS)[:, None] / 20.0 + np.arange(3)) ** 2
    states, info, energies, momentum = trace(material, start, pulls, time_step)
    assert not np.any(info.diverged)
    found = balance(material, start, states, time_step)
    before = np.concatenate([start.position[None], states.position[:-1]])
    cables = pulls_on_body(trunk, before, np.asarray(states.tension))
    weight = total_mass(prepare(trunk, material)) * GRAVITY
    change = np.diff(np.concatenate([np.zeros((1, 3)), momentum]), axis=0) / time_step
    expected = change - cables - weight + 2.0 * np.asarray(momentum)
    assert np.abs(cables).max() > 1.0
    np.testing.assert_allclose(found.base_force[1:], expected, atol=1e-8)
    assert np.abs(found.contact_force).max() < 1e-8
    np.testing.assert_allclose(found.elastic_energy[1:], energies.elastic, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.kinetic_energy[1:], energies.kinetic, rtol=1e-9, atol=1e-15)


@pytest.mark.slow
def test_work_becomes_energy_or_is_lost_to_damping(trunk, trace, balance):
    """What the time stepping loses besides halves with the time step, and is small."""
    material = fem.material(trunk, **SILICONE, rayleigh_mass=2.0, rayleigh_stiffness=0.002, gravity=GRAVITY)
    start, lost, worked = fem.state_at_rest(trunk), [], []
    for time_step, rows in ((0.002, 50), (0.001, 100)):
        time = time_step * np.arange(1, ROWS)
        pulls = 0.1 * time[:, None] * np.array([1.0, 0.4, 0.0])
        states, _, _, _ = trace(material, start, pulls, time_step)
        found = balance(material, start, states, time_step)
        lost.append(float(found.other_loss[rows]))
        worked.append(float(found.cable_work[rows]))
        assert found.damping_loss[rows] > 0.05 * worked[-1]
        # T times the shortening of a taut cable: the work at its other end.
        taut = np.asarray(states.tension) > 0.0
        rate = np.where(taut, np.diff(np.concatenate([np.zeros((1, 3)), pulls]), axis=0), 0.0)
        ends = np.sum(np.asarray(states.tension) * rate, axis=1)[:rows].sum()
        assert worked[-1] == pytest.approx(ends, rel=0.05)
    assert 0.0 < lost[1] < 0.05 * worked[1]
    assert lost[1] / lost[0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.slow
def test_nothing_acts_on_a_body_in_free_flight(trunk, trace, balance):
    """It tumbles, vibrates and falls; only its weight acts."""
    material = fem.material(trunk, **SILICONE, rayleigh_stiffness=0.001, gravity=GRAVITY)
    start = fem.state_at_rest(trunk)
    start = start._replace(velocity=jnp.cross(jnp.array([3.0, -2.0, 5.0]), start.position))
    states, _, _, _ = trace(material, start, np.full((100, 3), -10.0), 0.002, clamped=0)
    found = balance(material, start, states, 0.002, clamped=0)
    np.testing.assert_array_equal(found.base_force, 0.0)
    assert np.abs(found.contact_force).max() < 1e-8
    np.testing.assert_array_equal(found.cable_work, 0.0)
    assert np.all(np.diff(found.total_energy) < 1e-9)


def test_friction_of_the_cables_is_refused():
    with pytest.raises(InputError, match="capstan friction"):
        check_effects(fem.BodyEffects(capstan_friction=jnp.asarray(0.1)))
