"""When and where a model fails, on a linear model whose densities are known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import kstest, multivariate_normal

from rfdropo_bayes.discrepancy.fit import Fit
from rfdropo_bayes.discrepancy.prequential import begins_wrong, in_words, prequential

from .toys import measurements

ROWS, CHANNELS, PARAMETERS = 35, 6, 3  # three blocks, the last one longer


def asked(residual: np.ndarray, jacobian: np.ndarray, x: np.ndarray, valid: np.ndarray):
    """A target and a fit with unit priors around one, of which only these attributes are used."""
    measured = replace(measurements(np.zeros(valid.shape), ((0,),)), count=valid.astype(float))
    measured = replace(measured, time=0.05 * np.arange(ROWS)[None])
    coordinates = SimpleNamespace(prior_mean=np.ones(PARAMETERS), prior_sd=np.full(PARAMETERS, 2.0))
    target = SimpleNamespace(measurements=measured, forward=SimpleNamespace(coordinates=coordinates))
    free = np.arange(PARAMETERS)
    return target, Fit(x, free, residual, jacobian, np.eye(PARAMETERS), 0.0, 0.0)


def drawn(rng: np.random.Generator):
    """A data set of the model, with gaps, and the model linear around another point than the truth."""
    valid = rng.uniform(size=(1, ROWS, CHANNELS)) > 0.1
    jacobian = rng.normal(size=(valid.size, PARAMETERS)) * valid.reshape(-1, 1)
    truth, x = 1.0 + 2.0 * rng.standard_normal(PARAMETERS), rng.normal(size=PARAMETERS)
    residual = jacobian @ (truth - x) + rng.standard_normal(valid.size) * valid.reshape(-1)
    return residual, jacobian, x, valid


def test_the_scores_of_the_blocks_sum_to_the_log_evidence():
    residual, jacobian, x, valid = drawn(np.random.default_rng(0))
    found = prequential(*asked(residual, jacobian, x, valid))
    used = valid.reshape(-1)
    j = jacobian[used]
    evidence = multivariate_normal(j @ (1.0 - x), np.eye(len(j)) + 4.0 * j @ j.T).logpdf(residual[used])
    assert found.score.sum() == pytest.approx(evidence)
    np.testing.assert_allclose(found.edges, [0.0, 0.5, 1.0, 1.7])


def test_where_the_model_is_right_the_p_values_are_uniform_and_a_failure_is_seen_where_it_is():
    """Kolmogorov-Smirnov at 400 p-values: fails for one seed in 1000."""
    rng = np.random.default_rng(1)
    p = [prequential(*asked(*drawn(rng))).p for _ in range(100)]
    assert kstest(np.ravel(p), "uniform").pvalue > 1e-3
    residual, jacobian, x, valid = drawn(rng)
    wrong = residual.reshape(valid.shape).copy()
    wrong[:, 10:20, 3:] += 3.0 * valid[:, 10:20, 3:]
    before = prequential(*asked(residual, jacobian, x, valid))
    assert in_words(before, ("base", "tip"), 0.01).startswith("No stretch")
    after = prequential(*asked(wrong.reshape(-1), jacobian, x, valid))
    assert "first from 0.5 to 1 s" in in_words(after, ("base", "tip"), 0.01)
    assert "first from row 0 to row 1" in in_words(after, ("base", "tip"), 0.01, timed=False)


@pytest.mark.parametrize(
    ("rows", "asked_about"), [((0, 10), True), ((10, 20), False), ((0, 20), False), ((0, 0), False)]
)
def test_a_misfit_of_the_first_block_alone_asks_about_the_beginning(rows, asked_about):
    rng = np.random.default_rng(3)
    _, jacobian, x, valid = drawn(rng)
    wrong = rng.standard_normal(valid.shape) * valid
    wrong[:, slice(*rows), 3:] += 6.0 * valid[:, slice(*rows), 3:]
    found = prequential(*asked(wrong.reshape(-1), 0.0 * jacobian, x, valid))  # a misfit that no parameter takes up
    assert begins_wrong(found, 0.01) == asked_about
    assert ("another command in force before the first row" in in_words(found, ("base", "tip"), 0.01)) == asked_about
