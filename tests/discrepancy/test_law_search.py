"""A whole audit that describes an unknown cause: a marker of the toy that moves by the product of both commands."""

from __future__ import annotations

import copy
import itertools
import json
from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.bayes.channels import Markers
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.discrepancy import described as described_module
from rfdropo_bayes.discrepancy.audit_record import next_experiment, record
from rfdropo_bayes.discrepancy.base_fit import base_model
from rfdropo_bayes.discrepancy.described import Described, coefficients, describe
from rfdropo_bayes.discrepancy.experiment_design import Hypothesis, at_hand, outlooks
from rfdropo_bayes.discrepancy.extension import Added, ExtensionSearch
from rfdropo_bayes.discrepancy.fit import optimise
from rfdropo_bayes.discrepancy.held_out import predicted, stages_of
from rfdropo_bayes.discrepancy.inadequacy import POOR, as_measured, noise_share
from rfdropo_bayes.discrepancy.law_search import TIED, LinearModel, _relinearised, law_search
from rfdropo_bayes.discrepancy.law_words import law_tables, ports_sentence
from rfdropo_bayes.discrepancy.naming import Named
from rfdropo_bayes.discrepancy.pipeline import audit
from rfdropo_bayes.discrepancy.port_responses import responses, under
from rfdropo_bayes.discrepancy.port_rollouts import PortedForward, placed
from rfdropo_bayes.mechanisms.features import Feature
from rfdropo_bayes.mechanisms.ports import Port, port_map
from rfdropo_bayes.report.audit_page import render_audit, shown
from rfdropo_bayes.report.residual_file import residual_dataset
from rfdropo_bayes.verbs.design import _with_laws

from .toys import STEP, Toy, problem, recordings

SIZE = 3e-3  # [m] per square of the command's unit
TRUTH = {"gain": 1.3, "bend": -0.4}


class Pushed(Toy):
    """Marker m3 moves along x by the product of both commands, which no candidate does."""

    pushed = SIZE

    def rollout(self, parameters, commands, steps=None):
        seen = super().rollout(parameters, commands, steps)
        level = jnp.concatenate([commands.initial[None], commands.step])
        return seen._replace(position=seen.position.at[:, 2, 0].add(self.pushed * level[:, 0] * level[:, 1]))


REST, LARGE = 3e-3, 25e-3  # [m], and [m] per square of the command's unit
PATTERN = np.random.default_rng(11).normal(size=(4, 3))


class Elsewhere(Toy):
    """All markers move by six times the noise in a way that no feature and no candidate says."""

    pushed = 0.0

    def rollout(self, parameters, commands, steps=None):
        seen = super().rollout(parameters, commands, steps)
        level = jnp.concatenate([commands.initial[None], commands.step])
        rest = REST * jnp.sin(9.0 * STEP * jnp.cumsum(jnp.abs(level[:, 0] - level[:, 1])))
        position = seen.position + rest[:, None, None] * PATTERN
        return seen._replace(position=position.at[:, 2, 0].add(self.pushed * level[:, 0] * level[:, 1]))


class PushedFar(Pushed):
    """The same by eight times as much, which leaves the base model far off."""

    pushed = LARGE


class PushedElsewhere(Elsewhere):
    """Marker m3 moves along x by the product of both commands, too."""

    pushed = LARGE


BEHIND = 0.17  # [s], between the time constants that the search tries


class Lagging(Toy):
    """Marker m3 moves along x by how far the first command is ahead of itself low-passed."""

    pushed = SIZE

    def rollout(self, parameters, commands, steps=None):
        seen = super().rollout(parameters, commands, steps)
        level = jnp.concatenate([commands.initial[None], commands.step])
        ahead = Feature("lag", (0,), BEHIND).over(level, STEP)
        return seen._replace(position=seen.position.at[:, 2, 0].add(self.pushed * ahead))


MANY = {(0, 0): (0, 0), (1, 1): (0, 1), (2, 0): (1, 1), (3, 2): (0, 0)}
"""Markers and coordinates that are pushed, and the commands by whose product."""


class PushedAtMany(Toy):
    """Four markers, each along one coordinate by a product of commands."""

    def rollout(self, parameters, commands, steps=None):
        seen = super().rollout(parameters, commands, steps)
        level, position = jnp.concatenate([commands.initial[None], commands.step]), seen.position
        for (marker, axis), (one, other) in MANY.items():
            position = position.at[:, marker, axis].add(SIZE * level[:, one] * level[:, other])
        return seen._replace(position=position)


