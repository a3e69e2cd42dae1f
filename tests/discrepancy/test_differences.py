"""Audits that compare two groups of recordings, or have candidates of single groups, on a simulator that is a formula.

Seeds are fixed; a null data set is called discrepant in 1 % of cases, and a size is missed by four deviations in one of
10^4.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rfdropo_bayes.bayes.channels import Markers
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.discrepancy.audit_problem import AuditProblem
from rfdropo_bayes.discrepancy.audit_record import next_experiment, record
from rfdropo_bayes.discrepancy.base_fit import first_target
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.discrepancy.differences import Groups, with_differences
from rfdropo_bayes.discrepancy.fixed_quantities import families
from rfdropo_bayes.discrepancy.journal import Journal
from rfdropo_bayes.discrepancy.pipeline import Answer, audit
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors import Scope
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.verbs.between import extend_groups, find_groups, groups_at_hand

from .toys import BASE, Toy, problem, recordings

TRUTH = {"gain": 1.3, "bend": -0.4}
MONTHS = {"january": ("r0", "r1", "r3", "r5", "r7"), "april": ("r2", "r4", "r6", "r8")}
FITTED = 7  # r0 to r6: three repeats, one of them on another day, and four more sequences
GROUPS = Groups(MONTHS, ("r9",))
COORDINATES: dict[str, Coordinates] = {}  # whose priors are sampled once


def compared(january: dict, april: dict, seed: int, groups: Groups = GROUPS) -> AuditProblem:
    """A data set of the toy, half of it with another truth."""
    asked, toy = problem(TRUTH, seed), Toy()
    days = [recordings({**TRUTH, **truth}, seed, toy) for truth in (january, april)]
    chosen = [days[first.name in MONTHS["april"]][k] for k, first in enumerate(days[0][:9])]
    gathered = gather_recordings(toy, chosen)
    space, candidates = with_differences(
        asked.coordinates.space, len(BASE), BASE, asked.candidates, groups, spreads={"bend": 0.5}
    )
    nominal = {spec.name: spec.nominal for spec in toy.parameters}
    if repr(groups) not in COORDINATES:
        COORDINATES[repr(groups)] = Coordinates(space, len(BASE), tuple(nominal))
    return replace(
        asked,
        coordinates=COORDINATES[repr(groups)],
        model=TrajectoryModel(toy, space, gathered, (Markers.gather(gathered, "repeats"),)),
        trajectories=chosen[:FITTED],
        candidates=candidates,
        groups=groups,
    )


def found(asked: AuditProblem) -> dict:
    return content_of(audit(asked))


def content_of(answer: Answer) -> dict:
    return json.loads(json.dumps(record(answer, versions={}, data_sha256="", next_experiment=next_experiment(answer))))


@pytest.mark.slow
def test_a_mechanism_of_one_day_and_a_parameter_that_changed_are_named_with_their_sizes():
    content = found(compared({}, {"play": 0.5, "bend": -0.1}, 1))
    differences = {row["mechanism"]: row for row in content["between"]["differences"]}
    assert set(differences) == {"play", "bend"}
    assert content["between"]["in_both"] == []
    assert content["verdict"] == "explained"
    for name, parameter, truth in (("play", "play@april", 0.5), ("bend", "bend_deviation@april", 0.3)):
        assert differences[name]["group"] == "april"
        size = differences[name]["parameters"][parameter]
        assert abs(size["mean"] - truth) < 4.0 * size["sd"]
    assert "play in april" in content["sentence"]
    assert "shared by january and april" in content["sentence"]


@pytest.mark.slow
def test_a_mechanism_of_one_day_is_named_for_it_in_an_audit_that_compares_nothing():
    answer = audit(compared({}, {"play": 0.5}, 1, replace(GROUPS, compared=False)))
    content = content_of(answer)
    (finding,) = content["findings"]
    assert (finding["mechanism"], finding["group"]) == ("play", "april")
    assert finding["equivalence_class"][0] == "play@april"
    assert abs(finding["parameters"]["play@april"]["mean"] - 0.5) < 4.0 * finding["parameters"]["play@april"]["sd"]
    assert content["verdict"] == "explained"
    assert content["between"] is None
    assert content["sentence"].startswith("Play in april (play 0.")
    assert "shared by" not in content["sentence"]
    table: dict = {}
    extend_groups(table, answer, answer.problem.candidate("play@april"))
    assert table == {"groups": {"april": list(MONTHS["april"])}, "only_in": {"play": ["april"]}}
    table = {"groups": {"april": "r[2468]", "january": "r[13579]"}, "only_in": {"bend": "january"}}
    extend_groups(table, answer, answer.problem.candidate("play@april"))
    assert table["groups"] == {"april": "r[2468]", "january": "r[13579]"}  # recordings to come belong, too
    assert table["only_in"] == {"bend": "january", "play": ["april"]}


@pytest.mark.slow
def test_a_mechanism_that_one_day_of_three_lacks_is_named_for_the_others():
    months = {"january": ["r0", "r1", "r3"], "march": "r[57]", "april": MONTHS["april"]}
    runs = recordings(TRUTH, 1)[:9]
    answer = audit(compared({"play": 0.5}, {}, 1, groups_at_hand(months, runs[:FITTED], runs[FITTED:])))
    content = content_of(answer)
    (finding,) = content["findings"]
    assert (finding["mechanism"], finding["group"]) == ("play", "all but april")
    (size,) = finding["parameters"].values()
    assert abs(size["mean"] - 0.5) < 4.0 * size["sd"]
    table: dict = {"groups": months}
    extend_groups(table, answer, answer.problem.candidate("play@all but april"))
    assert table == {"groups": months, "only_in": {"play": ["january", "march"]}}


@pytest.mark.slow
def test_what_both_days_lack_is_no_difference():
    content = found(compared({"play": 1.0}, {"play": 1.0}, 3))
    assert content["between"]["differences"] == []
    assert [row["mechanism"] for row in content["between"]["in_both"]] == ["play"]
    assert "No parameter and no mechanism is found to differ" in content["sentence"]


@pytest.mark.slow
def test_nothing_is_named_where_nothing_changed():
    content = found(compared({}, {}, 5))
    assert content["verdict"] == "no_discrepancy"
    assert content["between"]["groups"] == {name: list(own) for name, own in MONTHS.items()}
    assert content["between"]["left_out"] == ["r9"]


def test_a_difference_is_added_to_what_both_share_and_shapes_are_shared():
    asked = compared({}, {}, 1)
    names, coordinates = asked.coordinates.names, asked.coordinates
    by_name = {candidate.name: [names[i] for i in candidate.indices] for candidate in asked.candidates}
    assert by_name["play@april"] == ["play@april"]
    assert by_name["creep@january"] == ["creep@january", "creep_time"]
    assert by_name["bend@april"] == ["bend_deviation@april"]
    assert "bend@january" not in by_name  # the same difference, seen from the other group
    assert coordinates.prior_deviations["bend_deviation@april"] == pytest.approx(0.5 * np.sqrt(2), rel=0.05)
    x = coordinates.encode({**TRUTH, "play@april": 0.7, "bend_deviation@april": 0.2})
    theta = coordinates.physical_values(x[None], coordinates.slots(["r0", "r2"]))[0]
    place = {name: k for k, name in enumerate(coordinates.physical)}
    np.testing.assert_allclose(theta[:, place["play"]], [0.0, 0.7])
    np.testing.assert_allclose(theta[:, place["bend"]], [-0.4, -0.2])
    # Repeats of one command sequence on two days are two measurements: parameters of their own tell them apart.
    target = first_target(asked, Journal())
    assert target.measurements.members[0] == (0, 1)
    assert target.measurements.has_repeats
    assert sorted(len(group) for group in target.measurements.members) == [1, 1, 1, 1, 1, 2]
    # Beside those of the point itself, what touches one day costs rollouts of that day alone.
    forward, april = target.forward, np.eye(len(names))[[names.index("play@april")]]
    before = forward.rollouts
    slopes = forward.tangents(coordinates.null[None], april)["position"][0]
    days = [name in MONTHS["april"] for name in target.measurements.names]
    assert forward.rollouts - before == len(days) + sum(days)
    assert [bool(np.any(part)) for part in slopes] == days


def test_groups_of_any_number_have_candidates_of_their_own_and_what_differs_already_has_none():
    asked = problem(TRUTH, 1)
    space = asked.coordinates.space
    days = {"january": "r0", "april": "r1", "june": "r2"}
    three = groups_at_hand(days, recordings(TRUTH, 1)[:3], [])
    options = (len(BASE), BASE, asked.candidates, three)
    names = {candidate.name for candidate in with_differences(space, *options, spreads={})[1]}
    assert {f"{name}@{day}" for name in ("play", "bend") for day in three.names} <= names
    assert "play@all but june" in names
    assert "delay@all but june" not in names  # it has either sign: less of it in June is delay@june
    pooled = replace(space.parameters[len(BASE) - 1], scope=Scope("april", group=True, added_to="bend"))
    own = replace(space, parameters=(*space.parameters[: len(BASE)], pooled, *space.parameters[len(BASE) :]))
    shifted = [replace(candidate, indices=tuple(i + 1 for i in candidate.indices)) for candidate in asked.candidates]
    found = with_differences(own, len(BASE) + 1, BASE, shifted, three, spreads={})[1]
    assert {each.name for each in found if each.title == "bend"} == set()


def test_parameters_of_one_quantity_at_several_places_are_asked_for_together():
    zero = ParameterSpec("zero_up", "m", -1.0, 1.0, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 0.1}, "zero")
    specs = [zero, zero._replace(name="zero_down"), zero._replace(name="mass", unit="kg")]
    assert [[spec.name for spec in family] for family in families(specs)] == [["zero_up", "zero_down"]]


@pytest.mark.parametrize(
    ("between", "words"),
    [
        (("january", "may"), "unknown group 'may'"),
        (("january", "january"), "1 groups are named"),
        (("january", "june"), "no fitted recording is in the group 'june'"),
        (("january", "august"), "no fitted recording is in the group 'august'"),
        ({"a": ["r0", "r1"], "b": ["r1"]}, "r1 is in both groups, a and b"),
        ({"a": ["r0"], "b": []}, "no fitted recording is in the group 'b'"),
        ({"a": ["r0"], "b": ["r77"]}, "no recording of the group 'b' is called 'r77'"),
        ({"a": ["r0"]}, "1 groups are named"),
    ],
)
def test_groups_that_cannot_be_compared_are_refused_by_name(between, words):
    runs = recordings(TRUTH, 1)
    patterns = {"january": "r[01]", "april": ["r2", "r3"], "june": "r9", "august": "nothing*"}
    with pytest.raises(InputError, match=words):
        find_groups(between, patterns, runs[:8], runs[8:])


def test_groups_at_hand_are_those_that_tell_some_recordings_from_others():
    runs = recordings(TRUTH, 1)
    days = {"january": "r[01]", "april": ["r2", "r9"], "june": "r8"}
    groups = groups_at_hand(days, runs[:4], runs[8:])
    assert groups.members == {"january": ("r0", "r1"), "april": ("r2", "r9")}
    assert groups.left_out == ("r3", "r8")
    assert groups.complements == {
        "all but january": ("r2", "r3", "r8", "r9"),
        "all but april": ("r0", "r1", "r3", "r8"),
    }
    assert groups.shifted == ("january", "april")  # r3 is of neither
    assert groups_at_hand({"january": "r*"}, runs[:4], runs[8:]) is None  # nothing to tell it from
    assert groups_at_hand({"january": "r[01]"}, runs[:4], []).complements == {"all but january": ("r2", "r3")}
    two = groups_at_hand({"january": "r[01]", "april": "r[23]"}, runs[:4], runs[8:])
    assert two.shifted == ("april",)
    assert two.complements == {}  # of the fitted recordings, all but january is april
    assert groups_at_hand({"january": "r[01]"}, runs[:2], runs[8:]) is None
    assert groups_at_hand({}, runs[:4], runs[8:]) is None


def test_groups_are_found_by_wildcard_by_name_and_by_recording():
    runs = recordings(TRUTH, 1)
    groups, fitted, tested = find_groups(("january", "r3"), {"january": ["r[01]", "r8"]}, runs[:4], runs[4:])
    assert groups.members == {"january": ("r0", "r1", "r8"), "r3": ("r3",)}
    assert groups.left_out == ("r2", "r4", "r5", "r6", "r7", "r9")
    assert ([t.name for t in fitted], [t.name for t in tested]) == (["r0", "r1", "r3"], ["r8"])
    other, _, _ = find_groups({"a": runs[:2], "b": "r[23]"}, {}, runs[:4], [])
    assert other.members == {"a": ("r0", "r1"), "b": ("r2", "r3")}
