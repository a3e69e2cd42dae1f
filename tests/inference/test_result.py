"""Cautions about posteriors that a bound decides, and of replicates that disagree."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from rfdropo_bayes.cautions import Caution, Code
from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.result import prior_cautions, replicate_cautions, stage_cautions, unseen_modes

from .toys import LinearGaussian, Ratio

GRID = (np.arange(2000) + 0.5) / 2000.0  # of a distribution function: draws without scatter


class OneParameter(LinearGaussian):
    def __init__(self, prior, bounds):
        super().__init__(d=1)
        self.prior, self.bounds = prior, {"x0": bounds}

    def sample_prior(self, key, n):
        return {"x0": self.prior(key, n)}


def uniform(key, n):
    return jax.random.uniform(key, (n,))


def log_normal(key, n):
    return 1e-2 * jax.numpy.exp(2.0 * jax.random.normal(key, (n,)))


@pytest.mark.parametrize(
    ("prior", "bounds", "draws", "side"),
    [
        (uniform, (0.0, 1.0), -1e-3 * np.log(GRID), "lower"),
        (uniform, (0.0, 1.0), 1.0 + 1e-3 * np.log(GRID), "upper"),
        (uniform, (0.0, 1.0), 2e-3 + 1e-3 * (GRID - 0.5), None),  # small, and well known
        (uniform, (0.0, 1.0), GRID, None),  # the prior come back
        (uniform, (-np.inf, np.inf), GRID, None),
        (log_normal, (0.0, 10.0), 1e-4 * np.exp(1.5 * np.sqrt(2.0) * np.log(GRID / (1.0 - GRID))), None),  # decades
        (log_normal, (1e-3, 10.0), 1e-3 * GRID**-0.5, "lower"),
    ],
)
def test_only_a_posterior_cut_off_at_its_mode_is_cautioned(prior, bounds, draws, side):
    found = prior_cautions(OneParameter(prior, bounds), {"x0": draws[None]})
    assert [caution.code for caution in found] == [Code.AT_BOUND] * (side is not None)
    assert [caution.sentence.split()[4] for caution in found] == ([side] if side else [])


@pytest.mark.parametrize(
    ("ends", "draws", "said"),
    [
        ((2.0, 7.0), 7.0 + 1e-3 * np.log(GRID), "x0 sits on the upper end 7 of its prior"),
        ((2.0, 7.0), 2.0 - 1e-3 * np.log(GRID), "x0 sits on the lower end 2 of its prior"),
        ((0.0, 7.0), -1e-3 * np.log(GRID), "x0 sits on its lower bound 0"),
        ((2.0, 7.0), 6.9 + 1e-3 * GRID, ""),
    ],
)
def test_an_end_of_the_prior_between_the_bounds_is_named(ends, draws, said):
    """Far inside its hard bounds a posterior can be cut off by its prior alone: a uniform one says nothing else."""
    low, high = ends
    problem = OneParameter(lambda key, n: jax.random.uniform(key, (n,), minval=low, maxval=high), (0.0, 100.0))
    problem.prior_ends = {"x0": ends}
    found = prior_cautions(problem, {"x0": draws[None]})
    assert [caution.sentence for caution in found] == [f"{said}, which decides it instead of the data"] * bool(said)


def normal(key, n):
    return jax.random.normal(key, (n,))


def half_cauchy(key, n):
    return 25.0 * jax.numpy.abs(jax.random.cauchy(key, (n,)))


def beyond_double_precision(key, n):
    return 1.0 / jax.random.gamma(key, 1e-3, (n,))


@pytest.mark.parametrize(
    ("prior", "centre", "excluded"),
    [
        (normal, 2.3, False),
        (normal, 3.2, True),
        (normal, -40.0, True),
        (log_normal, 1e-2 * np.exp(7.0), True),
        (uniform, 1e-4, False),  # as dense as elsewhere
        (uniform, 1.5, True),
        (half_cauchy, 0.01, False),
        (beyond_double_precision, 0.4, False),
    ],
)
def test_a_prior_that_the_data_contradict_is_named(prior, centre, excluded):
    draws = centre * (1.0 + 1e-5 * GRID[None])
    found = prior_cautions(OneParameter(prior, (-np.inf, np.inf)), {"x0": draws})
    said = "the data put x0 into the outermost 1 % of the prior, which excludes them"
    assert found == [Caution(Code.AGAINST_PRIOR, said)] * excluded


@pytest.mark.slow
def test_methods_say_which_bound_decides():
    """The data want a smaller ratio of stiffness to mass than the ends of both ranges have, by four deviations: the
    density falls exponentially from there."""
    result = methods.run(Ratio(truth=(1.9, 1.0), noise=0.1), "laplace", {"blocks": 1}, jax.random.key(1))
    for said in ("stiffness sits on its lower bound 2,", "mass sits on its upper bound 1,"):
        assert any(said in caution.sentence for caution in result.cautions)


def test_replicates_that_disagree_are_named():
    rng = np.random.default_rng(1)
    draws = {"a": rng.normal(size=(4, 500)), "b": rng.normal(size=(4, 500)) + np.array([[0.0], [0.0], [0.0], [2.0]])}
    assert replicate_cautions({"a": draws["a"]}, np.array([1.0, 1.1, 0.9, 1.0])) == []
    assert replicate_cautions({"b": draws["b"][:1]}, np.array([1.0])) == []
    scattered, apart = replicate_cautions(draws, np.array([1.0, 2.5, 0.2, 1.0]))
    assert "4 replicates scatter by 0.96" in scattered.sentence
    assert (scattered.code, apart.code) == (Code.EVIDENCE_SCATTERED, Code.REPLICATES_DISAGREE)
    assert apart.sentence.startswith("replicates disagree about b (R-hat 1.")


@pytest.mark.parametrize(
    ("replicates", "optimisations", "alone"),
    [
        (1, None, "one replicate"),
        (1, 4, "one replicate"),
        (4, 1, "a single optimisation"),
        (2, None, None),
        (2, 2, None),
    ],
)
def test_what_cannot_show_a_lost_mode_says_so(replicates, optimisations, alone):
    found = unseen_modes(replicates, optimisations)
    assert [caution.code for caution in found] == ([Code.MODES_UNSEEN] if alone else [])
    assert not alone or found[0].sentence.startswith(alone)


def test_stages_say_that_particles_stayed_and_where_a_budget_ran_out():
    """A run of one row, as from around optima, has no row to name."""
    moved = {"budget_exhausted": False, "progress": 1.0, "ess": 0.6, "correlation": 0.2}
    settings = (3743.15,)
    assert stage_cautions([moved, moved | {"final": True}], *settings) == []
    (stuck,) = stage_cautions([moved | {"correlation": 0.9}, moved | {"correlation": 0.97, "final": True}], *settings)
    assert stuck.sentence.startswith("the last moves left the particles 0.97 correlated")
    leap = moved | {"budget_exhausted": True, "ess": 0.08}
    (said,) = stage_cautions([leap, moved | {"final": True}], *settings)
    assert said.code is Code.BUDGET_SPENT
    assert said.grave
    assert said.sentence.startswith("the budget of 3743 rollouts ran out: the rest of the data")
    (said,) = stage_cautions([leap | {"progress": 7.0}, moved | {"final": True, "progress": 20.0}], *settings)
    assert "ran out at row 7" in said.sentence
