"""Audits of models whose rollouts are rough, or end: what counts as fitted, and what is asked all the same."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rfdropo_bayes.discrepancy import held_out, pipeline
from rfdropo_bayes.discrepancy.audit_record import next_experiment, record
from rfdropo_bayes.discrepancy.pipeline import audit
from rfdropo_bayes.errors import NoLikelihoodError
from rfdropo_bayes.report.audit_page import render_audit, shown

from .toys import problem

TRUTH = {"gain": 1.3, "bend": -0.4}


def said(answer):
    """What audit.json has of an audit."""
    content = record(answer, versions={}, data_sha256="", next_experiment=next_experiment(answer))
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    return content


@pytest.fixture
def unfitted(monkeypatch):
    """No optimisation of the base model converges."""
    fits = pipeline.base_fits

    def stopped(*given):
        for reached in fits(*given):
            yield reached if reached.fit is None else replace(reached, fit=replace(reached.fit, promise=np.inf))

    monkeypatch.setattr(pipeline, "base_fits", stopped)


@pytest.mark.usefixtures("unfitted")
def test_a_base_fit_that_has_not_converged_is_said_and_gives_no_verdict():
    answer = audit(problem(TRUTH, 1))
    assert answer.verdict == "no_verdict"
    content = said(answer)
    assert not content["base_fit_converged"]
    assert content["findings"] == []
    assert "the fit of the base model has not converged" in content["sentence"]
    assert "--from" in content["next_experiment"]["sentence"]
    assert "has not converged" in render_audit(shown(answer), content, "rough", "")


@pytest.mark.usefixtures("unfitted")
def test_a_cause_is_named_though_the_base_model_cannot_be_fitted_without_it():
    """What a base model lacks may drive it to where motion is rough: a cause counts if the model with it is fitted."""
    answer = audit(problem({**TRUTH, "play": 1.0}, 1))
    assert (answer.base.converged, answer.converged) == (False, True)
    content = said(answer)
    assert [finding["mechanism"] for finding in content["findings"]] == ["play"]
    assert content["verdict"] == "explained"
    assert "of the base model alone has not converged" in content["sentence"]


@pytest.mark.parametrize("kept_aside", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_model_that_cannot_simulate_unseen_recordings_is_not_supported(monkeypatch, kept_aside):
    """Its motion ends there; the audit goes on without it. Unseen are test recordings, or fitted ones in turn."""
    asked, predict, lines = problem({**TRUTH, "play": 1.0}, 1), held_out._predict, []
    if not kept_aside:
        asked = replace(asked, model=replace(asked.model, recordings=asked.model.recordings.of(range(4))))
    play = asked.candidate("play").indices[0]

    def stops(target, fit, seed):
        if play in fit.free:
            raise NoLikelihoodError("a rollout at the optimum failed", where="audit", remedy="none")
        return predict(target, fit, seed)

    monkeypatch.setattr(held_out, "_predict", stops)
    answer = audit(asked, report=lines.append)
    assert (answer.unsupported, answer.steps) == (["play"], [])
    assert said(answer)["verdict"] in ("unexplained", "described")
    assert any("with play, an unseen recording cannot be simulated" in line for line in lines)
