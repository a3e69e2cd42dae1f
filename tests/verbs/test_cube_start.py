"""A cube that stands where it was measured, and is predicted from there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import rfdropo_bayes as rb
from rfdropo_bayes.bayes.channels import Markers
from rfdropo_bayes.bayes.noise import noise_specs
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory, first_row_only
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord
from rfdropo_bayes.prediction.predictive import with_measured_starts
from rfdropo_bayes.simulators.cube import push_table

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
YAW, SHIFT = 0.2, np.array([0.003, -0.002, 0.004])


@pytest.fixture(scope="module")
def simulator():
    return Model.read(EXPERIMENTS / "sim2real_trunk.toml", ["simulator.push=true"]).simulator


def recording(simulator, rows: int = 4) -> Trajectory:
    """Commands of nothing; a cube turned by `YAW` about the vertical, and 1 mm too high, as a camera might see it."""
    turned = [0.0, np.sin(YAW / 2), 0.0, np.cos(YAW / 2)]
    pose = np.tile([0.012, -0.08, 0.1, *turned], (rows, 1))
    pose[1:, 0] += 1.0  # what came after must not be seen
    time = 0.1 * np.arange(rows)
    return Trajectory.build(
        Origin(name="pushed", robot="trunk_physical", format="netcdf"),
        SentCommands(
            command_time=time, command=np.zeros((rows, 8)), command_unit="m", cable_names=simulator.channel_names
        ),
        Measured(
            time=time,
            position=np.broadcast_to(np.linspace([0.0, 0.0, 0.04], [0.0, 0.0, 0.18], 4), (rows, 4, 3)).copy(),
            marker_names=simulator.marker_names,
            object_pose=pose,
        ),
    )


def test_the_cube_starts_where_it_was_measured_less_the_offset_and_on_the_plate(simulator):
    trajectory = recording(simulator)
    specs = simulator.parameters + noise_specs("white")
    offsets = [f"offset_{axis}" for axis in "xyz"]
    space = build_scopes(specs, {name: {} for name in (*offsets, "cube_x", "observation_noise")}, {}, ["pushed"])
    recordings = gather_recordings(simulator, [trajectory])
    model = TrajectoryModel(simulator, space, recordings, (Markers.gather(recordings, "white"),))
    values = {"cube_x": np.array([0.5, 0.5]), "observation_noise": np.full(2, 1e-3)}
    values |= {name: np.array([0.0, shift]) for name, shift in zip(offsets, SHIFT, strict=True)}
    placed, found = with_measured_starts(model, [first_row_only(trajectory)], values)
    assert "cube_x" not in placed.scopes.names
    own = placed.scopes.values_in("pushed", found)
    np.testing.assert_allclose(own["cube_x"], [0.012, 0.012 - SHIFT[0]])
    np.testing.assert_allclose(own["cube_z"], [0.1, 0.1 - SHIFT[2]])
    table = push_table(simulator.robot)
    np.testing.assert_allclose(own["cube_y"], table.plate_height_m + 0.5 * table.parameters["cube_side"].nominal)
    np.testing.assert_allclose(own["cube_yaw"], YAW)


def test_what_is_known_of_the_cube_after_the_first_row_is_taken_out(simulator):
    pose = first_row_only(recording(simulator)).object_pose
    np.testing.assert_array_equal(pose, np.broadcast_to(pose[0], pose.shape))


@pytest.mark.slow
def test_a_prediction_holds_every_draw_of_the_cube_in_the_measuring_frame(simulator, tmp_path):
    """Nothing moves: the cube stays where it was measured, for draws whose frames lie elsewhere, too."""
    recording(simulator).save(tmp_path / "commands.nc")
    rng = np.random.default_rng(0)
    infos = [ParameterInfo("offset_x", "m", -0.05, 0.05, {"distribution": "Normal", "loc": 0.0, "scale": 0.01})]
    infos += [
        ParameterInfo("observation_noise", "m", 1e-6, 0.2, {"distribution": "LogNormal", "median": 1e-3, "sigma": 1.0})
    ]
    draws = {"offset_x": rng.normal(0, 0.005, (1, 8)), "observation_noise": np.full((1, 8), 1e-3)}
    PosteriorRecord(tuple(infos), draws, attrs={"integrator": "sdirk2"}).save(tmp_path / "posterior.nc")
    changes = ["simulator.push=true", "simulator.integrator='sdirk2'", "data.format='netcdf'"]
    model = rb.Model.read(EXPERIMENTS / "sim2real_trunk.toml", changes)
    rb.predict(rb.Calibration.of_posterior(tmp_path, model), tmp_path / "commands.nc", out=tmp_path / "out")
    with xr.open_dataset(tmp_path / "out" / "prediction.nc") as opened:
        assert opened["object"].shape == (8, 4, 7)
        np.testing.assert_allclose(opened["object"].values[..., 0], 0.012, atol=2e-4)
        np.testing.assert_allclose(opened["object_mean"].values[:, 2], 0.1, atol=2e-4)
