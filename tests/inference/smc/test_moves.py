"""What shapes the moves of a population: its location and spread, of unlike sizes and of copies."""

import numpy as np
import pytest

from rfdropo_bayes.inference.smc.moves import distinct_size, fit_reference, propose

SIZES = np.array([1e-9, 1.0, 1e6])


def draws(n):
    return SIZES * (np.random.default_rng(0).standard_normal((n, 3)) + 3.0)


def equal(n):
    return np.full(n, 1.0 / n)


def test_the_spread_of_each_coordinate_is_kept_whatever_the_sizes_of_the_others():
    position = draws(400)
    reference = fit_reference(position, equal(400))
    np.testing.assert_allclose(
        reference.cholesky @ reference.cholesky.T / np.outer(SIZES, SIZES),
        np.cov(position / SIZES, rowvar=False, bias=True),
        atol=1e-9,
    )


def test_copies_of_one_particle_count_once():
    position = np.repeat(draws(4), [5, 1, 1, 1], axis=0)
    assert distinct_size(position, equal(8)) == pytest.approx(64 / (25 + 1 + 1 + 1))
    few = fit_reference(position, equal(8))
    correlation = few.cholesky @ few.cholesky.T / np.outer(SIZES, SIZES)
    free = np.cov(position / SIZES, rowvar=False, bias=True)
    np.testing.assert_allclose(np.diag(correlation), np.diag(free), rtol=1e-9)
    shrunk = (correlation / free)[0, 1]
    assert shrunk == pytest.approx(64 / 28 / 8, rel=1e-6)  # of 2 (d + 1) wanted


@pytest.mark.parametrize("where", [np.array([1.0, -3.0, 0.8]), np.zeros(3)])
def test_proposals_shaped_by_copies_of_one_particle_are_finite(where):
    # What is left where a budget runs out; here the mean even rounds some coordinates exactly and others not.
    reference = fit_reference(np.tile(where, (100, 1)), equal(100))
    generator = np.random.default_rng(1)
    with np.errstate(all="raise", under="ignore"):
        proposal, ratio = propose(generator, draws(50) / SIZES, reference, 1.0 - 1e-3, 5.0)
    assert np.isfinite(proposal).all()
    assert np.isfinite(ratio).all()