def searched(toy, alike=False):
    """Problem, fit target, base model and the search's findings of recordings of a toy."""
    question = asked(6, toy, alike)
    target, base = base_model(question, question.seed)
    options = (question.ports, ("a", "b"), "m", question.seed, question.rules.level, lambda line: None)
    return question, target, base, law_search(target, *options).find(target, base)


def asked(seed, toy=None, alike=False, truth=TRUTH):
    """The audit of the plain toy on recordings of another one."""
    plain, trajectories = problem({}, seed), recordings(truth, seed, toy, alike=alike)
    gathered = gather_recordings(Toy(), trajectories)
    model = replace(plain.model, recordings=gathered, channels=(Markers.gather(gathered, "repeats"),))
    return replace(
        plain, model=model, trajectories=trajectories[:4], ports=port_map(plain.lanes.simulator, gathered.markers)
    )


@pytest.mark.slow
def test_a_law_at_a_marker_is_described_with_its_size_and_its_worth():
    answer = audit(asked(5, Pushed()))
    content = record(answer, versions={}, data_sha256="", next_experiment=next_experiment(answer))
    assert json.loads(json.dumps(content, allow_nan=False))["verdict"] == "described"
    law = content["law"]
    assert (law["port"], law["holds"]) == ("marker m3 x", True)
    (term,) = law["terms"]
    assert (term["feature"], term["unit"]) == ("product", "1/m")
    assert abs(term["mean"] - SIZE) < 4.0 * term["sd"]
    assert law["explained_fraction"] > 0.8
    assert law["rmse_after_mm"] < law["rmse_before_mm"]
    assert content["ports"]["left_out"]
    assert content["ports"]["ports"][0]["adjusted_p"] <= 0.02
    for words in ("no mechanism of the library", "marker m3 x", "u_a u_b", "unseen recordings"):
        assert words in content["sentence"]
    assert set(law["by_trajectory"]) == set(answer.described.held_out.unseen.names)
    described = replace(answer.described, holds=False)  # as if unseen recordings did not support it
    refused = ports_sentence(replace(answer, described=described))
    for words in ("a law that unseen recordings do not support", "mm without it", "at marker m3 x", "u_a u_b"):
        assert words in refused
    (table,) = law_tables(answer)
    assert table["port"] == "marker m3 x"
    assert table["terms"][0]["commands"] == ["a", "b"]
    left = residual_dataset(answer)
    assert float((left.residual_last**2).mean()) < float((left.residual_base**2).mean())
    assert left.signal.sel(port="marker m3 x").shape == (2, left.sizes["signal_time"])
    assert "Law and port" in render_audit(shown(answer), content, "toy", "")


BOTH = {**TRUTH, "play": 8.0}  # a mechanism of the library, whose effect is larger than the push of marker m3


@pytest.mark.slow
def test_a_mechanism_that_takes_more_away_than_the_law_beside_it_is_said_first():
    answer = audit(asked(5, Pushed(), truth=BOTH))

    def said(changed):
        content = record(changed, versions={}, data_sha256="", next_experiment=next_experiment(changed))
        return content["sentence"], content["next_experiment"]["sentence"]

    words, following = said(answer)
    assert answer.verdict == "described"
    assert answer.law.beside == ("play",)
    assert words.startswith("Play (")
    assert words.index("of the discrepancy in unseen") < words.index("A smaller effect acts") < words.index("marker m3")
    assert words.index("marker m3") < words.index("of what is left in unseen recordings")
    assert following.startswith("Check play on the robot")
    less = replace(answer.validation.gain, rmse_base=answer.law.gain.rmse_base)
    words, following = said(replace(answer, validation=replace(answer.validation, gain=less)))
    assert words.startswith("An effect acts")
    assert "Beside it, play of the library" in words
    assert "whether marker m3" in following


@pytest.mark.slow
def test_no_law_is_sought_for_less_than_matters():
    """The same recordings: what the play leaves is below a stated limit."""
    given = asked(5, Pushed(), truth=BOTH)
    left = 3e-3  # [m]
    answer = audit(replace(given, rules=replace(given.rules, matters=left)))
    assert answer.verdict == "explained"
    assert [step.name for step in answer.steps] == ["play"]
    assert answer.described is None
    assert answer.test_series[-1].omnibus.p <= given.rules.extended_passes
    assert np.sqrt(3.0) * answer.remainder.amplitude < left


