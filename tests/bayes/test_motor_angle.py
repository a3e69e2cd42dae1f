"""Motor angles as data: closed forms, readings that are held, and that they tell a slow drive from a damped body."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.infer.util import log_density
from scipy import stats
from scipy.signal import StateSpace, lsim

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.channels import Markers, MotorAngle
from rfdropo_bayes.bayes.channels.motor_angle import MOTOR_ANGLE_NOISE
from rfdropo_bayes.bayes.noise import noise_specs
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import CsvColumns, Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.data.held_readings import hold_time
from rfdropo_bayes.data.mapped_formats import read_mapped
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.mechanisms.registry import REGISTRY, mechanisms_named
from rfdropo_bayes.model.assembly import build_model, build_simulator, measurement_specs
from rfdropo_bayes.model.experiment import Experiment
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.commands import commands_on_grid, sample
from rfdropo_bayes.simulators.mechanisms import Mechanism, inside_drive
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Observation
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from studies.replicas import simulated_data, with_measured

STEP = 0.02  # [s], of the simulation and of the recording
LAG = REGISTRY["actuator_lag"]()
SENT, READ = 1e-3, 0.004  # noise of positions [m] and of motor angles [rad]
TRUTH = {"actuator_lag": 0.08, "damping_time": 0.11, "observation_noise": SENT, "motor_angle_noise": READ}


class ServoAndBody:
    """Two drives with a lag pull an overdamped body (0.1 m per rad): to positions alone the two lags look alike."""

    parameters = (
        *LAG.parameters,
        ParameterSpec(
            "damping_time", "s", 1e-3, 5.0, 0.1, {"distribution": "LogNormal", "median": 0.1, "sigma": 1.0}, ""
        ),
    )
    marker_names, cable_names, channel_names, lanes = ("tip",), ("a", "b"), ("a", "b"), 16
    description: dict[str, object] = {"engine": "closed form", "robot": "servo and body"}  # noqa: RUF012
    tells = True

    def commands(self, time, value, initial, observation_time):
        return commands_on_grid(time, value, initial, observation_time, time_step=STEP)

    def rollout(self, parameters, commands, steps=None):
        drive = LAG.actuate(parameters, jnp.asarray(commands.step), commands.initial, STEP)
        body = LAG.actuate({"actuator_lag": parameters["damping_time"]}, drive, commands.initial, STEP)
        seen = [sample(jnp.concatenate([commands.initial[None], series]), commands) for series in (drive, body)]
        position = 0.1 * jnp.concatenate([seen[1], jnp.zeros((len(seen[1]), 1))], axis=1)[:, None]
        status = jnp.asarray(0)
        return Observation(position, jnp.zeros_like(seen[1]), None, status, seen[0] if self.tells else None)


def recording(rows: int = 200, hold: int = 1, unit: str = "rad", angles: bool = True) -> Trajectory:
    """Smooth commands, as of the ASL trunk; angles are read every ``hold`` rows and repeated in between."""
    rng = np.random.default_rng(3)
    time = STEP * np.arange(rows)
    phase = np.array([0.3, 1.9])
    command = 0.5 * np.sin(2 * np.pi * 0.4 * time[:, None] + phase) + 0.3 * np.sin(2 * np.pi * 0.9 * time[:, None])
    simulator = ServoAndBody()
    clean = simulator.rollout(TRUTH, simulator.commands(time, command, command[0], time))
    fresh = np.asarray(clean.motor_angle) + READ * rng.normal(size=(rows, 2))
    return Trajectory.build(
        Origin(name="r", robot="servo and body", format="netcdf", settings={"motor_angle_hold": hold * STEP}),
        SentCommands(
            command_time=time, command=command, command_unit=unit, cable_names=("a", "b"), initial_command=command[0]
        ),
        Measured(
            time=time,
            position=np.asarray(clean.position) + SENT * rng.normal(size=(rows, 1, 3)),
            marker_names=("tip",),
            motor_angle=fresh[hold * (np.arange(rows) // hold)] if angles else None,
        ),
    )


def problem(trajectory: Trajectory, *, angles: bool = True, simulator: ServoAndBody | None = None):
    simulator = simulator or ServoAndBody()
    specs = simulator.parameters + noise_specs("white") + (MOTOR_ANGLE_NOISE,) * angles
    space = build_scopes(specs, {spec.name: {} for spec in specs}, {}, ["r"])
    recordings = gather_recordings(simulator, [trajectory])
    channels = [Markers.gather(recordings, "white")]
    channels += [MotorAngle.gather([trajectory], len(trajectory.time))] if angles else []
    return CalibrationProblem(TrajectoryModel(simulator, space, recordings, tuple(channels)))


def batch(**values: float) -> dict[str, jax.Array]:
    return {name: jnp.array([value]) for name, value in {**TRUTH, **values}.items()}


@pytest.mark.slow
def test_the_density_of_the_angles_is_that_of_normals_at_new_readings_only():
    read = recording(60, hold=3)
    chosen, plain = problem(read), problem(read, angles=False)
    values = batch(actuator_lag=0.05, motor_angle_noise=0.01)
    with_angles, without = chosen.row_log_likelihood(values, 60)[0][0], plain.row_log_likelihood(values, 60)[0][0]
    sent = np.concatenate([read.initial_command[None], read.command[:59]])  # runs straight from step to step
    drives = [
        lsim(StateSpace(-1.0 / 0.05, 1.0 / 0.05, 1.0, 0.0), column, STEP * np.arange(60), X0=column[0])[1]
        for column in sent.T
    ]
    for row, drive in enumerate(np.transpose(drives)[1:], start=1):
        new = row % 3 == 0
        expected = stats.norm.logpdf(read.motor_angle[row], drive, 0.01).sum() if new else 0.0
        assert with_angles[row] - without[row] == pytest.approx(expected, abs=1e-9)
    assert with_angles[0] == without[0]  # when the first row was read is not known
    single = {name: value[0] for name, value in values.items()}
    residuals = chosen.residuals(values, 60)[0]
    count = 2 * 19
    constant = -60 * 3 * np.log(SENT) - count * np.log(0.01) - 0.5 * (180 + count) * np.log(2 * np.pi)
    assert with_angles.sum() == pytest.approx(constant - 0.5 * np.sum(residuals**2), rel=1e-9)
    # The numpyro program has the same joint density.
    joint, _ = log_density(chosen.model, (), {}, single)
    prior = sum(float(p.prior.log_prob(single[p.name])) for p in chosen.model.scopes.parameters)
    assert float(joint) == pytest.approx(with_angles.sum() + prior, rel=1e-9)
    # A prefix holds the rows of the whole, and data put in the model's place count as its own do.
    np.testing.assert_allclose(chosen.row_log_likelihood(values, 20)[0][0], with_angles[:20])
    shifted = with_measured(chosen, {**chosen.measured, "motor_angle": chosen.measured["motor_angle"] + 1.0})
    assert shifted.row_log_likelihood(values, 60)[0][0].sum() < with_angles.sum() - 1000.0
    assert len({chosen.fingerprint, plain.fingerprint, shifted.fingerprint}) == 3


def test_held_readings_stay_masked_when_rows_are_cut_or_resampled_and_in_a_file(tmp_path):
    whole = recording(60, hold=3)
    assert hold_time(whole.time, whole.motor_angle) == pytest.approx(3 * STEP)
    new = np.arange(60) % 3 == 0
    new[0] = False
    np.testing.assert_array_equal(whole.motor_angle_mask, np.stack([new, new], axis=1))
    np.testing.assert_array_equal(whole.slice_rows(6, 40).motor_angle_mask[:, 0], new[6:41])  # row 6 is known as new
    np.testing.assert_array_equal(whole.resample(2 * STEP).motor_angle_mask[:, 0], new[::2])
    assert not whole.resample(1.5 * STEP).motor_angle_mask[1::2].any()  # between a new reading and a repeated one
    whole.save(tmp_path / "held.nc")
    np.testing.assert_array_equal(Trajectory.load(tmp_path / "held.nc").motor_angle_mask, whole.motor_angle_mask)
    assert recording(60).motor_angle_mask.all()  # read at every row


def test_a_table_of_columns_is_searched_for_held_angles_too(tmp_path):
    whole = recording(60, hold=3)
    table = np.column_stack([whole.time, whole.command, whole.position[:, 0], whole.motor_angle])
    np.savetxt(tmp_path / "r.csv", table, "%.9g", delimiter=",", header="t,a,b,x,y,z,phi_a,phi_b", comments="")
    columns = {"time": "t", "commands": ["a", "b"], "command_unit": "rad", "positions": [["x", "y", "z"]]}
    columns |= {"position_unit": "m", "axes": ["x", "y", "z"], "motor_angles": ["phi_a", "phi_b"], "robot": "r"}
    read = read_mapped("csv", tmp_path / "r.csv", CsvColumns.model_validate(columns))
    np.testing.assert_array_equal(read.motor_angle_mask, whole.motor_angle_mask)


def test_a_replica_holds_new_angles_with_the_noise_of_the_model():
    chosen = problem(recording(hold=2))
    replica = simulated_data(chosen, TRUTH, jax.random.key(1))
    clean = np.asarray(chosen.observe(batch()).motor_angle)[0]
    valid = chosen.model.channels[1].valid
    assert not replica["motor_angle"][~valid].any()
    error = (replica["motor_angle"] - clean)[valid]
    # 198 normals: the ratio of deviations has a standard error of 5 %; outside 20 % once in 10^4 seeds, and it is fixed
    assert error.std() == pytest.approx(READ, rel=0.2)
    without = simulated_data(problem(recording(hold=2), angles=False), TRUTH, jax.random.key(1))
    assert "motor_angle" not in without
    np.testing.assert_array_equal(without["markers"], replica["markers"])


@pytest.mark.slow
def test_angles_tell_a_slow_drive_from_a_damped_body():
    """By Gauss-Newton and Laplace, whose deviations depend on the noise drawn by a few per cent only.

    Off by more than 4 deviations: one seed in 10^4, and the seed is fixed.
    """
    options = {"starts": 1, "blocks": 1, "prior_draws": 16, "draws": 4000}
    fits = {
        angles: methods.run(problem(recording(), angles=angles), "laplace", options, jax.random.key(5)).draws
        for angles in (True, False)
    }
    lag, damping = ({a: np.asarray(fits[a][name]).ravel() for a in fits} for name in ("actuator_lag", "damping_time"))
    assert np.corrcoef(lag[False], damping[False])[0, 1] < -0.9  # positions alone fix the sum of the lags
    assert lag[True].std() < 0.25 * lag[False].std()
    for found, truth in ((lag[True], 0.08), (damping[True], 0.11)):
        assert abs(found.mean() - truth) < 4.0 * found.std()
    assert np.median(fits[True]["motor_angle_noise"]) == pytest.approx(READ, rel=0.2)


@dataclass(frozen=True)
class Drives(RobotSimulator):
    pushes = at_rest = False
    robot: Robot
    mechanisms: tuple[Mechanism, ...] = field(default_factory=tuple)


def test_the_encoder_shows_what_happens_inside_the_drive_in_the_order_given():
    robot = Robot.load("asl_trunk")
    time = STEP * np.arange(30)
    command = 0.3 * np.sin(5.0 * time)[:, None] * np.ones(6)
    commands = commands_on_grid(time, command, command[0], time, time_step=STEP)
    names = ["cable_gain", "rate_limit", "backlash", "actuator_lag", "drive_creep"]
    values = {"inverse_speed_limit": 1.0, "actuator_lag": 0.1, "backlash": 0.05, "drive_creep": 0.3}
    values |= {f"cable_gain_error_motor_{k}": 0.1 * k for k in range(1, 7)} | {"drive_creep_time": 1.0}
    values = {name: jnp.asarray(value) for name, value in values.items()}
    simulator = Drives(robot, mechanisms_named(names, robot))
    limited = REGISTRY["rate_limit"]().actuate(values, jnp.asarray(commands.step), commands.initial, STEP)
    expected = LAG.actuate(values, limited, commands.initial, STEP)
    driven = simulator.driven(values, commands, STEP)
    np.testing.assert_array_equal(driven[0], commands.initial)
    np.testing.assert_allclose(driven[1:], expected, rtol=0, atol=1e-15)
    assert float(jnp.abs(simulator.actuated(values, commands, STEP)[1] - expected).max()) > 0.01  # the cables get less
    without = Drives(robot, mechanisms_named(["rate_limit", "actuator_lag"], robot))
    np.testing.assert_array_equal(without.driven(values, commands, STEP), driven)


def test_gains_scale_the_whole_command_and_what_was_in_force_before_the_first_row():
    """A command u that was held for ever: drives stand at (1 + g) u, cables at (1 + g) (1 + e) u radii, from row 0 on,
    whatever lags behind. Half of a command is lost, so that nothing but the whole of it can be scaled."""
    robot = Robot.load("asl_trunk")
    time, held = STEP * np.arange(5), 0.1 * np.arange(1, 7)
    commands = commands_on_grid(time, np.tile(held, (5, 1)), held, time, time_step=STEP)
    errors = np.linspace(-0.5, 0.5, 6)
    values = {f"cable_gain_error_motor_{k}": error for k, error in enumerate(errors, start=1)}
    values |= {"command_gain_error": -0.5, "actuator_lag": 0.1, "command_delay": 0.015}
    simulator = Drives(robot, mechanisms_named(["command_gain", "actuator_lag", "command_delay", "cable_gain"], robot))
    known = simulator.complete({name: jnp.asarray(value) for name, value in values.items()})
    np.testing.assert_allclose(simulator.driven(known, commands, STEP), np.tile(0.5 * held, (5, 1)), rtol=1e-14)
    expected = robot.channel_matrix(known) @ (0.5 * (1.0 + errors) * held)
    start, levels = simulator.wound(known, commands, STEP)
    np.testing.assert_allclose(start - simulator.pretension(known), expected, rtol=1e-12)
    np.testing.assert_allclose(levels, np.tile(start, (len(levels), 1)), rtol=1e-12)


def test_a_mechanism_of_a_user_is_inside_the_drive_unless_it_says_otherwise():
    class Own:
        name = stage = "actuation"

    assert inside_drive(Own())
    Own.inside_drive = False
    assert not inside_drive(Own())
    transmission = {"backlash", "cable_gain", "cable_slack", "spool_growth", "drive_creep", "drive_zero_drift"}
    transmission |= {"cable_gain_drift", "command_gain_drift", "cable_slack_drift", "guide_azimuth"}
    drive = {"command_delay", "actuator_lag", "command_gain", "end_stop", "travel_stop", "rate_limit"}
    assert {name for name in transmission | drive if inside_drive(REGISTRY[name]())} == drive


def test_an_experiment_asks_for_the_angles_and_leaves_the_drives_to_mechanisms():
    tables = {
        "robot": "asl_trunk",
        "simulator": {"engine": "numba", "drives": "direct", "time_step": 0.02},
        "model": {"motor_angle": True, "mechanisms": ["actuator_lag", "command_gain_drift"]},
    }
    spec = spec_of(Experiment.model_validate(tables), Path())
    simulator = build_simulator(spec)
    time = 0.1 * np.arange(20)
    command = np.where(time > 0.55, 0.2, 0.0)[:, None] * np.ones(6)
    commands = simulator.commands(time, command, command[0], time)
    np.testing.assert_array_equal(sample(np.vstack([commands.initial, commands.step]), commands)[7:], command[7:])
    trunk = Trajectory.build(
        Origin(name="r", robot="asl_trunk", format="netcdf"),
        SentCommands(
            command_time=time, command=command, command_unit="rad", cable_names=[f"motor{k}" for k in range(1, 7)]
        ),
        Measured(
            time=time,
            position=np.tile(simulator.robot.marker_points(), (20, 1, 1)),
            marker_names=simulator.marker_names,
            motor_angle=command,
        ),
    )
    model = build_model(spec, simulator, [trunk])
    assert model.measured["motor_angle"].shape == (1, 20, 6)
    noise = {spec.name for spec in noise_specs("auto")}
    assert set(model.scopes.names) == {"actuator_lag", "command_gain_error_rate", "motor_angle_noise"} | noise
    assert model.scopes["command_gain_error_rate"].table["scale"] == pytest.approx(0.2 / time[-1])  # a drift in one run
    calibration = CalibrationProblem(model)
    assert calibration.physical_names == ("actuator_lag", "command_gain_error_rate")
    assert calibration.prior_ends.keys() == calibration.bounds.keys()
    assert calibration.prior_ends["actuator_lag"][0] == 0.0
    measured = {spec.name for spec in measurement_specs(spec.noise, spec.channels)}  # what a posterior may hold beside
    assert measured == {"motor_angle_noise"} | noise


def test_what_cannot_be_used_is_refused():
    with pytest.raises(InputError, match="has no motor angles"):
        MotorAngle.gather([recording(angles=False)], 200)
    with pytest.raises(InputError, match="the commands are in m"):
        MotorAngle.gather([recording(60, unit="m")], 60)
    with pytest.raises(InputError, match="no row has a new reading of the motor angles"):
        MotorAngle.gather([recording(60, hold=3).slice_rows(1, 2)], 2)
    silent = ServoAndBody()
    silent.tells = False
    with pytest.raises(InputError, match="the simulator has no drive positions"):
        problem(recording(60), simulator=silent).row_log_likelihood(batch(), 60)
