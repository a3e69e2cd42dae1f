"""What an audit says to whoever owns the robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from rfdropo_bayes.bayes.scopes import Scopes
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.discrepancy.audit_record import next_experiment, record
from rfdropo_bayes.discrepancy.fixed_quantities import with_fixed_quantities
from rfdropo_bayes.discrepancy.omnibus import BLOCK
from rfdropo_bayes.discrepancy.pipeline import Answer, audit
from rfdropo_bayes.report.audit_page import shown
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.parameters import specs_of

from .toys import BASE, NOISE, problem, with_prior


@pytest.fixture(scope="module")
def answer() -> Answer:
    """Play, then creep, both adopted; the first of them given the lesser share, and a joint test that is not passed."""
    found = audit(problem({"gain": 1.3, "bend": -0.4, "play": 1.0, "creep": 0.6, "creep_time": 0.6}, 4))
    assert len(found.adopted) == 2
    *before, last = found.test_series
    test_series = [*before, replace(last, omnibus=replace(last.omnibus, p=0.005))]
    validation = replace(found.validation, stages=[-0.01, 0.98])
    return replace(found, verdict="partly_explained", test_series=test_series, validation=validation)


def said(answer: Answer) -> str:
    return record(answer, versions={}, data_sha256="", next_experiment=None)["sentence"]


@pytest.mark.slow
def test_nothing_else_is_at_work_where_all_that_remains_is_noise(answer):
    """Errors 1 % below and 10 % above what the noise makes of a marker's distance."""
    gain = answer.validation.gain
    assert gain.floor == pytest.approx(3**0.5 * NOISE, rel=0.1)
    gains = (replace(gain, rmse_extended=k * gain.floor) for k in (0.99, 1.1))
    noise, more = (said(replace(answer, validation=replace(answer.validation, gain=each))) for each in gains)
    assert "the fitted recordings keep a pattern (joint test p < 0.005)" in noise
    assert "something else" not in noise
    assert "no more than repeats differ by" in noise
    assert "(joint test p < 0.005): something else is at work" in more
    assert "of it noise" in more


def test_a_pattern_that_only_the_pose_explains_is_said_to_follow_it(answer):
    *before, last = answer.test_series
    single = dict.fromkeys(last.omnibus.single, 0.2) | {"pose": 0.001}
    follows = replace(last, omnibus=replace(last.omnibus, single=single))
    assert "keep a pattern of a shift, a drift or the pose (joint" in said(
        replace(answer, test_series=[*before, follows])
    )
    assert "of a shift" not in said(answer)  # other tests see it as well


def test_a_rest_as_small_as_the_error_of_the_simulation_is_no_further_cause(answer):
    """Errors 10 % above the noise leave .46 of it, in quadrature."""
    floor = 3**0.5 * NOISE
    above = replace(answer.validation, gain=replace(answer.validation.gain, rmse_extended=1.1 * floor))
    fine, coarse = (said(replace(answer, numerical=k * floor, validation=above)) for k in (0.4, 0.5))
    assert "something else is at work" in fine
    assert "no larger than the error of time step and elements" in coarse
    assert "something else" not in coarse


def test_an_audit_that_was_stopped_before_a_sufficient_cause_has_no_verdict(answer):
    words = said(replace(answer, verdict="no_verdict"))
    assert words.startswith("No verdict: the best so far, ")
    assert "Unexplained" not in words
    stopped = next_experiment(replace(answer, verdict="no_verdict"))
    assert stopped["sentence"] == "Nothing yet: raise [audit] minutes, and go on with --resume."


def test_the_page_shows_the_markers_that_all_recordings_have(answer):
    """The first recording has one more, and in another order than the robot."""
    first, *rest = answer.problem.trajectories
    dataset = first.dataset.isel(marker=[3, 2, 1, 0])
    more = xr.concat(
        [dataset, dataset.isel(marker=[0]).assign_coords(marker=["m9"])], dim="marker", data_vars="minimal"
    )
    found = replace(answer, problem=replace(answer.problem, trajectories=[Trajectory(more), *rest]))
    tracks, wanted = shown(found).tracks, shown(answer).tracks
    assert [track.markers for track in tracks] == [("m1", "m2", "m3", "m4")] * len(wanted)
    for track, other in zip(tracks, wanted, strict=True):
        np.testing.assert_array_equal(track.series["measured"], other.series["measured"])


def test_the_next_step_is_about_the_largest_share(answer):
    first, second = (step.name for step in answer.steps)
    following = next_experiment(answer)
    assert following["separates"] == [second]
    assert following["sentence"] == f"Check {second} on the robot, 99 % of what is wrong: a remedy."
    without = replace(answer, validation=replace(answer.validation, stages=[]))
    assert next_experiment(without)["separates"] == [first]


def test_what_is_held_at_nominal_values_says_what_to_do_at_the_robot():
    specs = specs_of(Robot.load("asl_trunk").parameter_table())
    _, candidates = with_fixed_quantities(Scopes(()), specs, ())
    remedies = {candidate.name: candidate.mechanism.remedy for candidate in candidates}
    assert "turn each until its cable just begins to move the body" in remedies["initial_displacement"]
    assert remedies["disk_mass"].startswith("measure the disk mass at each place (base, middle, tip)")


def test_a_misfit_of_the_first_block_alone_is_asked_about(answer):
    """The first rows of a robot that set out from rest, where its recording has the first command in force before."""
    assert "initial_command" not in said(answer)
    residual = np.zeros_like(answer.base.residual)
    place = answer.target.measurements.series(np.arange(len(residual)))
    residual[place[:, :BLOCK]] = 5.0
    alone = replace(answer, base=replace(answer.base, residual=residual, jacobian=0.0 * answer.base.jacobian))
    assert "Only the first block fails: was another command in force before the first row" in said(alone)


@pytest.mark.slow
@pytest.mark.parametrize(("high", "decides"), [(0.2, True), (3.0, False)])
def test_a_prior_that_leaves_the_truth_out_is_said_beside_what_is_found(high, decides):
    """The truth bends by 0.4, where the prior ends at 0.2: a size that goes with it is no measurement."""
    narrow = {"distribution": "Uniform", "low": -high, "high": high}
    found = audit(with_prior(problem({"gain": 1.3, "bend": -0.4, "play": 1.0}, 4), BASE[1].name, narrow))
    assert found.steps
    content = record(found, versions={}, data_sha256="", next_experiment=None)
    about = [row for row in content["cautions"] if row["code"] == "at_bound"]
    assert bool(about) == decides
    assert ("bend sits on the lower end -0.2 of its prior" in content["sentence"]) == decides
    assert all(row["sentence"] in content["sentence"] for row in about)
