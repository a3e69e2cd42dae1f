"""Effects that pay only together, and effects that the base model has already. Seeds are fixed."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from rfdropo_bayes.discrepancy import naming, repairs
from rfdropo_bayes.discrepancy.base_fit import base_model
from rfdropo_bayes.discrepancy.extension import Added, ExtensionSearch
from rfdropo_bayes.discrepancy.fit import optimise
from rfdropo_bayes.discrepancy.pipeline import audit
from rfdropo_bayes.discrepancy.repairs import optimised_again, simplified, without

from .toys import Geared, Opposed, Turned, problem_of

TRUTH = {"gain": 1.3, "bend": -0.4}


@pytest.fixture(scope="module")
def opposed():
    """Stretch and slack of opposite signs, each of which alone takes next to nothing of what the base model leaves."""
    return problem_of(Opposed(), {**TRUTH, "stretch": 25.0, "slack": -25.0}, 3)


@pytest.mark.slow
def test_two_effects_that_pay_only_together_are_named_together(opposed):
    lines: list[str] = []
    answer = audit(opposed, lines.append)
    assert {step.name for step in answer.steps} == {"stretch", "slack"}
    assert any(line.startswith("refit with slack and stretch: ") for line in lines)
    alone, beside = (step.log_bayes_factor for step in answer.steps)
    assert alone < opposed.rules.evidence < 30.0 < beside
    assert answer.verdict == "explained"
    values = opposed.coordinates.values(answer.draws)
    for name, true in (("stretch", 25.0), ("slack", -25.0)):
        sizes = values[:, opposed.coordinates.names.index(name)]
        assert abs(sizes.mean() - true) < 4 * sizes.std()


@pytest.mark.slow
def test_without_pairs_neither_of_the_two_is_named(opposed, monkeypatch):
    monkeypatch.setattr(naming, "paying_pair", lambda *given: [])
    assert audit(opposed).steps == []


@pytest.mark.slow
def test_equal_gains_of_all_cables_are_not_credited_where_the_radius_of_the_drums_does_the_same(monkeypatch):
    """A base fit that stopped at half the radius, and gains of the cables that make up for it. Optimisations that do
    not move show where they start: at the base model whose radius imitates the gains, which is as good as they are."""
    asked = problem_of(Geared(), {"radius": 1.0, **TRUTH}, 4, base=3)
    target, right = base_model(asked, 0)
    tests = ExtensionSearch(target, asked.candidates, asked.rules, 0).score_tests(right)
    radius, *gains = (asked.coordinates.names.index(name) for name in ("radius", "gain_a", "gain_b"))
    stuck = partial(optimise, evaluations=0)
    half = 0.5 * asked.coordinates.named(right.x)["radius"]
    halved, made_up = right.x.copy(), right.x.copy()
    halved[radius] = made_up[radius] = asked.coordinates.encode_one(radius, (half,))[0]
    made_up[gains] = half  # in deviations of a prior of one
    stopped, extended = stuck(target, halved, right.free), stuck(target, made_up, np.array([*right.free, *gains]))
    gained = extended.log_evidence - stopped.log_evidence
    assert gained > 100.0
    step = Added("cable_gains", ("cable_gains",), replace(tests, fit=stopped), extended, gained, {}, target)
    monkeypatch.setattr(repairs, "optimise", stuck)
    search = ExtensionSearch(target, asked.candidates, asked.rules, 0)
    again = optimised_again(search, step)
    assert again is not None
    assert again.x[radius] == pytest.approx(right.x[radius], rel=1e-3)
    assert again.log_evidence > extended.log_evidence
    # Where the base model is at its optimum, none is better.
    assert optimised_again(search, replace(step, before=replace(tests, fit=right))) is None


@pytest.mark.slow
def test_a_common_gain_takes_the_place_of_single_gains_after_the_effect_that_they_imitated():
    """Gains of both cables were named while play was not in the model; a common gain and play are the truth."""
    asked = problem_of(Turned(), {"radius": 1.0, "play": 3.0, **TRUTH}, 4)
    target, base = base_model(asked, 0)
    search = ExtensionSearch(target, asked.candidates, asked.rules, 0)
    tests = search.score_tests(base)
    gains, radius, play = (search.candidate(name) for name in ("cable_gains", "radius", "play"))
    one = optimise(target, base.x, np.array([*base.free, *gains.indices]))
    both = optimise(target, one.x, np.array([*one.free, *play.indices]))
    refits = {"cable_gains": 9.0, "radius": 8.0, "delay": 1.0}
    steps = [
        Added("cable_gains", ("cable_gains",), tests, one, 9.0, refits, target),
        Added("play", ("play",), tests, both, 9.0, {}, target),
    ]
    kept = simplified(search, base, steps)
    assert [step.name for step in kept] == ["play", "radius"]
    assert kept[1].members == ("radius",)  # single gains contain it, at the price of one more parameter
    assert set(kept[1].fit.free) == {*base.free, *play.indices, *radius.indices}
    assert kept[1].fit.log_evidence > both.log_evidence
    # A candidate that was not refitted in that step is no alternative.
    assert simplified(search, base, [replace(steps[0], refits={"cable_gains": 9.0}), steps[1]])[0].name == "cable_gains"
    # A step that took the place of another was tested beside its rivals alone; the next step is tested anew.
    rivals = replace(tests, rows=(tests.row("cable_gains"),))
    (left,) = without(search, [replace(steps[0], before=rivals), steps[1]], 0, base)
    assert left.before.row("play").probe is not None
    assert left.before.fit is base
