"""One compiled program of rollouts serves all that a model computes from them, and all models of a simulator."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np

import rfdropo_bayes as rb
from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.lanes import lanes_of
from tests.verbs.toys import BOX, PRIORS

WALK = {"duration": 2.0, "interval": 0.5, "step": 0.02, "low": 0.0, "high": 0.1, "sample_time": 0.1}


def test_rollouts_are_compiled_once_for_densities_residuals_and_predictions():
    model = rb.Model(BOX, noise="white", priors=PRIORS)
    runs = rb.simulate(model, WALK | {"recordings": ["a", "b"]}, noise={"standard_deviation": 1e-3}, seed=1)
    problem = CalibrationProblem(model.numpyro(runs), chunk=8)
    values = problem.sample_prior(jax.random.key(0), 5)
    rows, status = problem.row_log_likelihood(values, problem.n_rows)
    white = problem.residuals(values, problem.n_rows)
    positions = np.asarray(problem.observe(values).position)
    assert not status.any()
    assert problem.model.lanes._rolled._cache_size() == 1
    sizes = np.asarray(values["observation_noise"])[:, None, None, None, None]
    measured = np.stack([run.position for run in runs])
    np.testing.assert_allclose(white.reshape(positions.shape), (measured - positions) / sizes, rtol=1e-6, atol=1e-9)
    total = -0.5 * np.sum(white**2, axis=1) - white.shape[1] * np.log(np.sqrt(2.0 * np.pi) * sizes.ravel())
    np.testing.assert_allclose(rows.sum(axis=1), total, rtol=1e-6)

    copy = replace(problem.model, scopes=problem.model.scopes.holding({"gain": 1.0}))
    fewer = model.numpyro(runs[:1])
    assert copy.lanes is problem.model.lanes
    assert fewer.lanes is problem.model.lanes


def test_lanes_are_of_one_simulator_its_markers_and_its_given_parameters():
    model = rb.Model(BOX)
    simulator, markers = model.simulator, np.arange(1)
    lanes = lanes_of(simulator, markers, ("gain",))
    assert lanes_of(simulator, markers, ("gain",)) is lanes
    assert lanes_of(simulator, markers, ("gain", "zero")) is not lanes
    assert lanes_of(rb.Model(BOX).simulator, markers, ("gain",)) is not lanes
