"""Static equilibrium against beams in closed form, large deflections included."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from rfdropo_bayes import fem
from rfdropo_bayes.fem import layered

YOUNG = 1.0e6


def tip(system: fem.System, position) -> np.ndarray:
    """Mean position of the last section."""
    return np.asarray(position)[..., -system.body.section_nodes :, :].mean(axis=-2)


def end_force(system: fem.System, force) -> np.ndarray:
    """Nodal forces of a force spread evenly over the end section."""
    along = np.ones(system.body.nodes_across)
    along[1:-1] = 2.0
    share = np.kron(along, along) / np.sum(along) ** 2
    nodal = np.zeros((system.body.nodes, 3))
    nodal[-system.body.section_nodes :] = share[:, None] * np.asarray(force)
    return nodal


# Bisshopp and Drucker (1945): P L^2 / E I -> deflection / L, shortening / L.
END_LOAD = {
    0.5: (0.16214, 0.01592),
    1.0: (0.30172, 0.05643),
    2.0: (0.49346, 0.16064),
    3.0: (0.60325, 0.25442),
    5.0: (0.71379, 0.38763),
    10.0: (0.81061, 0.55500),
}
# Heavy elastica: w L^3 / E I -> x / L, y / L.
OWN_WEIGHT = {1.0: (0.99125, 0.12347), 2.0: (0.96689, 0.23851), 5.0: (0.84666, 0.49591), 10.0: (0.65635, 0.70020)}


@pytest.fixture(scope="module")
def elastica(settle):
    """Slender cantilever, L / h = 50, Poisson ratio zero: tip for every load of both tables, then the infos."""
    half = 0.01
    system = fem.System(fem.uniform_body(1.0, half, half, 40, 2), fem.without_cables())
    stiffness, area = YOUNG * 4.0 * half**4 / 3.0, 4.0 * half**2
    loads = [(load, 0.0) for load in END_LOAD] + [(0.0, load) for load in OWN_WEIGHT]
    found = []
    for end, own in loads:
        gravity = (own * stiffness / (1000.0 * area), 0.0, 0.0)
        material = fem.material(system, young_modulus=YOUNG, poisson_ratio=0.0, density=1000.0, gravity=gravity)
        state, info = settle(system, material, force=end_force(system, (end * stiffness, 0.0, 0.0)))
        found.append((tip(system, state.position), bool(info.converged)))
    return found


def test_end_load_follows_bisshopp_and_drucker(elastica):
    for (deflection, shortening), (place, converged) in zip(END_LOAD.values(), elastica[: len(END_LOAD)], strict=True):
        assert converged
        assert place[0] == pytest.approx(deflection, rel=0.01)
        assert 1.0 - place[2] == pytest.approx(shortening, rel=0.01)


def test_own_weight_follows_the_heavy_elastica(elastica):
    for (along, across), (place, converged) in zip(OWN_WEIGHT.values(), elastica[len(END_LOAD) :], strict=True):
        assert converged
        assert place[2] == pytest.approx(along, rel=0.01)
        assert place[0] == pytest.approx(across, rel=0.01)


LENGTH, SIDE, SOFT, DENSITY = 0.195, 0.02, 0.45e6, 1000.0


def end_torque(system: fem.System, torque: float) -> np.ndarray:
    """Nodal forces of a torque about the axis on the end section."""
    nodal, end = np.zeros((system.body.nodes, 3)), slice(-system.body.section_nodes, None)
    place = fem.rest_positions(system.body)[end]
    nodal[end, 0], nodal[end, 1] = -place[:, 1], place[:, 0]
    return nodal * torque / np.sum(place[:, :2] ** 2)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((20, 2, 0.01), id="four nodes, 20 layers"),
        pytest.param((20, 3, 0.02), id="nine nodes, 20 layers", marks=pytest.mark.slow),
        pytest.param((40, 3, 0.01), id="nine nodes, 40 layers", marks=pytest.mark.slow),
    ],
)
def beam(request, settle):
    """The beam of the accuracy table, 195 x 20 x 20 mm: system, tolerance, and (Poisson ratio, weight, force) -> tip's
    motion and end section."""
    layers, nodes_across, tolerance = request.param
    system = fem.System(fem.uniform_body(LENGTH, SIDE / 2, SIDE / 2, layers, nodes_across), fem.without_cables())

    def load(poisson_ratio, weight, force=None):
        gravity = (0.0, -9.81 * weight, 0.0)
        material = fem.material(
            system, young_modulus=SOFT, poisson_ratio=poisson_ratio, density=DENSITY, gravity=gravity
        )
        state, info = settle(system, material, force=force)
        assert info.converged
        end = np.asarray(state.position)[-system.body.section_nodes :]
        return end.mean(axis=0) - [0.0, 0.0, LENGTH], end

    return system, tolerance, load


def test_beam_sags_under_its_weight_like_the_finest_mesh(beam):
    _, tolerance, load = beam
    assert load(0.45, 1.0)[0][1] == pytest.approx(-0.0944, rel=tolerance)


def test_beam_under_small_loads_follows_timoshenko(beam):
    """Without lateral contraction, which the clamp would hinder: at a ratio of 0.45 that costs two per cent."""
    system, tolerance, load = beam
    inertia, area = SIDE**4 / 12.0, SIDE**2
    shear_stiffness = SOFT / 2.0 * area * 10.0 / 12.0  # Cowper's coefficient of a square without contraction
    bending, shearing = LENGTH**3 / (3.0 * SOFT * inertia), LENGTH / shear_stiffness
    moved, _ = load(0.0, 0.0, end_force(system, (1e-5, 0, 0)))
    assert moved[0] == pytest.approx(1e-5 * (bending + shearing), rel=tolerance)
    weight = 1e-3 * 9.81 * DENSITY * area
    sag = weight * LENGTH**4 / (8.0 * SOFT * inertia) + weight * LENGTH**2 / (2.0 * shear_stiffness)
    assert load(0.0, 1e-3)[0][1] == pytest.approx(-sag, rel=tolerance)
    assert load(0.0, 0.0, end_force(system, (0, 0, 1e-3)))[0][2] == pytest.approx(
        1e-3 * LENGTH / (SOFT * area), rel=1e-6
    )


def test_beam_twists_by_torque_times_length_over_torsional_stiffness(beam):
    system, tolerance, load = beam
    _, end = load(0.45, 0.0, end_torque(system, 1e-6))
    rest = fem.rest_positions(system.body)[-system.body.section_nodes :]
    twist = np.sum(rest[:, 0] * end[:, 1] - rest[:, 1] * end[:, 0]) / np.sum(rest[:, :2] ** 2)
    assert twist == pytest.approx(1e-6 * LENGTH / (SOFT / 2.9 * 0.140577 * SIDE**4), rel=tolerance)


def test_nearly_incompressible_beam_does_not_lock(beam):
    """At a Poisson ratio of 0.499 the beam sags little less than at 0.45, as quadratic bricks do (30 x 3 x 3 of them:
    0.979 times as much); beyond that limit nothing changes."""
    _, _, load = beam
    usual, near, limit, beyond = (-1e3 * load(ratio, 1.0)[0][1] for ratio in (0.45, 0.49, 0.499, 0.5))
    assert limit == beyond
    assert limit < near < usual
    assert limit == pytest.approx(0.979 * 94.4, rel=0.03)


def dense_beam(layers: int) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and mass (for one component) of a slender unit beam, 0.02 wide, E = rho = 1, Poisson ratio zero."""
    body = fem.uniform_body(1.0, 0.01, 0.01, layers, 2)
    matrices, parts = jax.jit(
        lambda: (layered.layer_stiffness(body, jnp.ones(()), jnp.zeros(())), layered.layer_mass(body))
    )()
    stiffness, mass = np.zeros((body.nodes * 3,) * 2), np.zeros((body.nodes,) * 2)
    for layer in range(layers):
        rows, nodes = slice(12 * layer, 12 * layer + 24), slice(4 * layer, 4 * layer + 8)
        stiffness[rows, rows] += matrices[layer]
        mass[nodes, nodes] += parts[layer]
    return stiffness, mass


