"""Counting what audits of hidden effects have said; the audits themselves are tested in test_hidden_effects.py."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import REGISTRY
from studies.audit_study import CONDITIONS, FAMILIES, LEDGER, TABLE, WHOLE, _turn, _without, judge, run_study, summarise
from studies.fits import uninterrupted
from studies.hidden_effects import Hidden

CONTENT = {
    "verdict": "equivalent",
    "gain": {"explained_fraction": 0.97},
    "seconds": 50.0,
    "findings": [
        {
            "mechanism": "payload",
            "equivalence_class": ["payload", "base_tilt"],
            "parameters": {"payload_mass": {"q05": 0.2, "q95": 0.3, "sd": 0.03}},
            "relative": {
                "payload_mass_over_young_modulus": {
                    "parameter": "payload_mass",
                    "power": 1,
                    "q05": 0.9e-8,
                    "q95": 1.1e-8,
                }
            },
        }
    ],
}

PRIOR = {"payload_mass": 0.1}


def hidden(mass: float) -> Hidden:
    return Hidden(
        {"payload_mass": mass, "young_modulus": 2e6},
        {"discretisation": 0.01},
        {"payload_mass": 0.9},
        Path(),
        np.zeros((6, 1, 1)),
    )


def test_a_size_is_judged_in_the_form_that_can_be_known():
    found = judge(CONTENT, ["payload"], hidden(0.02), PRIOR)
    assert found["covered"] == {"payload_mass_over_young_modulus": True}  # though 0.02 kg is not in [0.2, 0.3]
    assert found["named_first"]
    assert not judge(CONTENT, ["payload"], hidden(0.03), PRIOR)["covered"]["payload_mass_over_young_modulus"]
    other = judge(CONTENT, ["base_tilt"], hidden(0.02), PRIOR)
    assert other["named_first"]
    assert other["covered"] == {}
    assert not judge(CONTENT, ["backlash"], hidden(0.02), PRIOR)["named_first"]


@pytest.mark.parametrize(("scale", "undetermined"), [(0.1, []), (0.05, ["payload_mass"])])
def test_an_interval_that_is_the_priors_is_counted_apart(scale, undetermined):
    finding = {**CONTENT["findings"][0], "relative": {}}
    found = judge({**CONTENT, "findings": [finding]}, ["payload"], hidden(0.25), {"payload_mass": scale})
    assert found["covered"] == {"payload_mass": True}
    assert found["undetermined"] == undetermined
    row = {"hidden": ["payload"], "rho": {"discretisation": 0.0}, "unreached": [], "error_over_oracle": None, **found}
    counted = summarise(CONDITIONS[1], [row, row])
    assert counted["intervals"] == ([2, 2] if not undetermined else [0, 0])
    assert counted["intervals_of_undetermined_sizes"] == ([0, 0] if not undetermined else [2, 2])


def test_every_mechanism_has_its_turn_before_one_has_its_second():
    turns = [name for index in range(6) for name in _turn(["a", "b", "c", "d"], 2, [7, 1], index)]
    assert all(sorted(turns[k : k + 4]) == ["a", "b", "c", "d"] for k in (0, 4, 8))
    assert turns[:4] != turns[4:8] or turns[4:8] != turns[8:]


def test_a_study_counts_what_its_ledger_holds_and_lists_confusions(tmp_path):
    def line(index: int, name: str, ratio: float | None, seed: int = 7) -> str:
        judged = judge(CONTENT, [name], hidden(0.02), PRIOR)
        result = {
            "hidden": [name],
            "rho": {"discretisation": 0.01 * index},
            "ideal": {name: 0.8 + 0.05 * index},
            **judged,
        }
        job = {"condition": "rho_0.5", "index": index, "seed": seed}
        return json.dumps(
            {
                "job": job,
                "result": {
                    **result,
                    "error_over_oracle": ratio,
                    "seconds": 36.0,
                    "core_seconds": 18.0,
                    "unreached": [],
                },
            }
        )

    rows = [line(0, "payload", 1.0), line(1, "payload", 1.5), line(2, "backlash", 3.0), line(0, "payload", 1.0, seed=8)]
    (tmp_path / LEDGER).write_text("\n".join(rows) + "\n")
    found = run_study(tmp_path, 0, 7, conditions=["rho_0.5"], exclude=["end_stop"])
    row = found["conditions"]["rho_0.5"]
    assert row["datasets"] == 3
    assert row["verdicts"] == {"equivalent": 3}
    assert row["named_first"] == 2
    assert row["within_1.3_of_the_oracle"] == 0.5
    assert row["confusions"] == {"backlash -> payload": 1}
    assert found["hours"] == pytest.approx(0.03)
    assert found["core_hours"] == pytest.approx(0.015)
    table = (tmp_path / TABLE).read_text()
    shown = "| rho_0.5 | 3 | equivalent 3 | 3 [29, 100] | 2 [9, 99] | 85 % | 2 [9, 99] | 2.0 | 2 of 2 | 50 % | 0.020 |"
    assert shown in table
    assert "backlash -> payload (1)" in table
    with pytest.raises(InputError, match="unknown condition"):
        run_study(tmp_path, 0, 7, conditions=["rho_9"])


def test_audits_before_a_mechanism_was_removed_count_where_nothing_was_removed(tmp_path):
    judged = judge(CONTENT, ["payload"], hidden(0.02), PRIOR)
    shared = {"hidden": ["payload"], "rho": {"discretisation": 0.01}, "seconds": 36.0, "core_seconds": 18.0}
    without = {**judged, "verdict": "unexplained", "named_first": False, "error_over_oracle": None, "unreached": []}
    result = {**shared, **without, WHOLE: {**judged, "error_over_oracle": 1.1}}
    job = {"condition": "removed_rho_0.5", "index": 0, "seed": 7}
    (tmp_path / LEDGER).write_text(json.dumps({"job": job, "result": result}) + "\n")
    found = run_study(tmp_path, 0, 7)["conditions"]
    assert found["removed_rho_0.5"]["verdicts"] == {"unexplained": 1}
    assert found["rho_0.5"]["verdicts"] == {"equivalent": 1}
    assert found["rho_0.5"]["named_first"] == 1
    assert [found[name]["datasets"] for name in ("rho_0.15", "two_effects_rho_1", "null")] == [0, 0, 0]


def test_a_hidden_cause_is_removed_with_its_family_and_with_its_doubles():
    alike = [{"mechanism": "spool_growth", "cosine": 0.97}, {"mechanism": "payload", "cosine": 0.4}]
    content = {"candidates": [{"mechanism": "command_gain", "cosines": alike}]}
    override = _without(content, ["command_gain"], ["backlash"])
    assert override == 'audit.exclude=["backlash", "cable_gain", "command_gain", "spool_growth"]'
    assert set(FAMILIES) | set(FAMILIES.values()) <= set(REGISTRY)


def test_where_nothing_is_to_be_found_the_audit_is_on_a_finer_mesh():
    """Discretisation's rho is at most .0136 there, over eight truths; at the other conditions' resolution .03."""
    layered = [condition for condition in CONDITIONS if not (condition.mesh or condition.rest)]
    audited = [c.setting.audited["refine"] for c in layered]
    assert [c.setting.made["refine"] - fine for c, fine in zip(layered, audited, strict=True)] == [1] * len(layered)
    assert {c.effects == 0 for c, fine in zip(layered, audited, strict=True) if fine == 4} == {True}


def test_an_interrupted_audit_ends_a_study():
    ended = SimpleNamespace(content={"stopped": "time"})
    assert uninterrupted(ended) is ended
    with pytest.raises(KeyboardInterrupt):
        uninterrupted(SimpleNamespace(content={"stopped": "interrupt"}))
