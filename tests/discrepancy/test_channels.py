"""Audits of more than positions: what tensions show, and weighed parts. Seeds are fixed; each assertion on one data set
fails for about one seed in a hundred or fewer."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rfdropo_bayes.bayes.channels import Weighed
from rfdropo_bayes.discrepancy.audit_record import next_experiment, record
from rfdropo_bayes.discrepancy.base_fit import base_model
from rfdropo_bayes.discrepancy.pipeline import audit
from rfdropo_bayes.discrepancy.score import span
from rfdropo_bayes.discrepancy.score_tests import null_residuals

from .toys import problem_of_cables


def found(truth: dict, seed: int, tension: bool):
    answer = audit(problem_of_cables(truth, seed, tension))
    return json.loads(json.dumps(record(answer, versions={}, data_sha256="", next_experiment=next_experiment(answer))))


@pytest.mark.slow
def test_a_friction_that_only_tensions_show_is_named_with_them_and_said_to_be_invisible_without():
    with_tension, without = (found({"drag": 0.5}, 31, tension) for tension in (True, False))
    assert with_tension["channels"] == ["markers", "tension"]
    assert with_tension["verdict"] == "explained"
    (finding,) = with_tension["findings"]
    assert finding["equivalence_class"] == ["drag"]
    size = finding["parameters"]["drag"]
    assert abs(size["mean"] - 0.5) < 4 * size["sd"]
    spread = with_tension["noise"]["other_channels"]["tension"]["standard_deviation"]
    np.testing.assert_allclose(spread, 0.02, rtol=0.3)  # 160 values each, two thirds free: 7 %
    assert without["channels"] == ["markers"]
    assert without["verdict"] == "no_discrepancy"
    row = next(c for c in without["candidates"] if c["mechanism"] == "drag")
    assert not row["visible"]
    assert "cannot show" in without["sentence"]
    assert "drag" in without["sentence"]


@pytest.mark.slow
def test_where_nothing_is_wrong_tensions_raise_no_alarm_and_positions_are_still_read():
    assert found({}, 32, True)["verdict"] == "no_discrepancy"
    content = found({"play": 1.0}, 33, True)
    assert [finding["mechanism"] for finding in content["findings"]] == ["play"]


@pytest.mark.slow
def test_a_weighed_part_holds_its_parameter_where_it_was_weighed():
    """A gain weighed 10 of its deviations off pulls the base fit there, and is one more residual of every data set."""
    free, held = (base_model(problem_of_cables({}, 34, True, weighed), 0) for weighed in ((), WEIGHED))
    target, base = held
    value = target.forward.coordinates.named(base.x)["gain"]
    assert target.forward.coordinates.named(free[1].x)["gain"] == pytest.approx(1.3, abs=0.02)
    assert value == pytest.approx(1.4, abs=0.02)
    assert target.measurements.names_of_channels == ("markers", "tension", "weighed")
    assert base.residual[-1] == pytest.approx((1.4 - value) / 1e-4, rel=1e-6)
    assert len(base.residual) == target.measurements.size == free[0].measurements.size + 1
    drawn = null_residuals(target.measurements, target.noise, span(base.jacobian), 2, np.random.default_rng(0), 3)
    assert drawn.shape == (3, target.measurements.size)
    slope = target.jacobian(base.x, base.free)
    further = base.x.copy()
    further[0] += 1e-5
    change = target.residual(base.x[None])[0] - target.residual(further[None])[0]
    np.testing.assert_allclose(change / 1e-5, slope[:, 0], rtol=1e-3, atol=1e-3 * np.abs(slope[:, 0]).max())


WEIGHED = (Weighed(("gain",), 1.4, 1e-4),)


@pytest.mark.slow
def test_without_repeats_each_channel_s_noise_is_that_of_its_own_residuals():
    asked = problem_of_cables({}, 35, True)
    single = [0, *range(3, 10)]
    recordings = asked.model.recordings.of(single)
    channels = tuple(channel.of_recordings(single) for channel in asked.model.channels)
    model = replace(asked.model, recordings=recordings, channels=channels)
    target, _ = base_model(replace(asked, model=model, trajectories=[asked.trajectories[i] for i in (0, 3)]), 0)
    positions, tensions = target.noise.parts
    assert target.noise.source == "residuals"
    np.testing.assert_allclose(positions.scale, 5e-4, rtol=0.25)
    np.testing.assert_allclose(tensions.scale, 0.02, rtol=0.25)
    assert (positions.order, tensions.order) == (1, 0)
