"""Models that are far off: the noise under which they are judged, and what becomes of it when they no longer are."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rfdropo_bayes.bayes.noise import Autoregression
from rfdropo_bayes.bayes.noise.autoregression import INNOVATIONS, MISFIT, REPEATS, RESIDUALS
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.discrepancy.base_fit import base_model, first_target, residual_noise
from rfdropo_bayes.discrepancy.extension import ExtensionSearch
from rfdropo_bayes.discrepancy.fit import optimise
from rfdropo_bayes.discrepancy.inadequacy import POOR, as_measured, leaves_noise, misspecified, residual_deviation
from rfdropo_bayes.discrepancy.journal import Journal
from rfdropo_bayes.discrepancy.pipeline import audit

from .toys import NOISE, problem

TRUTH = {"gain": 1.3, "bend": -0.4}


@pytest.fixture(scope="module")
def far():
    """A problem whose base model lacks a large play, the target of its fit and its fit."""
    asked = problem({**TRUTH, "play": 8.0}, 3)
    return asked, *base_model(asked, 0)


def test_a_model_that_is_far_off_is_judged_by_the_size_of_what_it_leaves_and_no_other_is(far):
    _, fit_target, fit = far
    left = fit_target.errors(fit.x)
    size = np.sqrt(np.mean(left**2))
    assert size > np.sqrt(POOR) * NOISE
    assert (fit_target.noise.source, fit_target.measured.noise.source) == (MISFIT, REPEATS)
    np.testing.assert_allclose(residual_deviation(fit_target, fit), size, rtol=1e-6)
    # Rows that last count as fewer: the noise of the fit's target is that of white rows that would tell as much.
    assert np.all(fit_target.noise.scale >= size * (1 - 0.1))
    right, found = base_model(problem(TRUTH, 3), 0)
    assert right.known is None
    np.testing.assert_array_equal(residual_deviation(right, found), right.noise.scale)


def test_a_fit_seen_under_the_measurements_noise_is_what_that_noise_makes_of_its_rollouts(far):
    _, fit_target, fit = far
    known, seen = fit_target.measured, as_measured(fit_target, fit)
    np.testing.assert_allclose(seen.residual, known.residual(fit.x[None])[0], atol=1e-5 * np.abs(seen.residual).max())
    slopes = known.jacobian(fit.x, fit.free)
    np.testing.assert_allclose(seen.jacobian, slopes, atol=1e-5 * np.abs(slopes).max())
    np.testing.assert_array_equal(seen.covariance, fit.covariance)


def test_a_step_of_a_model_that_is_far_off_brings_nats_by_rows_that_count(far):
    """Half a nat a row for each factor e of the squared residual; the measurement's noise gives ten times as much."""
    asked, fit_target, fit = far
    search = ExtensionSearch(fit_target, asked.candidates, asked.rules, 0)
    tests = search.score_tests(fit)
    assert tests.omnibus.p == 1 / (1 + asked.rules.bootstraps)
    better = search.refit(fit, tests.row("play"))
    rows = np.count_nonzero(fit.residual)
    shrunk = np.log((fit.residual @ fit.residual) / (better.residual @ better.residual))
    assert asked.rules.evidence < better.log_evidence - fit.log_evidence < 0.5 * rows * shrunk
    known = fit_target.measured
    alone, both = optimise(known, fit.x, fit.free), optimise(known, better.x, better.free)
    assert both.log_evidence - alone.log_evidence > 10.0 * (better.log_evidence - fit.log_evidence)
    assert not misspecified(known, both.x)


@pytest.mark.slow
def test_an_audit_ends_under_the_measurements_noise_where_the_extended_model_is_right(far):
    asked, *_ = far
    answer = audit(replace(asked, rules=replace(asked.rules, bootstraps=199)))
    assert [step.name for step in answer.steps] == ["play"]
    assert answer.steps[0].fit_target.known is None
    assert answer.verdict == "explained"
    assert answer.target.noise.source == REPEATS
    assert np.mean(answer.extended.residual**2) < 1.2 < POOR < np.mean(answer.base.residual**2)


def test_slow_residuals_are_a_misfit_and_no_autoregression_explains_them():
    """Without repeats: a wave of 20 deviations over 2 s is no noise, though an autoregression could follow it. Noise
    with the memory of a measurement stays one."""
    measured = first_target(replace(problem(TRUTH, 3), trajectories=problem(TRUTH, 3).trajectories[2:]), Journal())
    rng, shape = np.random.default_rng(0), measured.measurements.count.shape
    white = NOISE * rng.standard_normal(shape)
    wave = 20.0 * NOISE * np.sin(np.pi * measured.measurements.time)[..., None]
    remembered = np.array(white)
    for row in range(1, shape[1]):
        remembered[:, row] = 0.6 * remembered[:, row - 1] + 0.8 * white[:, row]
    found = {}
    for name, errors in (("slow", wave + white), ("quick", remembered)):
        target = SimpleNamespace(measured=measured, errors=lambda x, errors=errors: errors)
        found[name] = residual_noise(target, SimpleNamespace(x=None, free=np.arange(2))).first
    assert (found["slow"].source, found["slow"].order) == (INNOVATIONS, 0)
    assert np.mean(found["slow"].scale) < 10.0 * NOISE  # of waves of 14 in the root mean square
    assert (found["quick"].source, found["quick"].order) == (RESIDUALS, 1)
    np.testing.assert_allclose(np.mean(found["quick"].scale), NOISE, rtol=0.1)


@pytest.mark.parametrize(
    ("before", "left", "memory", "noise"),
    [
        (INNOVATIONS, RESIDUALS, 0.93, False),  # 86 % predicted: less than before, and still a misfit
        (INNOVATIONS, RESIDUALS, 0.6, True),
        (RESIDUALS, RESIDUALS, 0.93, True),  # the base model's own noise was such an autoregression
        (RESIDUALS, INNOVATIONS, 0.0, False),
    ],
)
def test_beside_a_misspecified_model_only_quick_residuals_are_noise(before, left, memory, noise):
    first, second = (
        Stacked((Autoregression(np.full(3, NOISE), np.array([1.0, rho]), source, np.inf),))
        for source, rho in ((before, 0.0), (left, memory))
    )
    assert leaves_noise(first, second) == noise


def test_bands_have_the_size_of_what_their_own_model_leaves_and_not_of_the_model_that_gave_the_noise():
    """Without repeats the noise is the residuals' of an earlier model, here twice what the last model leaves."""
    measured = first_target(problem(TRUTH, 3), Journal())
    errors = NOISE * np.random.default_rng(0).standard_normal(measured.measurements.count.shape)
    own = {"known": None, "measurements": measured.measurements, "errors": lambda x: errors}
    deviations = {
        source: residual_deviation(
            SimpleNamespace(noise=SimpleNamespace(source=source, scale=np.full(errors.shape[-1], 2.0 * NOISE)), **own),
            SimpleNamespace(x=None),
        )
        for source in (RESIDUALS, REPEATS)
    }
    np.testing.assert_allclose(deviations[RESIDUALS], NOISE, rtol=0.05)
    np.testing.assert_allclose(deviations[REPEATS], 2.0 * NOISE)
