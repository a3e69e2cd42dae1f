"""The circle: a virtual arm behind simulated drives is moved, its log is calibrated on, and audited."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.deployment.bench.simulated_bus import SimulationTable, simulated_drives
from rfdropo_bayes.deployment.bus import BusTable, open_bus
from rfdropo_bayes.deployment.causes import Cause
from rfdropo_bayes.deployment.sensors import SimulatedMarkers
from rfdropo_bayes.deployment.session import deploy
from rfdropo_bayes.deployment.settings import Deployment, SafetyTable
from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.experiment import CommandsTable
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.posteriors import PosteriorRecord
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.parameter import Parameter
from rfdropo_bayes.robots.robot import CommandTiming
from rfdropo_bayes.verbs.audit import audit
from rfdropo_bayes.verbs.calibrate import calibrate
from rfdropo_bayes.verbs.simulate import random_walk
from rfdropo_bayes.verbs.simulated_plant import trunk

NOISE = 2e-4  # [m]
TRUTH = {"young_modulus": 2.9e6, "trunk_mass": 0.07, "rayleigh_stiffness": 0.07}
PLAY = 4e-4  # [m]: half of it
EXPERIMENT = """
robot = "motor_arm"
[data]
format = "netcdf"
resample = 0.05
fit = [FIT]
test = [TEST]
[noise]
standard_deviation = 2e-4
[model]
tension = true
[model.priors]
young_modulus = {}
trunk_mass = {}
rayleigh_stiffness = {}
[inference]
method = "laplace"
starts = 2
[audit]
minutes = 5
"""


def walk(robot: Robot, name: str, seed: int) -> Trajectory:
    """Random commands of six seconds."""
    table = CommandsTable(
        duration=6.0, interval=0.2, step=0.0025, low=0.0, high=0.0075, sample_time=0.1, recordings=[name]
    )
    command_time, command = random_walk(table, len(robot.channel_names), np.random.default_rng(seed))
    time = np.array([0.0, table.duration])
    return Trajectory.build(
        Origin(name=name, robot=robot.name, format="netcdf", synthetic=True),
        SentCommands(
            command_time=command_time, command=command, command_unit=robot.command_unit, cable_names=robot.channel_names
        ),
        Measured(time=time, position=np.tile(robot.marker_points(), (2, 1, 1)), marker_names=robot.marker_names),
    )


class KeptOpen(SimulatedMarkers):
    """Markers of a simulation that outlives one session."""

    def close(self) -> None:
        """Stay open."""


def record(folder: Path, names: dict[str, int], hidden: str = "") -> None:
    """Replay random commands on the virtual arm, one session each: NAME.nc in the folder.

    Args:
        folder: to write to.
        names: of the sessions, with the seed of each.
        hidden: entries of the truth beside its parameters.
    """
    values = [f"model.fixed.{name} = {value}" for name, value in TRUTH.items()]
    (folder / "truth.toml").write_text("\n".join(['robot = "motor_arm"', *values, hidden, ""]))
    robot = Robot.load("motor_arm")
    sensor = KeptOpen(len(robot.marker_names))
    settings = {"marker_noise": NOISE, "experiment": str(folder / "truth.toml")}
    hub = BusTable(interface="hub", channel="127.0.0.1:0")
    table = SimulationTable(
        "motor_arm", hub, "rfdropo_bayes.verbs.simulated_plant:trunk", settings, True, sensor.address
    )
    # A loaded machine without real-time scheduling is no robot.
    patient = SafetyTable(settle_s=1.0, misses=50, stale_cycles=30, heartbeat_s=1.0)
    with simulated_drives(table) as found:
        for name, seed in names.items():
            walk(robot, name, seed).save(folder / f"{name}_commands.nc")
            outcome = deploy(
                Deployment(robot="motor_arm", safety=patient), "replay", folder / name, simulated=True,
                commands=folder / f"{name}_commands.nc", bus=open_bus(found), sensor=sensor,
            )  # fmt: skip
            assert outcome.cause is Cause.FINISHED, outcome.detail
            (folder / f"{name}.nc").write_bytes((folder / name / "session.nc").read_bytes())
    SimulatedMarkers.close(sensor)


def experiment(folder: Path, fit: list[str], test: list[str]) -> Path:
    """Its file."""
    text = EXPERIMENT
    for key, names in (("FIT", fit), ("TEST", test)):
        text = text.replace(key, ", ".join(f'"{name}.nc"' for name in names))
    (folder / "experiment.toml").write_text(text)
    return folder / "experiment.toml"


def test_drums_that_are_commanded_in_angles_pull_as_those_in_lengths() -> None:
    """The same arm, whose spools have the drums' radius or half as much: half the way of the cables, half the pull of
    the drums."""
    arm = Robot.load("motor_arm")
    drum = arm.motors[0].drum_radius_m
    length = np.array([0.004, 0.0, -0.002, 0.001])
    wanted = trunk(arm).advance(length, 0.0).tension
    radius = Parameter(
        unit="m", nominal=drum, low=1e-4, high=0.1, prior={"distribution": "Normal", "loc": drum, "scale": 1e-3},
        description="radius of the spools",
    )  # fmt: skip
    turned = arm.with_changes(
        command=CommandTiming(unit="rad", ramp_s=0.1, dead_time_s=0.001),
        channels=arm.channels.model_copy(update={"radius_parameter": "spool_radius"}),
        parameters={**arm.parameters, "spool_radius": radius},
    )
    np.testing.assert_allclose(trunk(turned).advance(length, 0.0).tension, wanted, rtol=1e-6)
    found = trunk(turned, spool_radius=0.5 * drum).advance(2.0 * length, 0.0).tension
    np.testing.assert_allclose(found, 0.5 * wanted, rtol=1e-6)


@pytest.mark.slow
def test_the_plant_moves_as_a_rollout_of_the_same_commands() -> None:
    """Drums that follow the ramps of a rollout, asked 8 to 12 ms at a time: at the end all is where the rollout is."""
    robot = Robot.load("motor_arm")
    robot = robot.model_copy(update={"command": robot.command.model_copy(update={"dead_time_s": 0.0})})
    command = np.array([[0.006, 0.0, 0.0, -0.002], [0.002, 0.004, 0.0, 0.001]])
    simulator = build_simulator(ModelSpec(robot))
    end = 0.3
    commands = simulator.commands(np.array([0.0, 0.05]), command, np.zeros(4), np.array([0.0, end]))
    expected = simulator.rollout({"young_modulus": np.array(3e6)}, commands)
    plant = trunk(robot, young_modulus=3e6)
    plant.advance(np.zeros(4), 0.0)
    for step in range(1, round(end / 0.01) + 1):
        instant = 0.01 * step
        share = np.clip((instant - np.array([0.0, 0.05])) / robot.command.ramp_s, 0.0, 1.0)
        length = share @ np.diff(command, axis=0, prepend=np.zeros((1, 4)))
        state = plant.advance(length, 0.012 if step % 2 else 0.008)
    np.testing.assert_allclose(state.position, np.asarray(expected.position)[-1], atol=1e-9)
    np.testing.assert_allclose(state.tension, np.asarray(expected.tension)[-1], atol=1e-6)


@pytest.mark.slow
def test_torques_in_the_log_break_the_scale_and_the_truth_is_recovered(tmp_path: Path) -> None:
    record(tmp_path, {"one": 1, "two": 2})
    path = experiment(tmp_path, ["one"], ["two"])
    deviations = {}
    for tension in ("true", "false"):
        calibrate(Model.read(path, [f"model.tension={tension}"]), out=tmp_path / tension)
        found = PosteriorRecord.load(tmp_path / tension / "posterior.nc")
        deviations[tension] = np.std(np.log(found.flat("young_modulus")))
        for name, true in TRUTH.items() if tension == "true" else ():
            draws = found.flat(name)
            # Drives, quantised torques and the log's clock leave a bias of some tenths of a per cent.
            assert abs(draws.mean() - true) < 4.0 * draws.std() + 0.02 * true, name
    assert deviations["true"] < 0.02  # the prior's is 0.5
    assert deviations["false"] > 10.0 * deviations["true"]


@pytest.mark.slow
def test_the_audit_of_the_log_names_what_is_hidden_in_the_robot(tmp_path: Path) -> None:
    names = {"one": 1, "again": 1, "two": 2, "three": 3, "four": 4}
    record(tmp_path, names, f'model.mechanisms = ["backlash"]\nmodel.fixed.backlash = {PLAY}')
    model = Model.read(experiment(tmp_path, ["one", "again", "two"], ["three", "four"]))
    content = audit(model, out=tmp_path / "out").content
    # Where in its play a drive stands when a session begins depends on the session before, which no log tells: the
    # verdict may be that something remains.
    assert content["verdict"] in ("explained", "equivalent", "partly_explained")
    first = content["findings"][0]
    assert first["mechanism"] == "backlash"
    size = first["parameters"]["backlash"]
    assert abs(size["mean"] - PLAY) < 4.0 * size["sd"] + 0.02 * PLAY
