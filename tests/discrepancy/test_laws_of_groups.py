"""Laws that act in the recordings of one group only: an unknown effect of one day is described with its day."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rfdropo_bayes.bayes.channels import Markers
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.discrepancy.audit_problem import AuditProblem, measurements_of
from rfdropo_bayes.discrepancy.audit_record import next_experiment, record
from rfdropo_bayes.discrepancy.differences import Groups
from rfdropo_bayes.discrepancy.law_words import law_tables
from rfdropo_bayes.discrepancy.pipeline import audit
from rfdropo_bayes.discrepancy.port_rollouts import EVERYWHERE, Scope, coefficient_name
from rfdropo_bayes.mechanisms.features import Feature
from rfdropo_bayes.mechanisms.ports import port_map
from rfdropo_bayes.verbs.between import confine_laws

from .test_law_search import SIZE, TRUTH, Pushed
from .toys import Toy, problem, recordings

MONTHS = {"january": ("r0", "r1", "r3", "r5", "r7"), "april": ("r2", "r4", "r6", "r8")}
FITTED = 7  # r0 to r6: three repeats, one of them in April, and two further sequences of each month


def asked(months: tuple[str, ...], seed: int = 5) -> AuditProblem:
    """Recordings of two months, in some of which marker m3 is pushed; the audit has no library."""
    still, pushed = recordings(TRUTH, seed), recordings(TRUTH, seed, Pushed())
    chosen = [pushed[k] if any(first.name in MONTHS[m] for m in months) else first for k, first in enumerate(still[:9])]
    gathered, plain = gather_recordings(Toy(), chosen), problem({}, seed)
    return replace(
        plain,
        model=replace(plain.model, recordings=gathered, channels=(Markers.gather(gathered, "repeats"),)),
        trajectories=chosen[:FITTED],
        candidates=[],
        groups=Groups(MONTHS, compared=False),
        ports=port_map(plain.lanes.simulator, gathered.markers),
    )


@pytest.mark.slow
def test_an_unknown_effect_of_one_month_is_described_with_its_month_and_joins_there_alone():
    answer = audit(asked(("april",)))
    content = record(answer, versions={}, data_sha256="", next_experiment=next_experiment(answer))
    law = json.loads(json.dumps(content, allow_nan=False))["law"]
    assert law["holds"]
    (term,) = law["terms"]
    assert (law["port"], term["group"], term["feature"]) == ("marker m3 x", "april", "product")
    assert abs(term["mean"] - SIZE) < 4.0 * term["sd"]
    assert "at marker m3 x in april alone it changes" in content["sentence"]
    (errors,) = (row for name, row in law["by_trajectory"].items() if name == "r7")  # of January, where nothing acts
    assert abs(errors["rmse_extended_mm"] / errors["rmse_base_mm"] - 1.0) < 0.1
    model = {"laws": law_tables(answer)}
    confine_laws(model, answer)
    (coefficient,) = (entry["coefficient"] for table in model["laws"] for entry in table["terms"])
    assert model["only_in"] == {coefficient: ["april"]}
    assert set(model["groups"]["april"]) == set(MONTHS["april"])


@pytest.mark.slow
def test_an_unknown_effect_of_both_months_is_described_for_all_recordings():
    answer = audit(asked(("january", "april")))
    assert answer.law is not None
    (term,) = (refit.term for refit in answer.law.search.terms)
    assert (term.port.name, term.scope) == ("marker m3 x", EVERYWHERE)
    model = {}
    confine_laws(model, answer)
    assert model == {}


def test_a_command_that_is_repeated_in_another_month_is_no_repeat():
    """The mean of both would hide what acts in one."""
    given = asked(("april",))
    members = measurements_of(given, range(FITTED), given.trajectories).members
    assert (0, 1) in members
    assert (2,) in members
    alone = replace(given, groups=None)
    assert (0, 1, 2) in measurements_of(alone, range(FITTED), given.trajectories).members


def test_a_scope_has_the_recordings_of_its_group_and_a_coefficient_of_its_own():
    names, april = ("r1", "r2"), Scope("april", MONTHS["april"])
    np.testing.assert_array_equal(EVERYWHERE.has(names), [True, True])
    np.testing.assert_array_equal(april.has(names), [False, True])
    port, feature = port_map(Toy(), ("m1",)).ports[0], Feature("time")
    own, shared = (coefficient_name(port, feature, ("a", "b"), scope.group) for scope in (april, EVERYWHERE))
    assert own == f"{shared}_in_april"
