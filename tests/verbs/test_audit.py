"""The experiment file that an audit writes, to be found again from another folder."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rfdropo_bayes.audit.candidates import Candidate
from rfdropo_bayes.audit.coordinates import Coordinates
from rfdropo_bayes.bayes.space import build_space
from rfdropo_bayes.mechanisms import REGISTRY
from rfdropo_bayes.verbs.audit import extended_tables


def answered(candidate: Candidate, x: list[float]) -> Any:
    """What an audit says of a drive that creeps, named and adopted."""
    creep = REGISTRY["drive_creep"]()
    space = build_space(creep.parameters, {spec.name: {} for spec in creep.parameters}, {}, ())
    names = tuple(spec.name for spec in creep.parameters)
    coordinates = Coordinates(space, 0, names, {spec.name: spec.nominal for spec in creep.parameters}, {})
    return SimpleNamespace(
        law=None,
        adopted=[SimpleNamespace(name=candidate.name)],
        extended=SimpleNamespace(x=np.array(x), free=np.arange(2)),
        problem=SimpleNamespace(candidates=[candidate], candidate=lambda name: candidate, coordinates=coordinates),
    )


def test_a_mechanism_of_the_users_own_is_found_again_and_tried_no_more(tmp_path: Path) -> None:
    answer = answered(Candidate("own", (0, 1), REGISTRY["drive_creep"](), "own.py:Own"), [0.5, 0.0])
    (tmp_path / "own.py").touch()
    tables = {"robot": "smooth_arm", "audit": {"candidates": ["own.py:Own", "own.py:Other"]}}
    extended = extended_tables(tables, answer, tmp_path)
    assert extended["model"]["mechanisms"] == [f"{tmp_path / 'own.py'}:Own"]
    assert extended["audit"]["candidates"] == [f"{tmp_path / 'own.py'}:Other"]
    assert tables["audit"]["candidates"] == ["own.py:Own", "own.py:Other"]
    assert set(extended["model"]["priors"]) == {"drive_creep", "drive_creep_time"}


@pytest.mark.parametrize(("x", "scale"), [(0.5, 0.1), (-4.0, 0.4)])
def test_the_priors_are_those_under_which_the_sizes_were_found(tmp_path: Path, x: float, scale: float) -> None:
    """A size of four prior deviations is found under a prior four times as wide; one of a half under the prior itself.
    A time constant's coordinate is not measured from null, and its prior stays."""
    answer = answered(Candidate("drive_creep", (0, 1), REGISTRY["drive_creep"](), "drive_creep"), [x, 5.0])
    tables = {"robot": "smooth_arm", "model": {"priors": {"drive_creep": {"distribution": "Normal", "scale": 9.0}}}}
    found = extended_tables(tables, answer, tmp_path)["model"]["priors"]
    assert found["drive_creep"] == {"distribution": "Normal", "loc": 0.0, "scale": pytest.approx(scale)}
    assert found["drive_creep_time"] == {"distribution": "LogNormal", "median": 1.0, "sigma": 1.2}
