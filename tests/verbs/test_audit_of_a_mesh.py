"""Audits of a body of tetrahedra, on a bar of few of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import REGISTRY
from rfdropo_bayes.model.experiment import Experiment
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import bodies_of
from rfdropo_bayes.verbs.audit import build_problem

ROBOT = Robot.load("trunk_sofa_mesh")
OWN = """
import jax.numpy as jnp

from rfdropo_bayes.simulators.parameters import ParameterSpec


class Glue:
    name, stage, cause, remedy = "glue", "body", "glue", "remove it"
    parameters = (ParameterSpec("glue", "N", 0.0, 9.0, 0.0, {"distribution": "HalfNormal", "scale": 1.0}, "glue"),)

    def embody(self, values, material, body):
        return material._replace(effects=material.effects._replace(coulomb_friction=values["glue"]))


class Fur(Glue):
    name = "fur"
    parameters = (ParameterSpec("fur", "kg", 0.0, 9.0, 0.0, {"distribution": "HalfNormal", "scale": 1.0}, "fur"),)

    def embody(self, values, material, body):
        return material._replace(point_mass=material.point_mass + values["fur"])
"""


def experiment(bar_mesh: Path, **audit: object) -> Experiment:
    tables = {
        "robot": ROBOT.name,
        "data": {"format": "netcdf", "fit": ["*.nc"]},
        "simulator": {"body": "tetrahedra", "tetrahedra": {"mesh": str(bar_mesh), "unit": "mm", "clamp_height": 0.02}},
        "model": {"priors": {"young_modulus": {"distribution": "LogNormal", "median": 4e6, "sigma": 0.3}}},
        "audit": audit,
    }
    return Experiment.model_validate(tables)


def recording(rows: int = 12) -> Trajectory:
    time = 0.05 * np.arange(rows)
    command = np.zeros((rows, 8))
    command[2:, 1] = 5e-3
    return Trajectory.build(
        Origin(name="bar", robot=ROBOT.name, format="netcdf"),
        SentCommands(command_time=time, command=command, command_unit="m", cable_names=ROBOT.channel_names),
        Measured(time=time, position=np.tile(ROBOT.marker_points(), (rows, 1, 1)), marker_names=ROBOT.marker_names),
    )


@pytest.mark.slow
def test_candidates_that_do_not_run_on_a_mesh_are_left_out_and_listed(bar_mesh, tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    own = ["own.py:Glue", "own.py:Fur"]
    read = experiment(bar_mesh, candidates=own, exclude=["softening"])
    asked = build_problem(spec_of(read, tmp_path), read.audit, [recording()], [], seed=0)
    of_rods = {name for name, kind in REGISTRY.items() if bodies_of(kind) == ("rod",)}
    assert {"fibre_law", "coulomb_friction"} < of_rods
    assert set(asked.left_out) == of_rods - {"softening"} | {"own.py:Glue"}
    assert "rod bodies only" in asked.left_out["coulomb_friction"]
    assert "rods only" in asked.left_out["own.py:Glue"]
    assert {c.name for c in asked.candidates} == set(REGISTRY) - of_rods | {"fur", "initial_displacement"}
    assert asked.finer is not None
    steps = [lanes.simulator.description["time_step_s"] for lanes in (asked.lanes, asked.finer[0])]
    assert steps[1] == steps[0] / 2
    shown, status = asked.lanes.roll(
        asked.coordinates.physical_values(asked.coordinates.null[None], asked.coordinates.slots(["bar"]))[:, 0],
        np.zeros((1, 7)),
        asked.model.recordings.commands,
    )
    assert status == [0]
    assert np.isfinite(shown["position"]).all()


def test_beside_a_cube_every_candidate_runs():
    tables = experiment(Path()).model_dump(exclude_none=True, exclude_defaults=True)
    tables |= {"robot": "trunk_sofa", "simulator": {"push": True}}
    read = Experiment.model_validate(tables)
    asked = build_problem(spec_of(read, Path()), read.audit, [recording()], [], seed=0)
    assert not asked.left_out
    assert {c.name for c in asked.candidates} == set(REGISTRY) | {"initial_displacement"}


def test_without_the_library_a_mesh_is_asked_for_laws_alone(bar_mesh):
    read = experiment(bar_mesh, library=False)
    asked = build_problem(spec_of(read, Path()), read.audit, [recording()], [], seed=0)
    assert not asked.candidates
    assert not asked.left_out
    assert asked.coordinates.base == len(asked.coordinates.names)
    assert asked.ports is not None
    names = {port.name for port in asked.ports.ports}
    assert {"cable long_1", "command delay", "observation delay"} <= names
    assert "stiffness" not in names
    assert asked.ports.left_out


def test_an_audit_without_library_and_ports_is_refused():
    read = experiment(Path("bar.vtk"), library=False, ports=False)
    with pytest.raises(InputError, match="no candidates: "):
        build_problem(spec_of(read, Path()), read.audit, [recording()], [], seed=0)
