"""The experiment file that an audit writes, to be found again from another folder."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

from rfdropo_bayes.audit.candidates import Candidate
from rfdropo_bayes.mechanisms import REGISTRY
from rfdropo_bayes.workflow.audit import extended_tables


def test_a_mechanism_of_the_users_own_is_found_again_and_tried_no_more(tmp_path: Path) -> None:
    lag = REGISTRY["actuator_lag"]()
    own = Candidate("own", (), lag, "own.py:Own")
    answer = SimpleNamespace(adopted=[SimpleNamespace(name="own")], question=SimpleNamespace(candidates=[own]))
    tables = {"robot": "smooth_arm", "audit": {"candidates": ["own.py:Own", "own.py:Other"]}}
    extended = extended_tables(tables, answer, tmp_path)  # type: ignore[arg-type]
    assert extended["model"]["mechanisms"] == [f"{tmp_path / 'own.py'}:Own"]
    assert extended["audit"]["candidates"] == [f"{tmp_path / 'own.py'}:Other"]
    assert tables["audit"]["candidates"] == ["own.py:Own", "own.py:Other"]
    assert set(extended["model"]["priors"]) == {spec.name for spec in lag.parameters}
