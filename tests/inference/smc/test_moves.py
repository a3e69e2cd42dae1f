"""What shapes the moves of a population: its location and spread, of unlike sizes and of copies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_t

from rfdropo_bayes.bayes.inferred_parameter import Pooled
from rfdropo_bayes.bayes.problem import ProblemDefaults
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.inference.smc.moves import Reference, StraightProblem, distinct_size, fit_reference, propose
from rfdropo_bayes.simulators.parameters import ParameterSpec

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


@pytest.mark.parametrize("scale", [0.3, 1.0])
def test_proposals_are_reversible_under_the_students_t_of_their_reference(scale):
    """Where it is the target, all are accepted: the ratio takes back what the density changes by."""
    rng = np.random.default_rng(2)
    factor = np.array([[1.0, 0.0], [0.7, 0.5]])
    target = multivariate_t(loc=[1.0, -2.0], shape=factor @ factor.T, df=5.0, seed=rng)
    position = target.rvs(40)
    proposal, ratio = propose(rng, position, Reference(np.array([1.0, -2.0]), factor), scale, 5.0)
    np.testing.assert_allclose(ratio, target.logpdf(position) - target.logpdf(proposal), atol=1e-9)


class DaysApart(ProblemDefaults):
    """A zero that differs from day to day, with a spread that is inferred, and a stiffness that shows nowhere."""

    def __init__(self) -> None:
        self.space = build_scopes(
            (
                ParameterSpec("zero", "m", -1.0, 1.0, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 0.3}, ""),
                ParameterSpec("stiffness", "N/m", 1.0, 9.0, 2.0, {"distribution": "Uniform", "low": 1, "high": 9}, ""),
            ),
            {"zero": {}, "stiffness": {}},
            {},
            ["a", "b"],
            pooled={"zero": Pooled(0.2, {"a": ("a",), "b": ("b",)}, "zero")},
        )
        self.names, self.n_rows = self.space.names, 1
        self.units = {p.name: p.spec.unit for p in self.space.parameters}
        self.bounds = {p.name: (p.spec.low, p.spec.high) for p in self.space.parameters}
        self.sample_prior, self.log_prior = self.space.sample, self.space.log_prior_unconstrained
        self.to_unconstrained, self.from_unconstrained = self.space.to_unconstrained, self.space.from_unconstrained

    def residuals(self, values, horizon):
        return np.stack([values["zero"] + values[f"zero_deviation@{day}"] for day in "ab"], axis=1)

    def row_log_likelihood(self, values, horizon):
        off = np.stack([np.asarray(values["zero"] + values[f"zero_deviation@{day}"]) for day in "ab"])
        return -0.5 * np.sum(off**2, axis=0)[:, None], np.zeros(off.shape[1], dtype=int)


def test_logarithms_of_what_is_positive_keep_a_prior_whose_spread_is_inferred():
    """The map is a bijection, and its density carries the Jacobian."""
    straight = StraightProblem(DaysApart(), jax.random.key(0))
    assert dict(zip(straight.names, straight.logarithmic, strict=True)) == {
        "zero": False,
        "zero_spread": True,
        "zero_deviation@a": False,
        "zero_deviation@b": False,
        "stiffness": True,
    }
    values = straight.sample_prior(jax.random.key(1), 20)
    v = straight.to_unconstrained(values)
    back = straight.from_unconstrained(v)
    for name in straight.names:
        np.testing.assert_allclose(back[name], values[name], rtol=1e-9)

    def stacked(row):
        return jnp.stack([column[0] for column in straight.from_unconstrained(row[None]).values()])

    slope = jax.jit(jax.vmap(jax.jacfwd(stacked)))(v)
    expected = straight.problem.space.log_prior(values) + np.linalg.slogdet(slope)[1]
    np.testing.assert_allclose(straight.log_prior(v), expected, rtol=1e-8)
