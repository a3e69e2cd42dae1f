"""Corotational tetrahedra: meshes, masses and points; the compiled engine by lanes and threads."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.cable_drive import DriveLimits
from rfdropo_bayes.fem.native.tetrahedral_engine import TetrahedralEngine
from rfdropo_bayes.fem.tetrahedra import locate, lumped_masses, route_cables, tetrahedral_body
from rfdropo_bayes.runtime import configure_jax

configure_jax()


CUBE_TETRAHEDRA = np.array([[0, 1, 3, 7], [0, 1, 7, 5], [0, 5, 7, 4], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7]])

FREE = DriveLimits(np.full(3, np.inf))


def beam(nx=2, ny=2, nz=5, size=(0.02, 0.02, 0.08), frames="polar", jitter=0.0):
    """A bar along z of irregular tetrahedra, held at z = 0."""
    axes = [np.linspace(0.0, length, count + 1) for length, count in zip(size, (nx, ny, nz), strict=True)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    rest = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    inside = np.all((rest > 1e-9) & (rest < np.array(size) - 1e-9), axis=1)
    rest[inside] += jitter * np.random.default_rng(3).uniform(-1, 1, (int(inside.sum()), 3))
    elements = []
    for k in range(nz):
        for j in range(ny):
            for i in range(nx):
                corner = [
                    ((k + c) * (ny + 1) + j + b) * (nx + 1) + i + a
                    for c in range(2)
                    for b in range(2)
                    for a in range(2)
                ]
                elements.extend(np.array(corner)[CUBE_TETRAHEDRA])
    return tetrahedral_body(rest, np.array(elements), rest[:, 2] < 1e-9, frames)


def test_masses_add_up_and_points_are_found():
    body = beam(jitter=2e-3)
    assert float(lumped_masses(body, 1000.0).sum()) == pytest.approx(1000.0 * 0.02 * 0.02 * 0.08)
    points = np.array([[0.005, 0.013, 0.031], [0.01, 0.01, 0.09]])  # the second lies outside
    found = locate(body, points)
    np.testing.assert_allclose(np.einsum("pk,pki->pi", found.weight, body.rest[found.node]), points, atol=1e-15)
    assert found.weight[0].min() >= -1e-12
    assert found.weight[1].min() < 0.0


def test_refuses_inverted_elements_and_loose_nodes():
    body = beam(1, 1, 1)
    with pytest.raises(InputError, match="element 0 has volume -"):
        tetrahedral_body(body.rest, body.element[:, [1, 0, 2, 3]], body.fixed)
    with pytest.raises(InputError, match="no node is fixed"):
        tetrahedral_body(body.rest, body.element, np.zeros(len(body.rest), bool))
    elements = np.vstack([body.element, body.element + len(body.rest)])
    fixed = np.concatenate([body.fixed, np.zeros(len(body.rest), bool)])
    with pytest.raises(InputError, match="are tied to no fixed node"):
        tetrahedral_body(np.vstack([body.rest, body.rest]), elements, fixed)


def pulled_beam(frames):
    body = beam(frames=frames, jitter=1e-3)
    heights = np.linspace(0.01, 0.07, 4)
    guides = [
        np.column_stack([np.full(4, x), np.full(4, y), heights])
        for x, y in ((0.004, 0.01), (0.016, 0.012), (0.01, 0.003))
    ]
    anchors = np.array([[0.004, 0.01, 0.0], [0.016, 0.012, 0.0], [0.01, 0.003, 0.0]])
    return body, route_cables(body, anchors, guides), locate(body, np.array([[0.01, 0.01, 0.08], [0.004, 0.015, 0.05]]))


@pytest.mark.slow
def test_results_do_not_depend_on_batch_lane_or_threads():
    body, cables, points = pulled_beam("polar")
    rng = np.random.default_rng(5)
    samples = 11
    parameters = {
        "young_modulus": rng.uniform(0.3e6, 1e6, samples),
        "poisson_ratio": np.full(samples, 0.4),
        "node_mass": np.full((samples, len(body.rest)), 4e-4),
        "rayleigh_mass": np.full(samples, 0.1),
        "rayleigh_stiffness": np.full(samples, 0.02),
        "gravity": np.tile([0.0, -9.81, 0.0], (samples, 1)),
    }
    parameters["young_modulus"][4] = np.nan  # a lost sample must not touch its neighbours
    commands = np.cumsum(np.full((10, 3), [5e-4, 0.0, 2e-4]), axis=0)
    engine = TetrahedralEngine(body, cables, FREE, points, threads=2)
    together = engine.rollouts(parameters, commands, time_step=0.01)
    np.testing.assert_array_equal(together.diverged, np.arange(samples) == 4)
    unknown = np.tile(commands, (samples, 1, 1))
    unknown[7, 3, 1] = np.nan  # nor is a command that is no number a slack cable
    lost = engine.rollouts(parameters, unknown, time_step=0.01)
    np.testing.assert_array_equal(np.flatnonzero(lost.diverged), [4, 7])
    single = TetrahedralEngine(body, cables, FREE, points, threads=1)
    for sample in (0, 3, 5, 10):
        alone = single.rollouts(
            {name: value[sample : sample + 1] for name, value in parameters.items()}, commands, time_step=0.01
        )
        np.testing.assert_array_equal(alone.position[0], together.position[sample])
        np.testing.assert_array_equal(alone.tension[0], together.tension[sample])
