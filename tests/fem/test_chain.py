"""Elimination along a chain of stations against dense linear algebra, alone and in a batch."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes import fem  # noqa: F401  (double precision)
from rfdropo_bayes.fem.lanes import laned
from rfdropo_bayes.fem.rod_elements import Stiffness
from rfdropo_bayes.fem.stage_solve import Chain, ascend, descend, eliminate

STATIONS, ROWS = 4, 2


def chain(rng: np.random.Generator) -> tuple[Chain, np.ndarray]:
    """A positive definite chain, and the same as a dense matrix."""
    whole = np.zeros((6 * STATIONS, 6 * STATIONS))
    blocks = []
    for element in range(STATIONS - 1):
        root = rng.normal(size=(12, 12))
        left, right = np.linalg.qr(rng.normal(size=(3, 3)))[0], root @ root.T
        c = left @ np.diag(rng.uniform(1.0, 2.0, 3)) @ left.T
        a, b = rng.normal(size=(2, 3, 3))
        aa, bb = right[:3, :3] + 9.0 * np.eye(3), right[3:6, 3:6] + 9.0 * np.eye(3)
        ba = rng.normal(size=(3, 3))
        blocks.append((c, a, b, aa, bb, ba))
        first = np.block([[c, -a], [-a.T, aa]])
        second, between = np.block([[c, b], [b.T, bb]]), np.block([[-c, a], [-b.T, ba]])
        at = 6 * element
        whole[at : at + 12, at : at + 12] += np.block([[first, between.T], [between, second]])
    straight = np.tile(30.0 * np.eye(3), (STATIONS, 1, 1))
    turning = np.tile(20.0 * np.eye(3), (STATIONS, 1, 1))
    for station in range(STATIONS):
        at = 6 * station
        whole[at : at + 3, at : at + 3] += straight[station]
        whole[at + 3 : at + 6, at + 3 : at + 6] += turning[station]
    element = Stiffness(*(jnp.moveaxis(jnp.asarray(np.array(part)), 0, -1) for part in zip(*blocks, strict=True)))
    return Chain(element, *(jnp.moveaxis(jnp.asarray(part), 0, -1) for part in (straight, turning))), whole


@pytest.mark.parametrize("held", [0, 1])
def test_elimination_agrees_with_dense_algebra(held):
    rng = np.random.default_rng(held)
    made = [chain(rng) for _ in range(3)]
    chains = jax.tree.map(lambda *parts: jnp.stack(parts), *(one for one, _ in made))
    right, twist = rng.normal(size=(2, 3, 6, STATIONS))
    rows, other = rng.normal(size=(3, STATIONS, 6, ROWS)), rng.normal(size=(3, STATIONS - held, 6))

    @jax.jit
    @jax.vmap
    def solved(chain, right, rows, twist, other):
        found = laned(lambda *given: eliminate(*given, held))(chain, right, rows, twist)
        down, reached = laned(descend)(found.factor, found.columns, other)
        up = laned(ascend)
        return found, up(found.factor, found.solved), up(found.factor, down), reached

    found, first, second, reached = solved(chains, right, rows, twist, other)
    for k, (_, whole) in enumerate(made):
        inverse = np.linalg.inv(whole[6 * held :, 6 * held :])
        b, j = right[k].T[held:].ravel(), rows[k][held:].reshape(-1, ROWS)
        np.testing.assert_allclose(np.ravel(first[k]), inverse @ b, rtol=1e-9)
        np.testing.assert_allclose(found.compliance[k], j.T @ inverse @ j, rtol=1e-9)
        np.testing.assert_allclose(found.reached[k], j.T @ inverse @ b, rtol=1e-8)
        np.testing.assert_allclose(found.moving[k], j.T @ twist[k].T[held:].ravel(), rtol=1e-9)
        np.testing.assert_allclose(np.ravel(second[k]), inverse @ other[k].ravel(), rtol=1e-9)
        np.testing.assert_allclose(reached[k], j.T @ inverse @ other[k].ravel(), rtol=1e-8)


def test_lanes_of_nested_batches_are_those_of_loops():
    add = laned(lambda a, b: a[:, None] * b[None] + a[0])
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 3)), rng.normal(size=(2, 5, 4))
    found = jax.vmap(lambda one, many: jax.vmap(lambda other: add(one, other))(many))(a, b)
    shared = jax.vmap(lambda other: add(jnp.asarray(a[0]), other))(b[0])
    for i in range(2):
        for k in range(5):
            np.testing.assert_allclose(found[i, k], a[i][:, None] * b[i, k][None] + a[i][0], rtol=1e-15)
    np.testing.assert_allclose(shared, found[0], rtol=1e-15)
