"""The notched trunk as a layered body against a solid of the same geometry."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh

from rfdropo_bayes import fem
from rfdropo_bayes.fem import corotational
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.body_engine import Backend, Engine
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble

# Linear sag [m] at the last notch-free station under gravity across the axis, and the first two bending modes [Hz], of
# SOFA's mesh of linear tetrahedra with equal nodal masses, by Poisson ratio: tools/section_profile.py.
SOLID = {0.3: (0.66627, 0.74924, 3.36383), 0.45: (0.57813, 0.81058, 3.67431), 0.49: (0.41748, 0.95778, 4.34233)}


def dense(matrix, free: int) -> np.ndarray:
    """A block-tridiagonal matrix without its first ``free`` rows and columns."""
    blocks, size = np.asarray(matrix.diagonal), matrix.diagonal.shape[1]
    full = np.zeros((len(blocks) * size, len(blocks) * size))
    for i, block in enumerate(blocks):
        full[i * size : (i + 1) * size, i * size : (i + 1) * size] = block
    for i, block in enumerate(np.asarray(matrix.lower)):
        full[(i + 1) * size : (i + 2) * size, i * size : (i + 1) * size] = block
        full[i * size : (i + 1) * size, (i + 1) * size : (i + 2) * size] = block.T
    return full[free:, free:]


@pytest.mark.parametrize("refine", [1, 2])
def test_sag_and_modes_are_those_of_the_solid(refine):
    robot, discretisation = Robot.load("trunk_sofa"), Discretisation(0.01, refine=refine)
    assembly = assemble(robot, discretisation)
    trunk = TrunkSimulator(robot, Engine(assembly, 0.01, Backend("jax")), assembly, discretisation)
    system = assembly.system

    @jax.jit
    def matrices(poisson_ratio):
        prepared = fem.prepare(system, trunk.material(trunk.complete({"poisson_ratio": poisson_ratio})))
        upright = jnp.tile(jnp.eye(3), (len(system.body.station) - 1, 1, 1))
        return corotational.tangent(prepared.packed, upright), prepared.mass

    for ratio, (sag, *modes) in SOLID.items():
        tangent, mass = matrices(ratio)
        stiffness, inertia = dense(tangent, 12), np.kron(dense(mass, 4), np.eye(3))
        across = np.tile([1.0, 0.0, 0.0], len(inertia) // 3)
        bend = np.linalg.solve(stiffness, 9.81 * inertia @ across).reshape(-1, 4, 3)
        station = assembly.station_of[-2] - 1
        np.testing.assert_allclose(bend[station, :, 0].mean(), sag, rtol=0.05)
        square = eigh(stiffness, inertia, subset_by_index=(0, 7), eigvals_only=True)
        bending = np.sqrt(square) / (2 * np.pi)
        np.testing.assert_allclose(bending[:2], modes[0], rtol=0.05)
        assert np.sum(np.abs(bending / modes[1] - 1.0) < 0.05) >= 2, bending
