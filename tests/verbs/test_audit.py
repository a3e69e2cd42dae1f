"""The experiment file that an audit writes, to be found again from another folder."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.discrepancy.candidates import Candidate
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.discrepancy.differences import Groups, with_differences
from rfdropo_bayes.mechanisms import REGISTRY
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.verbs.audit import extended_tables, sized_priors


def answered(candidate: Candidate, x: list[float]) -> Any:
    """What an audit says of a drive that creeps, named and adopted."""
    creep = REGISTRY["drive_creep"]()
    space = build_scopes(creep.parameters, {spec.name: {} for spec in creep.parameters}, {}, ())
    names = tuple(spec.name for spec in creep.parameters)
    coordinates = Coordinates(space, 0, names)
    return SimpleNamespace(
        law=None,
        adopted=[SimpleNamespace(name=candidate.name)],
        base=SimpleNamespace(free=np.arange(4)),
        extended=SimpleNamespace(x=np.array(x), free=np.arange(2)),
        problem=SimpleNamespace(candidates=[candidate], candidate=lambda name: candidate, coordinates=coordinates),
    )


def test_a_mechanism_of_the_users_own_is_found_again_and_tried_no_more(tmp_path: Path) -> None:
    answer = answered(Candidate("own", (0, 1), REGISTRY["drive_creep"](), "own.py:Own"), [0.5, 0.0])
    (tmp_path / "own.py").touch()
    tables = {
        "robot": "smooth_arm",
        "audit": {"candidates": ["own.py:Own", "own.py:Other"]},
        "inference": {"minutes": 3},
    }
    extended = extended_tables(tables, answer, tmp_path)
    assert extended["inference"]["minutes"] == 4.5  # six parameters in place of four
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


def test_a_mechanism_of_one_group_has_the_priors_of_its_own_parameters(tmp_path: Path) -> None:
    """A factor, whose null is one, within its ends; and a time, which has no size that is measured from null."""
    factor = {"distribution": "TruncatedNormal", "loc": 1.2, "scale": 0.5, "low": 0.5, "high": 3.0}
    time = {"distribution": "LogNormal", "median": 0.02, "sigma": 0.5}
    specs = (
        ParameterSpec("stretch", "-", 0.1, 10.0, 1.0, factor, "a factor"),
        ParameterSpec("blur", "s", 1e-3, 1.0, 0.01, time, "a time"),
    )
    library = [Candidate(spec.name, (k,), REGISTRY["drive_creep"](), spec.name) for k, spec in enumerate(specs)]
    groups = Groups({"april": ("a",), "june": ("b",)}, compared=False)
    known = build_scopes(specs, {spec.name: {} for spec in specs}, {}, ("a", "b"))
    space, candidates = with_differences(known, 0, (), library, groups, spreads={})
    nominal = {spec.name: spec.nominal for spec in specs}
    found = [candidate for candidate in candidates if candidate.group == "april"]
    answer = answered(found[0], np.zeros(len(space.names)).tolist())
    answer.extended.free = np.array([0])
    answer.problem.coordinates = Coordinates(space, 0, tuple(nominal))
    (priors,) = [sized_priors(answer, each) for each in found if each.title == "stretch"]
    assert priors["stretch"] == pytest.approx(factor)
    answer.adopted[:] = [SimpleNamespace(name="blur@april")]
    answer.problem.groups = groups
    answer.problem.candidate = lambda name: next(each for each in found if each.name == name)
    model = extended_tables({"robot": "smooth_arm"}, answer, tmp_path)["model"]
    assert model["only_in"] == {"blur": ["april"]}
    assert set(model["priors"]) <= set(nominal)
