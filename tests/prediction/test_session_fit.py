"""A day's own parameters: against the joint posterior of a conjugate linear model; what a model leaves, as noise."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from rfdropo_bayes.bayes.inferred_parameter import Pooled
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.posteriors import RecordingPrediction
from rfdropo_bayes.prediction.model_error import model_error
from rfdropo_bayes.prediction.session_fit import fit_session
from rfdropo_bayes.simulators.parameters import ParameterSpec

SPREAD, SIGMA, ROWS = 0.7, 0.5, 6


def test_a_linear_model_s_draws_are_those_of_the_joint_posterior():
    """y = gain c + zero + noise, gain known to N(1, 0.3^2) from before, zero from its day's N(2, 0.7^2).

    Means and deviations of 3000 draws, of which the evidence leaves about half: 5 standard errors.
    """
    normal = {"distribution": "Normal", "loc": 2.0, "scale": 1.0}
    spec = ParameterSpec("zero", "m", -99.0, 99.0, 2.0, normal, "")
    space = build_scopes([spec], {"zero": {}}, {}, ["new"], pooled={"zero": Pooled(SPREAD, {"day": ("new",)})})
    rng = np.random.default_rng(3)
    command = np.linspace(0.5, 2.0, ROWS)
    measured = 1.3 * command + 2.6 + SIGMA * rng.normal(size=ROWS)
    body = {"gain": rng.normal(1.0, 0.3, 3000), "zero": np.full(3000, 2.0)}

    def residuals(values, horizon):
        zero = (values["zero"] + values["zero_deviation@day"])[:, None]
        return (values["gain"][:, None] * command + zero - measured) / SIGMA

    model = SimpleNamespace(markers=SimpleNamespace(valid=np.ones(ROWS, dtype=bool)))
    problem = SimpleNamespace(model=model, n_rows=ROWS, residuals=residuals)
    own = [p for p in space.parameters if p.scope.added_to]
    found = fit_session(problem, body, own, jax.random.key(0))
    design = np.stack([command, np.ones(ROWS)], axis=1) / SIGMA
    precision = design.T @ design + np.diag([0.3**-2, SPREAD**-2])
    covariance = np.linalg.inv(precision)
    mean = np.array([1.0, 0.0]) + covariance @ design.T @ ((measured - command - 2.0) / SIGMA)
    drawn = np.stack([found.values["gain"], found.values["zero_deviation@day"]])
    sd = np.sqrt(np.diag(covariance))
    assert found.unconverged == 0
    assert found.power == 1.0
    np.testing.assert_allclose(drawn.mean(axis=1), mean, atol=5.0 * sd.max() / np.sqrt(1000))
    np.testing.assert_allclose(drawn.std(axis=1), sd, rtol=0.12)
    assert np.corrcoef(drawn)[0, 1] == pytest.approx(covariance[0, 1] / sd.prod(), abs=0.1)


@pytest.mark.slow
def test_coordinates_that_err_together_count_as_fewer():
    """Eight coordinates with a correlation of 0.9 are seldom better than one: 120 days, whose zeros are known.

    90 % intervals hold 80 % of them or more (less by chance once in 3000 seeds); where all eight count, hardly half.
    """
    columns = 8
    spec = ParameterSpec("zero", "m", -99.0, 99.0, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 1.0}, "")
    space = build_scopes([spec], {"zero": {}}, {}, ["new"], pooled={"zero": Pooled(SPREAD, {"day": ("new",)})})
    own = [p for p in space.parameters if p.scope.added_to]
    across = 0.1 * np.eye(columns) + 0.9
    share = columns / float(np.sum(across**2))
    model = SimpleNamespace(markers=SimpleNamespace(valid=np.ones(columns, dtype=bool)))
    rng, inside = np.random.default_rng(6), {share: 0, 1.0: 0}
    for number in range(120):
        truth = SPREAD * rng.normal()
        measured = truth + SIGMA * np.linalg.cholesky(across) @ rng.normal(size=columns)

        def residuals(values, horizon, measured=measured):
            return (values["zero_deviation@day"][:, None] - measured) / SIGMA

        problem = SimpleNamespace(model=model, n_rows=1, residuals=residuals)
        for counted in inside:
            found = fit_session(problem, {"zero": np.zeros(100)}, own, jax.random.key(number), share=counted)
            low, high = np.quantile(found.values["zero_deviation@day"], [0.05, 0.95])
            inside[counted] += bool(low <= truth <= high)
    assert inside[share] >= 0.8 * 120
    assert inside[1.0] < 0.65 * 120


def test_a_model_s_error_counts_as_long_as_it_lasts():
    """An error that lasts 0.8 s, of 3 mm along x and 1 mm along y and z; at half of the rate it is the same."""
    rng, step, memory = np.random.default_rng(0), 0.1, np.exp(-0.1 / 0.8)
    error = np.zeros((20000, 3))
    for row in range(1, len(error)):
        error[row] = memory * error[row - 1] + np.sqrt(1 - memory**2) * rng.normal(size=3)
    error *= np.array([3e-3, 1e-3, 1e-3])
    time = step * np.arange(len(error))
    zero = np.zeros((4, len(error), 1, 3))
    mask = np.ones((len(error), 1), dtype=bool)
    found = model_error([RecordingPrediction("a", "fit", time, ("tip",), error[:, None], mask, zero)])
    np.testing.assert_allclose(found.scale, [3e-3, 1e-3, 1e-3], rtol=0.1)
    assert found.correlation_time == pytest.approx(0.8, rel=0.1)
    assert found.every(0.2).autocorrelation[1] == pytest.approx(np.exp(-0.2 / found.correlation_time))
    assert model_error([]) is None
