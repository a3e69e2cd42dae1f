"""Results of each verb given to the other verbs: no refusal, and no setting of the fit is lost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.model.assembly import integrator_of
from rfdropo_bayes.model.experiment import Experiment
from rfdropo_bayes.model.fitted_integrator import INTEGRATOR, stated_integrator
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.tables import parse_table

NOISE = 2e-4
PRIORS = {
    "young_modulus": {"distribution": "LogNormal", "median": 3e5, "sigma": 0.5},
    "offset_x": {"distribution": "Normal", "loc": 0.0, "scale": 0.002},
}
DAYS = {"first": "first_*", "second": "second_*"}
WALK = {"duration": 8.0, "interval": 1.0, "step": 0.002, "low": 0.0, "high": 0.004, "sample_time": 0.5}


def robot() -> rb.Robot:
    return rb.Robot.outline(name="arm", length=0.09, radius=0.012, markers={"tip": 0.09}, cables=3)


@pytest.mark.parametrize(
    "simulator", [{"motion": "quasi-static"}, {"integrator": "euler"}, {"integrator": "sdirk2", "time_step": 0.02}]
)
def test_the_tables_of_a_model_say_how_it_takes_time_steps(simulator):
    """An extended model is read from such tables."""
    model = rb.Model(robot(), priors=PRIORS, simulator=simulator)
    again = spec_of(parse_table(Experiment, model.tables(), where="tables"), Path(), model.robot)
    assert integrator_of(again) == integrator_of(model.spec) in simulator.values()
    assert again.simulator.time_step == model.spec.simulator.time_step
    assert stated_integrator(model.spec) == {INTEGRATOR: integrator_of(model.spec)}  # in the record of a fit


@pytest.mark.slow
def test_a_recording_goes_through_every_verb(tmp_path):
    """Calibrate, predict, load, adapt, predict, audit, extend, calibrate and predict, at rest."""
    still = {"motion": "quasi-static"}
    model = rb.Model(robot(), priors=PRIORS, noise="white", simulator=still, groups=DAYS, per_group={"offset_x": 0.002})

    def recorded(name, offset, seed):
        truth = {"young_modulus": 3.3e5, "offset_x": offset}
        noise = {"standard_deviation": NOISE}
        return rb.simulate(model, WALK | {"recordings": [name]}, parameters=truth, noise=noise, seed=seed)[0]

    runs = [recorded(f"first_{k}", 0.001, k) for k in range(3)]
    method = rb.Laplace(draws=50, starts=2, prior_draws=16)
    fit = rb.calibrate(model, runs[:2], method, test=runs[2:], seed=0, show=False, out=tmp_path / "fit")
    silent = {name: value for name, value in fit.record.attrs.items() if name != INTEGRATOR}  # as earlier versions were
    earlier = replace(fit, record=replace(fit.record, attrs=silent))
    new = recorded("second_a", -0.002, 4)
    day = rb.adapt(earlier, new, seconds=4.0, draws=40, group="second", show=False, out=tmp_path / "day")
    for known in (fit, day, rb.load(tmp_path / "fit"), rb.load(tmp_path / "day")):
        assert known.record.attrs[INTEGRATOR] == "quasi-static"
    errors = []
    for known in (day, rb.load(tmp_path / "day")):
        centre = rb.predict(known, new).bands["mean"].values
        errors.append(float(np.sqrt(np.mean((centre - new.position) ** 2))))
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-6)
    assert errors[0] < 3.0 * NOISE
    options, noise = rb.AuditOptions(minutes=10.0, ports=False, bootstraps=199), {"standard_deviation": NOISE}
    found = rb.audit(model, runs[:2], options, test=runs[2:], fit=day, noise=noise, out=tmp_path / "audit", show=False)
    assert found.verdict == "no_discrepancy"
    extended = rb.load(tmp_path / "audit").extended
    assert integrator_of(extended.spec) == "quasi-static"
    again = rb.calibrate(extended, runs[:2], method, seed=0, show=False)
    assert again.record.attrs[INTEGRATOR] == "quasi-static"
    rb.predict(again, new)