@pytest.mark.parametrize(("left", "said"), [(1.0, "at marker tip x, of 0.002 m"), (30.0, "at marker tip x explains")])
def test_a_model_that_is_far_off_is_told_no_size_of_a_signal(left, said):
    """There the noise is as large as what is left, and shrinks the signal to half of what it is."""
    row = SimpleNamespace(port=Port("marker tip x", "sensing", "marker", 0, 0, "m", 1e-3, ""), amplitude=0.002)
    found = SimpleNamespace(significant=lambda family: [row])
    described = SimpleNamespace(holds=False, search=found, last=None)
    problem = SimpleNamespace(rules=SimpleNamespace(level=0.02))
    answer = SimpleNamespace(described=described, problem=problem, extended=SimpleNamespace(residual=np.full(9, left)))
    assert said in ports_sentence(answer)
    assert ports_sentence(answer).endswith("no law of it holds.")


@pytest.mark.slow
def test_a_term_that_unseen_recordings_do_not_support_is_cut(monkeypatch):
    """A search whose later terms bring nothing, because they are the first term again, ends after two of them."""
    question = asked(5, Pushed())
    target, base = base_model(question, question.seed)
    options = (question.ports, ("a", "b"), "m", question.seed, question.rules.level, lambda line: None)
    search = replace(law_search(target, *options), most=1)
    once = search.find(target, base)

    class Twice:
        def laws(self, *_):
            yield from (
                replace(once, terms=[*once.terms] * count, afterwards=[*once.afterwards] * count)
                for count in itertools.count(1)
            )

    monkeypatch.setattr(described_module, "law_search", lambda *_: Twice())
    said = []
    *_, found = describe(question, Named(search_of(question, target), base), None, said.append)
    assert found.holds
    assert [refit.term.port.name for refit in found.search.terms] == ["marker m3 x"]
    assert len(found.held_out.predictions) == 2
    assert said == ["unseen recordings do not support more than 1 of 3 terms: the search ends"]


@pytest.mark.slow
def test_a_law_in_a_model_that_is_far_off_is_found_under_the_noise_that_candidates_are_judged_by():
    """Under the noise of the measurement its port had 15,775 nats, and two terms followed that are not there."""
    question, target, base, found = searched(PushedElsewhere())
    assert target.known is not None
    rows = np.count_nonzero(base.residual)
    (term,) = found.terms
    assert (term.term.port.name, term.term.feature.formula("ab")) == ("marker m3 x", "u_a u_b")
    assert term.target.known is not None  # the rest is still there
    assert found.ports[0].port.name == "marker m3 x"
    assert 0.0 < found.ports[0].log_evidence < term.gain.gain < 0.1 * rows
    assert [row.port.name for row in found.significant(question.rules.level)] == ["marker m3 x"]
    scale = term.term.spec.prior["scale"]
    assert abs(scale * term.fit.x[-1] - LARGE) < 3.0 * scale * np.sqrt(term.fit.covariance[-1, -1])
    assert 0.0 < term.gain.share < 1.0
    # A design of what to send next looks at both models under that noise: of that of the measurement, what either
    # leaves is a hundred times as much, and the commands at hand would seem to tell them apart many times as well.
    named = [Hypothesis("named", base)]
    fit_target, seen, hypotheses = _with_laws(question, target, base, named, found.alternatives)
    assert fit_target.noise is term.target.noise
    left = fit_target.residual(base.x[None])[0]
    np.testing.assert_allclose(seen.residual, left, atol=1e-6 * np.abs(left).max())
    np.testing.assert_array_equal(hypotheses[-1].fit.residual, seen.residual)
    np.testing.assert_array_equal(hypotheses[0].fit.residual, term.fit.residual)
    assert hypotheses[0].fit.residual @ hypotheses[0].fit.residual < POOR * rows
    both = [hypotheses[0], hypotheses[-1]]
    measured = [as_measured(term.target, term.fit), as_measured(target, base)]
    surer = [replace(h, fit=fit) for h, fit in zip(both, measured, strict=True)]
    (pair,), (other,) = at_hand(fit_target, both).values(), at_hand(fit_target, surer).values()
    assert 10.0 * pair < other


@pytest.mark.slow
def test_no_law_is_found_in_a_model_that_is_far_off_for_another_reason():
    """Under the noise of the measurement a law of three terms was, with scores of 138 to 198 nats."""
    question, target, _, found = searched(Elsewhere())
    assert target.known is not None
    assert found.terms == []
    assert found.significant(question.rules.level) == []


