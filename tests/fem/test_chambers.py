"""Chambers under pressure: closed forms of arcs, and both engines."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.fem.native.rod_engine import NativeRod

LENGTH, HALF, YOUNG = 0.2, 0.01, 1e6
AREA, MOMENT = 4.0 * HALF**2, 4.0 * HALF**4 / 3.0
CHAMBERS = {"middle": [[0.006, 0.0], [0.0, -0.005]], "ends": [[0.0, LENGTH], [0.05, 0.15]], "area": [3e-5, 4e-5]}
POINTS = np.array([[0.0, 0.0, 0.05], [0.0, 0.0, 0.15], [0.0, 0.0, LENGTH]])


def bar(elements: int = 20) -> tuple[fem.System, fem.PointMap, fem.Material]:
    body = fem.uniform_rod(LENGTH, HALF, HALF, elements)
    none = fem.cable_layout(body, np.zeros((0, 3)), [])
    system = fem.System(body, none, chambers=fem.chamber_layout(body, **CHAMBERS))
    damping = {"rayleigh_mass": 20.0, "rayleigh_stiffness": 0.02}
    material = fem.material(system, young_modulus=YOUNG, poisson_ratio=0.4, density=1000.0, **damping)
    return system, fem.attach(body, POINTS), material


def arcs(pressure: np.ndarray) -> np.ndarray:
    """Points on three arcs of constant strain and curvature, by exponentials of rigid motions."""
    thrust, place, turn, found = pressure * CHAMBERS["area"], np.zeros(3), np.eye(3), []
    for number in range(3):
        force = thrust * [1.0, 1.0 if number == 1 else 0.0]
        x, y = np.transpose(CHAMBERS["middle"])
        bend = np.array([np.sum(force * y), -np.sum(force * x), 0.0]) / (YOUNG * MOMENT)
        length = 0.1 if number == 1 else 0.05
        axis, angle = bend / max(np.linalg.norm(bend), 1e-30), np.linalg.norm(bend) * length
        cross = np.cross(np.eye(3), axis)  # [axis]x
        wide = np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
        mean = np.eye(3) + ((1.0 - np.cos(angle)) * cross + (angle - np.sin(angle)) * (cross @ cross)) / angle
        place = place + turn @ mean @ [0.0, 0.0, length * (1.0 + np.sum(force) / (YOUNG * AREA))]
        turn = turn @ (np.eye(3) + wide)
        found.append(place)
    return np.array(found)


@pytest.mark.parametrize("pressure", [[2e5, -1e5], [3e5, 4e5]])
def test_chambers_bend_a_bar_to_arcs(pressure):
    """At rest, and where a motion has died out; no other load."""
    system, points, material = bar()
    found = NativeRod(system, points, 0.01, threads=1, integrator="quasi-static").rollout(
        material, np.array([[pressure]])
    )
    assert found.converged.all()
    expected = arcs(np.array(pressure))
    assert np.abs(expected[:, :2]).max() > 0.03
    np.testing.assert_allclose(found.position[0, 1], expected, atol=2e-5)
    moving = NativeRod(system, points, 0.02, threads=1, integrator="sdirk2")
    last = moving.rollout(material, np.tile(pressure, (1, 300, 1)), stride=300)
    np.testing.assert_allclose(last.position[0, 1], found.position[0, 1], atol=1e-7)
    start = moving.rollout(material, np.zeros((1, 0, 2)), start=np.array([pressure]))
    assert start.imbalance[0] < 1e-9
    np.testing.assert_allclose(start.position[0, 0], found.position[0, 1], atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["euler", "sdirk2", "quasi-static"])
def test_both_engines_give_the_same_numbers(integrator):
    system, points, material = bar()
    pressure = np.random.default_rng(0).uniform(-1e5, 3e5, (12, 2))
    native = NativeRod(system, points, 0.01, threads=1, integrator=integrator).rollout(material, pressure[None])
    prepared, state = fem.prepare(system, material), fem.state_at_rest(system)
    found = fem.simulate(system, prepared, state, jnp.asarray(pressure[:, None]), 0.01, points, integrator=integrator)
    near = 1e-6 if integrator == "quasi-static" else 1e-10
    np.testing.assert_allclose(found.position, native.position[0, 1:], rtol=0.0, atol=near)