@pytest.mark.parametrize("layers", [2, 5, 16])
def test_small_deflections_of_a_slender_beam_are_exact_at_the_stations(layers):
    """As for Timoshenko's beam element: w L^4 / 8 E I + w L^2 / 2 k G A, with the element's own k = 1."""
    stiffness, mass = dense_beam(layers)
    load = np.zeros((len(mass), 3))
    load[:, 0] = mass.sum(axis=1)
    moved = np.linalg.solve(stiffness[12:, 12:], load.ravel()[12:]).reshape(-1, 3)[-4:, 0].mean()
    inertia, area = 0.02**4 / 12.0, 0.02**2
    assert moved == pytest.approx(area / (8.0 * inertia) + 1.0, rel=1e-7)


def test_frequencies_converge_with_the_square_of_the_layer_length():
    frequencies = []
    for layers in (10, 20, 40):
        stiffness, mass = dense_beam(layers)
        whole = np.kron(mass, np.eye(3))[12:, 12:]
        squares = scipy.linalg.eigh(stiffness[12:, 12:], whole, eigvals_only=True, subset_by_index=[0, 3])
        frequencies.append(np.sqrt(squares[2]))
    coarse, middle, fine = frequencies
    assert np.log2((coarse - middle) / (middle - fine)) == pytest.approx(2.0, abs=0.1)
    assert fine == pytest.approx(4.694091**2 * 0.01 / np.sqrt(3.0), rel=5e-3)


@pytest.mark.slow
def test_large_deflections_converge_at_least_with_the_square_of_the_layer_length(settle):
    tips = []
    for layers in (10, 20, 40):
        system = fem.System(fem.uniform_body(1.0, 0.02, 0.02, layers, 2), fem.without_cables())
        material = fem.material(system, young_modulus=YOUNG, poisson_ratio=0.0, density=1000.0)
        force = end_force(system, (3.0 * YOUNG * 0.04**4 / 12.0, 0.0, 0.0))
        state, info = settle(system, material, force=force)
        assert info.converged
        tips.append(tip(system, state.position)[0])
    coarse, middle, fine = tips
    assert np.log2((coarse - middle) / (middle - fine)) > 1.8
    assert fine == pytest.approx(END_LOAD[3.0][0], rel=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("young", [0.05e6, 0.3e6, 4.5e6])
@pytest.mark.parametrize("pull", [(0.0, 0.0, 0.0), (0.01, 0.0, 0.0), (0.02, 0.0, 0.01), (0.0, 0.03, 0.0)])
def test_soft_bodies_and_strong_pulls_still_find_equilibrium(trunk, settle, young, pull):
    """Weight that bends the body right down, and pulls of a quarter of its length, on one or several cables."""
    material = fem.material(trunk, young_modulus=young, poisson_ratio=0.45, density=1000.0, gravity=(0.0, -9.81, 0.0))
    assert settle(trunk, material, pull)[1].converged
