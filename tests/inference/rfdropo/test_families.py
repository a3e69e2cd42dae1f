"""Families that RF-DROPO can search, and rollouts that are used again for other members of them."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.rfdropo.families import SearchSpace, make_family
from rfdropo_bayes.inference.rfdropo.scores import LEAST_ESS, make_pool
from rfdropo_bayes.inference.rfdropo.search import bootstrap, refine

from ..toys import Spring

SPACE = SearchSpace(
    ("a", "b", "c"),
    np.array([0.0, 1.0, -2.0]),
    np.array([4.0, 3.0, 2.0]),
    np.full(3, -50.0),
    np.full(3, 50.0),
)


def vector_of(family, seed: int = 0) -> np.ndarray:
    """A member with deviations of about a tenth of the ranges."""
    rng = np.random.default_rng(seed)
    vector = rng.uniform(1.0, 3.0, family.dimension)
    d = len(SPACE.names)
    for start in range(0, family.dimension - 2 * d + 1, 2 * d):
        vector[start + d : start + 2 * d] = rng.uniform(3.2, 3.6, d)
    return vector


@pytest.mark.parametrize("name", ["independent", "full", "mixture"])
def test_draws_have_the_stated_density_and_moments(name):
    """The mean of 1 / q(x) over draws of q inside a box is the volume of the box. 200,000 draws: off by more than 5 %
    (10 % for the mixture, whose density varies more) only beyond five standard errors."""
    family = make_family(name, SPACE)
    vector = vector_of(family)
    uniform = np.random.default_rng(1).uniform(size=(200_000, family.columns))
    draws = family.draw(vector, uniform)
    density = family.log_density(vector, draws)
    assert np.isfinite(density).all()
    middle, width = np.median(draws, axis=0), 0.3 * draws.std(axis=0)
    inside = np.all(np.abs(draws - middle) < width, axis=1)
    assert inside.sum() > 500
    volume = np.prod(2.0 * width)
    assert np.mean(inside / np.exp(density)) == pytest.approx(volume, rel=0.1 if name == "mixture" else 0.05)
    table = family.describe(vector, dict.fromkeys(SPACE.names, "m"))
    for j, parameter in enumerate(SPACE.names):
        assert table[parameter]["unit"] == "m"
        assert draws[:, j].mean() == pytest.approx(table[parameter]["mean"], abs=0.02 * np.ptp(draws[:, j]))


def test_a_full_covariance_has_its_correlations_and_none_at_the_middle():
    family = make_family("full", SPACE)
    vector = vector_of(family)
    vector[6:] = 2.0
    np.testing.assert_allclose(family.factor(vector), np.eye(3), atol=1e-12)
    independent = SPACE.draw(vector[:6], np.full((1, 3), 0.3))
    np.testing.assert_allclose(family.draw(vector, np.full((1, 3), 0.3)), independent)
    vector[6:] = [3.4, 0.8, 2.5]
    table = family.describe(vector, dict.fromkeys(SPACE.names, "-"))
    draws = family.draw(vector, np.random.default_rng(2).uniform(size=(50_000, 3)))
    observed = np.corrcoef(draws.T)
    assert observed[0, 1] == pytest.approx(table["a"]["correlation"]["b"], abs=0.03)
    assert table["a"]["correlation"]["b"] == pytest.approx(0.999 * 0.7)


def test_a_mixture_of_share_one_is_its_first_component():
    family = make_family("mixture", SPACE)
    vector = vector_of(family)
    vector[-1] = 4.0
    uniform = np.random.default_rng(3).uniform(size=(100, 4))
    np.testing.assert_allclose(family.draw(vector, uniform), SPACE.draw(vector[:6], uniform[:, :3]))
    values = family.draw(vector, uniform)
    np.testing.assert_allclose(family.log_density(vector, values), SPACE.log_density(vector[:6], values))


def test_what_cannot_be_a_family_is_refused():
    with pytest.raises(InputError, match="one of independent"):
        make_family("gamma", SPACE)
    with pytest.raises(InputError, match="no correlations"):
        make_family("full", SearchSpace(("a",), *(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))))


def linear_pool(recordings: int = 4, seed: int = 0):
    """Features a, b, c themselves over three rows; recordings are copies with noise of their own."""
    rng = np.random.default_rng(seed)
    centre = vector_of(SPACE)
    candidates = np.stack([centre, centre + 0.15])
    values = SPACE.draw(candidates, rng.uniform(size=(400, 3)))
    features = np.tile(values[:, :, None, :], (1, 1, 3, recordings))
    truth = SPACE.unpack(centre)[0] + 0.05
    observed = np.tile(truth, (3, recordings)) + 0.02 * rng.normal(size=(3, 3 * recordings))
    alive = np.ones((2, 400), dtype=bool)
    mask = np.ones_like(observed, dtype=bool)
    return (
        centre,
        truth,
        make_pool(
            SPACE, candidates, values, features, alive, observed, mask, recordings, np.full(3 * recordings, 1e-4)
        ),
    )


def test_weights_under_a_source_carry_as_many_rollouts_as_the_mixture_has():
    """The expectation of the weights' own function: means under one source from the rollouts of both."""
    centre, _, pool = linear_pool()
    weights, effective = pool.weights(centre)
    assert weights.sum() == pytest.approx(1.0)
    assert 300 < effective <= 800
    np.testing.assert_allclose(weights @ pool.values, SPACE.unpack(centre)[0], atol=0.05)


def test_refinement_moves_towards_the_truth_and_stays_where_the_pool_sees():
    centre, truth, pool = linear_pool()
    counts = np.ones(4)
    found = refine(pool, centre, counts, 300, 1)
    assert pool.loss(found, counts) < pool.loss(centre, counts)
    before, after = (np.abs(SPACE.unpack(v)[0] - truth).max() for v in (centre, found))
    assert after < before
    assert pool.weights(found)[1] >= LEAST_ESS
    beyond = centre + np.array([1.6, 1.6, 1.6, 0.0, 0.0, 0.0])  # means where no rollout of the pool is
    assert pool.loss(beyond, counts) > 1e9


def test_recordings_drawn_again_scatter_phi():
    centre, _, pool = linear_pool()
    scatter = bootstrap(pool, centre, 6, 60, np.random.default_rng(5))
    assert set(scatter) == {"a", "b", "c", "effective_sample_size"}
    assert scatter["effective_sample_size"]["least"] >= LEAST_ESS
    assert all(0.0 <= scatter[name]["sd"] < 0.2 for name in "abc")


@pytest.mark.parametrize("family", ["full", "mixture"])
def test_rfdropo_searches_every_family_and_polishes_within_its_budget(family):
    options = {"rollouts": 1500, "rollouts_per_candidate": 20, "finalists": 4, "family": family, "polish": 30}
    result = methods.run(Spring(), "rfdropo", options, jax.random.key(0))
    assert result.rollouts <= 1500
    assert set(result.phi) == {"frequency", "damping"}
    reuse = result.details["reuse"]
    assert reuse["loss"][1] <= reuse["loss"][0]
    assert ("correlation" if family == "full" else "components") in result.phi["frequency"]
