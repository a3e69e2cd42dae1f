"""Sizes that an audit reports: under priors no narrower than they are. Seeds are fixed; each assertion fails for one
seed in a thousand or fewer."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.bayes.lanes import Lanes
from rfdropo_bayes.discrepancy.audit_problem import AuditProblem
from rfdropo_bayes.discrepancy.base_fit import base_model
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, optimise, widened

from .toys import WIDE, Toy, problem, with_prior

TRUTH = {"gain": 1.3, "bend": -0.4}


def with_delay(asked: AuditProblem) -> tuple[FitTarget, Fit, int]:
    """The model with a delay, under the noise of the measurement, its fit, and which coordinate the delay is."""
    target, base = base_model(asked, 0)
    target = target.measured
    index = asked.coordinates.names.index("delay")
    return target, optimise(target, base.x, np.array([*base.free, index])), index


def test_a_size_far_outside_its_prior_is_not_drawn_back_and_a_usual_one_is_left():
    """Of a linear model: a fit under a prior that was as wide from the start."""
    asked = with_prior(problem({**TRUTH, "delay": 9.0}, 2), "delay", {**WIDE, "scale": 0.01})
    target, fit, index = with_delay(asked)
    found = widened(target, fit)
    size, deviation = 0.01 * np.array([fit.x[index], np.sqrt(fit.covariance[-1, -1])])
    assert size < 9.0 - 1.645 * deviation  # without this, its 90 % interval would miss the truth
    wide = with_prior(asked, "delay", {**WIDE, "scale": size})
    _, expected, _ = with_delay(wide)
    scales = np.ones(len(fit.free)) * [1.0, 1.0, 0.01 / size]
    np.testing.assert_allclose(found.x[fit.free] * scales, expected.x[fit.free], rtol=1e-3)
    np.testing.assert_allclose(found.covariance * np.outer(scales, scales), expected.covariance, rtol=1e-2)
    usual = replace(fit, x=np.where(np.arange(len(fit.x)) == index, 0.9, fit.x))
    assert widened(target, usual) is usual


class Ridge(Toy):
    """A ``delay`` over a stiffness, whose logarithm ``bend`` is, and which nothing else tells."""

    def rollout(self, parameters, commands, steps=None):
        values = {spec.name: jnp.asarray(spec.nominal) for spec in Toy.parameters} | dict(parameters)
        ratio = values["delay"] * jnp.exp(-values["bend"])
        return super().rollout(values | {"delay": ratio, "bend": jnp.zeros(())}, commands, steps)


@pytest.mark.slow
def test_a_wider_prior_leaves_a_ratio_that_motion_tells_however_curved_its_line_is():
    """A first-order step to the wider prior leaves the line on which the ratio is constant."""
    asked = problem({"gain": 1.3, "bend": 0.0, "delay": 40.0}, 3)
    target, mode, index = with_delay(replace(asked, lanes=Lanes(Ridge(), np.arange(4))))
    on_line = asked.coordinates.encode({"gain": 1.3, "bend": np.log(6.5 / 40.0), "delay": 6.5})
    fit = optimise(target, on_line, mode.free, evaluations=0)
    before = target.forward.rollouts
    found = widened(target, fit)
    assert target.forward.rollouts > before
    narrow = np.array([0.0, 0.0, 1.0 - 1.0 / fit.x[index] ** 2])  # what the wider prior takes off the precision
    covariance = np.linalg.inv(np.linalg.inv(fit.covariance) - np.diag(narrow))
    straight = fit.x.copy()
    straight[fit.free] += covariance @ (narrow * fit.x[fit.free])

    def away(x: np.ndarray, covariance: np.ndarray) -> float:
        """Of the logarithm of the ratio from the truth, in its deviations."""
        named, stiffness = asked.coordinates.named(x), asked.coordinates.slopes(x[None])[0, 1]
        slope = np.array([0.0, -stiffness, 1.0 / x[index]])
        error = np.log(named["delay"] / 40.0) - named["bend"]
        return float(error / np.sqrt(slope @ covariance @ slope))

    assert abs(away(found.x, found.covariance)) < 3.3
    assert abs(away(straight, covariance)) > 10.0
