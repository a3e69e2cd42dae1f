"""Whether a posterior is safe to randomise over: one ground at a time."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from rfdropo_bayes.inference.result import stage_cautions
from rfdropo_bayes.posteriors import ParameterInfo
from rfdropo_bayes.report.randomisation_safety import rate_safety
from rfdropo_bayes.report.summary import bound_reached, build_summary

CORRELATED = {"all": {"correlated": True, "narrowing": 2.4}}


@pytest.fixture(scope="module")
def summary(run):
    return build_summary(run.record, run.facts)


def clean(summary):
    """The same run without its parameter at a bound."""
    spotless = copy.deepcopy(summary)
    for row in spotless["parameters"].values():
        row["at_bound"] = False
    spotless["cautions"] = []
    return spotless


def test_a_parameter_at_its_bound_asks_for_care_and_the_report_says_so(run, summary):
    assert summary["randomisation"]["verdict"] == "with care"
    assert "rayleigh_stiffness sits on a hard bound or at an end of the prior" in summary["randomisation"]["sentence"]
    assert summary["headline"][-1] == summary["randomisation"]["sentence"]
    assert any("Draw whole parameter sets" in sentence for sentence in summary["randomisation"]["advice"])
    assert any(
        "common scale of young_modulus and density" in sentence for sentence in summary["randomisation"]["advice"]
    )


LAST = {"budget_exhausted": False, "progress": 1.0, "ess": 0.6, "correlation": 0.2, "final": True}
LEAP = {"budget_exhausted": True, "progress": 1.0, "ess": 0.1, "correlation": float("nan")}
"""Stages of a sampler: the last, and one for whose moves nothing was left."""


def said(stages):
    return [caution.as_dict() for caution in stage_cautions(stages, 10.0)]


def test_without_grounds_against_it_is_safe(run, summary):
    safety = rate_safety(run.record, clean(summary))
    assert safety.verdict == "safe"
    assert safety.reasons == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s["coverage"].update({"0.9": 0.6}), "hold only 60 %"),
        (
            lambda s: s["rmse"]["test"].update({list(s["rmse"]["test"])[-1]: 1e3}),
            "no better than a predictor without physics",
        ),
        (lambda s: s["parameters"]["sigma"].update(r_hat=1.4), "independent runs disagree about sigma"),
        (lambda s: s["parameters"]["sigma"].update(ess_bulk=3.0), "fewer than 100 effective draws of sigma"),
        (lambda s: s["cautions"].extend(said([LEAP, LAST])), "10 rollouts ran out"),
        (lambda s: s["cautions"].extend(said([LAST | {"correlation": 0.98}])), "0.98 correlated"),
        (lambda s: s["excluded"].update(diverged=9000), "45 % of the rollouts failed"),
        (lambda s: s["coverage_by_role"]["test"]["tip"].update({"0.9": 0.77}), "only 77 % at the tip"),
        (lambda s: s["coverage_by_role"]["test"]["middle"].update({"0.9": 0.5}), "only 50 % at middle"),
        (lambda s: s["residuals"].update(CORRELATED), "too narrow by up to 2.4 times"),
    ],
)
def test_every_grave_ground_makes_it_unsafe(run, summary, change, words):
    changed = clean(summary)
    change(changed)
    safety = rate_safety(run.record, changed)
    assert safety.verdict == "unsafe"
    assert words in safety.sentence


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda s: s["rmse"]["test"].update({"middle": 1.6 * s["rmse"]["fit"]["middle"]}),
            "what was fitted does not hold for them",
        ),
        (lambda s: s["noise_floor_mm"].update(tip=0.1), "where repeats differ by 0.1 mm"),
        (lambda s: s["error_correlation"]["test"].update(tip=0.83), "correlation 0.83 at the tip"),
        (lambda s: s["rmse"]["test"].update(middle=0.88), "0.88 mm against"),
    ],
)
def test_errors_that_no_noise_explains_ask_for_care(run, summary, change, words):
    changed = clean(summary)
    change(changed)
    safety = rate_safety(run.record, changed)
    assert safety.verdict == "with care"
    assert words in safety.sentence


def test_without_repeats_an_error_that_lasts_is_held_against_the_best_baseline(run, summary):
    """The share of the squared error that does not last counts as noise: here there is none of it, then all is."""
    changed = clean(summary)
    changed["noise_floor_mm"] = None
    changed["error_correlation"]["test"] = {"middle": 0.0, "tip": 0.0}
    assert rate_safety(run.record, changed).verdict == "safe"
    changed["error_correlation"]["test"]["tip"] = 0.4
    for row in changed["recordings"]:
        row["rows"] = 100
    assert "at the tip" in rate_safety(run.record, changed).sentence
    for row in changed["recordings"]:
        row["rows"] = 10  # whose correlation is as large by chance
    assert rate_safety(run.record, changed).verdict == "safe"


def test_a_prior_that_excludes_the_data_is_said(run, summary):
    prior = {**run.record.prior, "sigma": run.record.prior["sigma"] * 1e-3}
    safety = rate_safety(replace(run.record, prior=prior), clean(summary))
    assert safety.verdict == "unsafe"
    assert "outermost 1 % of the prior" in safety.sentence
    assert "sigma" in safety.sentence


def test_the_end_of_a_uniform_prior_is_a_bound_too():
    """Exponential draws at the end of the range, far inside the hard bounds; 2000 of them leave no doubt."""
    info = ParameterInfo("p", "-", 0.1, 0.499, {"distribution": "Uniform", "low": 0.4, "high": 0.49})
    draws = np.random.default_rng(4).exponential(0.004, 2000)
    assert bound_reached(0.4 + draws, info) == "low"
    assert bound_reached(0.49 - draws, info) == "high"
    assert bound_reached(0.44 + draws, info) is None