@pytest.mark.slow
def test_terms_are_told_apart_under_the_noise_that_the_model_with_the_best_one_leaves():
    """With the law the model is no longer far off, and the noise is that of the measurement."""
    _, target, _, found = searched(PushedFar(), alike=True)
    assert target.known is not None
    (best,), ties = found.terms, found.ties
    assert best.target.known is None
    assert {"u_a u_a", "u_a u_b", "u_b u_b"} <= {refit.term.feature.formula("ab") for refit in (best, *ties)}
    for tie in ties:
        assert tie.target.known is None
        assert tie.score == pytest.approx(best.score - 0.5 * (tie.square - best.square))
        assert 0.5 * (tie.square - best.square) < TIED


@pytest.mark.slow
def test_responses_under_another_noise_are_those_that_rollouts_give_under_it():
    question = asked(6, Elsewhere())
    fit_target, base = base_model(question, question.seed)
    table = law_search(fit_target, question.ports, ("a", "b"), "m", 0, 0.02, lambda line: None).table
    known = fit_target.measured
    far, near = (responses(t, as_measured(fit_target, base), question.ports, table) for t in (fit_target, known))
    seen = under(far, fit_target, known)
    for port, part in near.whitened.items():
        assert not np.allclose(far.whitened[port], part)
        np.testing.assert_allclose(seen.whitened[port], part, atol=1e-9 * np.abs(part).max())
    assert (seen.noise, near.noise) == (1.0, 1.0)
    # Of the readings that are means of three repeats, noise is a third; the same noise over what is left, squared.
    share = np.mean(1.0 / known.measurements.count) * float(np.mean((known.noise.scale / fit_target.noise.scale) ** 2))
    assert far.noise == noise_share(fit_target) == pytest.approx(share)
    assert under(near, known, known) is near


@pytest.mark.slow
def test_what_a_term_brings_beside_a_model_is_told_by_rollouts_of_that_model():
    """At a port of sensing, which is linear, it is what the responses say; of a model that has the law it is little."""
    question, target, base, found = searched(Pushed())
    options = (question.ports, ("a", "b"), "m", question.seed, question.rules.level, lambda line: None)
    search = law_search(target, *options)
    given = responses(target, base, question.ports, search.table)
    values = search.table.over(given.levels)
    given = search._sharpened(target, base, given, values, found.ports)
    told = search._ranked(given, values, 0.0)[:3]
    seen = search._beside(LinearModel(target, [], base, given), told)
    for one, other in zip(told, seen, strict=True):
        for name in ("gain", "share", "size", "sd"):
            assert getattr(other, name) == pytest.approx(getattr(one, name), rel=2e-3)
    (term,) = found.terms
    after = LinearModel(target, [term], term.fit, _relinearised(target, given, term.fit))
    (again,) = search._beside(after, told[1:2])
    assert again.gain < 0.1 * told[1].gain


@pytest.mark.slow
def test_signals_are_timed_from_the_first_row_on():
    """Of recordings whose commands are known for four steps before it."""
    question = asked(101)
    target, base = base_model(question, question.seed)
    forward = copy.copy(target.forward)
    step = forward.commands.sample_step
    forward.commands = forward.commands._replace(sample_step=np.minimum(step + 4, step.max()))
    options = (question.ports, ("a", "b"), "m", question.seed, question.rules.level, lambda line: None)
    plain, early = (law_search(t, *options).find(t, base) for t in (target, target.on(forward)))
    assert plain.centre[0] == 0.0
    np.testing.assert_allclose(early.centre, plain.centre - 4 * STEP, atol=1e-12)


@pytest.mark.slow
def test_a_law_that_follows_the_motion_takes_no_rollouts_for_what_is_measured():
    """A term at a marker beside one on the body: the first changes what is seen, and the second alone what moves."""
    question = asked(101)
    target, base = base_model(question, question.seed)
    search = law_search(target, question.ports, ("a", "b"), "m", 0, 0.1, lambda line: None)
    marker = next(port for port in question.ports.ports if port.stage == "sensing")
    at_marker = placed(marker, Feature("command", (0,)), 1.0, ("a", "b"), "m")
    body = Port("body force x", "body", "force", 0, 0, "N", 0.1, "look at the body")
    on_body = placed(body, Feature("position", (0,), of_motion=True), 1.0, ("a", "b"), "m")
    forward = PortedForward(target.forward, question.ports, search.table, [at_marker, on_body])
    forward.table.over_motion = None  # asking for a rollout raises
    point = np.append(base.x, [0.3, 0.2])[None]
    shown = {"position": np.zeros((forward.count, target.measurements.time.shape[1], 4, 3))}
    seen = forward._as_seen(shown, forward.coordinates.physical_values(point, forward.slots), point)
    assert np.abs(seen["position"][:, :, marker.number]).max() > 0.0


