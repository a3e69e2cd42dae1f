"""Bodies and runs that several tests of the finite elements share. A body that is shared is compiled once."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from rfdropo_bayes import fem
from rfdropo_bayes.fem.dynamics import mass_times


def small_trunk() -> fem.System:
    """Six tapering layers with three cables of different reach, 120 degrees apart, guided at every layer."""
    layers = 6
    station = np.linspace(0.0, 0.12, layers + 1)
    half = np.linspace(0.012, 0.008, layers + 1)
    middle = 0.5 * (half[1:] + half[:-1])
    area, moment = 4.0 * middle**2, np.repeat(4.0 / 3.0 * middle[:, None] ** 4, 2, axis=1)
    body = fem.profile_body(
        station=station,
        half_width=np.repeat(half[:, None], 2, axis=1),
        axial_area=area,
        bending_moment_area=moment,
        torsion_constant=0.140577 * 16.0 * middle**4,
        mass_area=area,
        mass_moment_area=moment,
    )
    anchors, guides = [], []
    for cable, reach in enumerate((0.11, 0.11, 0.07)):
        angle = 2.0 * np.pi * cable / 3.0
        side = np.array([np.cos(angle), np.sin(angle), 0.0])
        anchors.append(0.02 * side)
        guides.append(np.array([(0.02 - 0.05 * z) * side + [0.0, 0.0, z] for z in np.arange(0.01, reach + 1e-9, 0.02)]))
    return fem.System(body, fem.cable_layout(body, np.array(anchors), guides))


@pytest.fixture(scope="session")
def trunk() -> fem.System:
    """See ``small_trunk``."""
    return small_trunk()


@pytest.fixture(scope="session")
def prepare():
    """``fem.prepare``, compiled once for each system."""
    return functools.partial(_compiled_prepare, {})


def _compiled_prepare(compiled: dict, system: fem.System, material: fem.Material) -> fem.Prepared:
    if id(system) not in compiled:
        compiled[id(system)] = system, jax.jit(functools.partial(fem.prepare, system))
    return compiled[id(system)][1](material)


@pytest.fixture(scope="session")
def settle():
    """Function (system, material, displacement=None, force=None) -> state and info in equilibrium, compiled once for
    each system."""
    compiled: dict = {}

    def run(system, material, displacement=None, force=None):
        def equilibrium(material, displacement, force):
            return fem.static_equilibrium(system, fem.prepare(system, material), displacement, force)

        if id(system) not in compiled:
            compiled[id(system)] = system, jax.jit(equilibrium)
        displacement = np.zeros(len(system.cables.anchor)) if displacement is None else np.asarray(displacement)
        force = np.zeros((system.body.nodes, 3)) if force is None else np.asarray(force)
        return compiled[id(system)][1](material, displacement, force)

    return run


@functools.cache
def _compiled_trace(clamped: int):
    system = small_trunk()._replace(clamped_stations=clamped)

    @jax.jit
    def trace(material, state, displacement, time_step, force):
        prepared = fem.prepare(system, material)

        def one(state, command):
            state, info = fem.step(system, prepared, state, command, time_step, force)
            momentum = mass_times(system, prepared, state.velocity).sum(axis=0)
            return state, (state, info, fem.energies(system, prepared, state), momentum)

        return jax.lax.scan(one, state, displacement)[1]

    return trace


@pytest.fixture(scope="session")
def trace():
    """Function (material, state, displacement (100, 3), time step, clamped=1, force=None) -> states, infos, energies
    and momenta of the small trunk after every step."""

    def run(material, state, displacement, time_step, clamped=1, force=None):
        assert displacement.shape == (100, 3)
        force = np.zeros(state.position.shape) if force is None else force
        return _compiled_trace(clamped)(material, state, displacement, time_step, force)

    return run
