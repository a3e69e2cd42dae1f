"""The notched trunk as a rod against a solid of the same geometry."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh

from rfdropo_bayes import fem
from rfdropo_bayes.fem.dynamics import displaced, strains
from rfdropo_bayes.fem.sections import energy
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.body_engine import Engine
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble

# Linear sag [m] at the last notch-free station under gravity across the axis, and the first two bending modes [Hz], of
# SOFA's mesh of linear tetrahedra with equal nodal masses, by Poisson ratio: tools/section_profile.py.
SOLID = {0.3: (0.66627, 0.74924, 3.36383), 0.45: (0.57813, 0.81058, 3.67431), 0.49: (0.41748, 0.95778, 4.34233)}


@pytest.mark.slow
def test_sag_and_modes_are_those_of_the_solid():
    """By the second derivatives of the elastic energy at rest."""
    robot, discretisation = Robot.load("trunk_sofa"), Discretisation(0.01)
    assembly = assemble(robot, discretisation)
    trunk = TrunkSimulator(robot, Engine(assembly, 0.01), assembly, discretisation)
    system = assembly.system
    rest, length = fem.state_at_rest(system), np.diff(system.body.station)
    stations = len(system.body.station)

    @jax.jit
    def matrices(poisson_ratio):
        prepared = fem.prepare(system, trunk.material(trunk.complete({"poisson_ratio": poisson_ratio})))

        def stored(way):
            strain = strains(system, prepared, displaced(rest, way.reshape(stations, 6)))
            return jnp.sum(length * energy(prepared.section, strain.T))

        mass = jnp.concatenate([jnp.repeat(prepared.mass[:, None], 3, axis=1), prepared.inertia], axis=1)
        return jax.hessian(stored)(jnp.zeros(6 * stations))[6:, 6:], mass.ravel()[6:]

    for ratio, (sag, *modes) in SOLID.items():
        stiffness, mass = map(np.asarray, matrices(ratio))
        across = np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], stations - 1)
        bend = np.linalg.solve(stiffness, 9.81 * mass * across).reshape(-1, 6)
        np.testing.assert_allclose(bend[assembly.station_of[-2] - 1, 0], sag, rtol=0.05)
        square = eigh(stiffness, np.diag(mass), subset_by_index=(0, 7), eigvals_only=True)
        bending = np.sqrt(square) / (2 * np.pi)
        np.testing.assert_allclose(bending[:2], modes[0], rtol=0.05)
        assert np.sum(np.abs(bending / modes[1] - 1.0) < 0.05) >= 2, bending