def test_nothing_is_described_where_nothing_is_hidden():
    answer = audit(asked(101))
    assert answer.verdict == "no_discrepancy"
    assert answer.described is None


@pytest.mark.slow
def test_commands_tell_laws_apart_that_recordings_do_not():
    """Both channels have moved alike, so that the product of both is the square of either."""
    given = asked(5, Pushed(), alike=True)
    target, base = base_model(given, 5)
    search = law_search(target, given.ports, ("a", "b"), "rad", 5, 0.02, lambda line: None)
    found = replace(search, most=1).find(target, base)
    tied = {
        refit.term.feature.formula("ab"): refit for refit in found.alternatives if refit.term.port.name == "marker m3 x"
    }
    assert {"u_a u_a", "u_a u_b", "u_b u_b"} <= set(tied)
    hypotheses = [
        Hypothesis(name, as_measured(refit.target, refit.fit), refit.target.forward) for name, refit in tied.items()
    ]
    like = given.model.recordings.commands.of(0)
    opposed = like._replace(step=like.step * np.array([1.0, -1.0]))
    now, then = outlooks(target.measured, base, hypotheses, [like, opposed])
    pair = next(pair for pair in now.pairs if set(pair) == {"u_a u_a", "u_a u_b"})
    assert now.pairs[pair] < 1.0
    assert then.pairs[pair] > 100.0


@pytest.mark.slow
def test_the_shape_of_a_feature_is_inferred_and_leaves_no_further_term():
    """Of one between those of the dictionary the next one would be asked for what is left."""
    question, _, _, found = searched(Lagging())
    assert [(refit.term.port.name, refit.term.feature.kind) for refit in found.terms] == [("marker m3 x", "lag")]
    (row,) = coefficients(Described(found), question.seed)
    assert abs(row["shape"] - BEHIND) < 4.0 * row["shape_sd"] < 0.4 * BEHIND
    assert abs(row["mean"] - SIZE) < 4.0 * row["sd"]
    answer = SimpleNamespace(law=Described(found), problem=question)
    ((term,),) = [table["terms"] for table in law_tables(answer)]
    assert term["shape_parameter"] == f"{term['coefficient']}_shape"
    assert abs(term["shape"] - row["shape"]) < row["shape_sd"]


@pytest.mark.slow
def test_a_law_has_as_many_terms_as_act():
    _, _, _, found = searched(PushedAtMany())
    ports = {refit.term.port.name for refit in found.terms}
    assert ports == {f"marker m{marker + 1} {'xyz'[axis]}" for marker, axis in MANY}
    assert len(found.terms) == len(MANY)


class PushedPlaying(Pushed):
    """The push by both commands, beside a play that the library has; for recordings."""

    def rollout(self, parameters, commands, steps=None):
        return super().rollout({**parameters, "play": parameters.get("play", 0.0) + 1.0}, commands, steps)


def search_of(question, target):
    return ExtensionSearch(target, question.candidates, question.rules, question.seed)


def named_with(question, names):
    """The base model of a problem with candidates, one after the other, and what it predicts."""
    target, base = base_model(question, question.seed)
    steps, fit = [], base
    before = search_of(question, target).tested(base, 0)
    for name in names:
        free = np.union1d(fit.free, question.candidate(name).indices)
        fit = optimise(target, fit.x, free)
        steps.append(Added(name, (name,), before, fit, 0.0, {}, target))
    named = Named(search_of(question, target), base, tuple(steps))
    return named, predicted(question, target.measured, stages_of(target, base, steps))


@pytest.mark.slow
def test_mechanisms_beside_a_law_that_unseen_recordings_do_not_ask_for_stood_in_for_it():
    question = asked(6, PushedPlaying())
    *_, found = describe(question, *named_with(question, ["play", "creep", "wall"]))
    assert (found.beside, set(found.stand_ins)) == (("play",), {"creep", "wall"})
    assert [refit.term.feature.kind for refit in found.search.terms] == ["product"]
    assert found.holds
