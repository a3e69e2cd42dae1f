"""Poses of a pushed body as data: closed forms, and that they tell what the robot's own markers do not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.infer.util import log_density
from scipy import stats
from scipy.spatial.transform import Rotation

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.channels import Markers, ObjectPose
from rfdropo_bayes.bayes.channels.object_pose import LEVER, draw_object_error
from rfdropo_bayes.bayes.noise import noise_specs
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import SWITCHED
from rfdropo_bayes.simulators.commands import commands_on_grid, sample
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Observation
from studies.replicas import noisy_rollouts, simulated_data, with_measured

STEP = 0.1  # [s]
START = np.array([0.02, 0.0, 0.1])
SHIFT = 0.004  # [m] of the measuring frame along x
TRUTH = {
    "reach": 0.05,
    "slip": 0.6,
    "offset_x": SHIFT,
    "observation_noise": 1e-3,
    "object_noise": 2e-3,
    "object_turn_noise": 0.05,
    "object_correlation_time": 0.5,
}


def spec(name: str, low: float, high: float, nominal: float) -> ParameterSpec:
    prior = {"distribution": "Uniform", "low": low, "high": high}
    return ParameterSpec(name, "m", low, high, nominal, prior, "")


class Finger:
    """A tip that moves by ``reach`` times the command, and a body that goes a share ``slip`` of the way, and turns."""

    parameters = (spec("reach", 0.0, 0.2, 0.1), spec("slip", 0.0, 2.0, 1.0), spec("offset_x", -0.02, 0.02, 0.0),
                  spec("start_x", -1.0, 1.0, 0.0))  # fmt: skip
    pushes = True
    marker_names, cable_names, channel_names, lanes = ("tip",), ("a",), ("a",), 16
    description: dict[str, object] = {"engine": "closed form", "robot": "finger"}  # noqa: RUF012

    def commands(self, time, value, initial, observation_time):
        return commands_on_grid(time, value, initial, observation_time, time_step=STEP)

    def with_object_at(self, values, pose):
        return {**values, "start_x": pose[0] - values["offset_x"]}

    def rollout(self, parameters, commands, steps=None):
        sent = jnp.concatenate([commands.initial[None], jnp.asarray(commands.step)])
        way = parameters["reach"] * sample(sent, commands)[:, 0]
        zero = jnp.zeros_like(way)
        position = jnp.stack([way + parameters["offset_x"], zero, zero], axis=1)[:, None]
        pushed = parameters["slip"] * way
        angle = 5.0 * pushed
        centre = [pushed + parameters.get("start_x", 0.0), zero, zero + START[2]]
        pose = jnp.stack([*centre, zero, jnp.sin(angle / 2), zero, jnp.cos(angle / 2)], axis=1)
        return Observation(position, jnp.zeros((len(way), 1)), pose, jnp.asarray(0))


def recording(*, pose: bool = True) -> Trajectory:
    """A ramp; the body is seen in a frame of its own, turned by a quarter."""
    time = STEP * np.arange(30)
    command = np.clip(time, 0.0, 1.5)[:, None]
    way = TRUTH["reach"] * np.concatenate([command[:1], command[:-1]])[:, 0]
    rng = np.random.default_rng(2)
    turn = Rotation.from_rotvec(5.0 * TRUTH["slip"] * way[:, None] * [0.0, 1.0, 0.0])
    body = (turn * Rotation.from_euler("y", 90, degrees=True)).as_quat()
    centre = START + (TRUTH["slip"] * way)[:, None] * [1.0, 0.0, 0.0]
    return Trajectory.build(
        Origin(name="r", robot="finger", format="netcdf"),
        SentCommands(
            command_time=time, command=command, command_unit="m", cable_names=("a",), initial_command=command[0]
        ),
        Measured(
            time=time,
            position=(way[:, None] * [1.0, 0.0, 0.0] + [SHIFT, 0.0, 0.0] + 1e-3 * rng.normal(size=(30, 3)))[:, None],
            marker_names=("tip",),
            object_pose=np.concatenate([centre, body], axis=1) if pose else None,
        ),
    )


def problem(trajectory: Trajectory, *, poses: bool = True, lost: tuple[int, ...] = ()) -> CalibrationProblem:
    simulator = Finger()
    specs = simulator.parameters + noise_specs("white") + (SWITCHED["object_pose"] if poses else ())
    space = build_scopes(specs, {s.name: {} for s in specs if s.name != "start_x"}, {}, [trajectory.name])
    recordings = gather_recordings(simulator, [trajectory])
    channels = [Markers.gather(recordings, "white")]
    if poses:
        data = ObjectPose.gather(simulator, [trajectory], len(trajectory.time))
        seen = ~np.isin(np.arange(len(trajectory.time)), lost)
        channels.append(ObjectPose.of(data.readings, seen[None], data.time))
    return CalibrationProblem(TrajectoryModel(simulator, space, recordings, tuple(channels)))


def test_white_noise_of_poses_has_no_memory_and_the_density_of_independent_errors():
    """Against a sum of normal log densities; a body that goes 1 mm too far along x in every row but the first."""
    white = ObjectPose.gather(Finger(), [recording()], 30, lasting=False)
    assert [spec.name for spec in white.noise_specs] == ["object_noise", "object_turn_noise"]
    assert white.independent
    assert not ObjectPose.gather(Finger(), [recording()], 30).independent
    about = white.readings.copy()
    about[:, 1:, 0] -= 1e-3
    sizes = {"object_noise": 2e-3, "object_turn_noise": 0.05}
    residual, scale = white.whiten(white.deviation(white.readings, about), sizes)
    np.testing.assert_allclose(
        np.asarray(residual)[0, 1:], [0.5, 0.0, 0.0, 0.0, 0.0, 0.0] * np.ones((29, 1)), atol=1e-6
    )
    np.testing.assert_allclose(np.asarray(scale)[0, 1:], np.log(np.repeat([2e-3, 0.05], 3)) * np.ones((29, 1)))


def test_the_density_of_the_poses_is_that_of_an_ornstein_uhlenbeck_process_about_the_simulated_ones():
    read = recording()
    chosen, plain = problem(read, lost=(7, 8)), problem(read, poses=False)
    truth = TRUTH | {"slip": 0.4}
    values = {name: jnp.array([value]) for name, value in truth.items()}
    rows, bare = (p.row_log_likelihood(values, 30)[0][0] for p in (chosen, plain))
    assert rows[0] == bare[0]  # where the body stands at first is taken from the data, and not predicted
    way = 0.05 * np.clip(np.maximum(read.time - STEP, 0.0), 0.0, 1.5)
    missed = 0.2 * way  # of the centre along x: the body goes further than it is said to; it turns by five times that
    before = 0
    for row in range(1, 30):
        if row in (7, 8):
            assert rows[row] == pytest.approx(bare[row], abs=1e-9)
            continue
        gap = STEP * (row - before)
        phi = np.exp(-gap / 0.5)
        expected = 0.0
        turns = 2.0 * np.sin(0.5 * 5.0 * missed)
        for series, size in ((missed, 2e-3), (turns, 0.05)):
            left = np.array([series[row] - phi * series[before], 0.0, 0.0])
            expected += stats.norm.logpdf(left, 0.0, size * np.sqrt(1 - phi**2)).sum()
        assert rows[row] - bare[row] == pytest.approx(expected, abs=1e-8)
        before = row
    single = {name: value[0] for name, value in values.items()}
    joint, _ = log_density(chosen.model, (), {}, single)
    prior = sum(float(p.prior.log_prob(single[p.name])) for p in chosen.model.scopes.parameters)
    assert float(joint) == pytest.approx(rows.sum() + prior, rel=1e-9)  # the numpyro program has the same density
    # Residuals have the same slope as the density; data put in the model's place count as its own do.
    further = {**values, "slip": jnp.array([0.5])}
    squares = [np.sum(chosen.residuals(v, 30) ** 2) for v in (values, further)]
    there = chosen.row_log_likelihood(further, 30)[0][0]
    assert there.sum() - rows.sum() == pytest.approx(0.5 * (squares[0] - squares[1]), rel=1e-9)
    moved = with_measured(chosen, {**chosen.measured, "object_pose": chosen.measured["object_pose"] + 0.1})
    assert moved.row_log_likelihood(values, 30)[0][0].sum() < rows.sum() - 100.0
    assert len({chosen.fingerprint, plain.fingerprint, moved.fingerprint}) == 3


def test_the_error_of_a_pose_starts_at_zero_and_grows_to_its_own_sizes():
    # 2000 draws: deviations to 1.6 %, five of those allowed, so that it fails by chance once in a million.
    time, pose = jnp.array([0.0, 0.5, 50.0]), jnp.tile(jnp.array([*START, 0.0, 0.0, 0.0, 1.0]), (3, 1))
    keys = jax.random.split(jax.random.key(0), 2000)
    drawn = np.asarray(jax.vmap(lambda key: draw_object_error(key, pose, time, TRUTH))(keys))
    np.testing.assert_allclose(drawn[:, 0], np.tile(pose[0], (2000, 1)))
    for row, share in ((1, np.sqrt(1 - np.exp(-2.0))), (2, 1.0)):
        turned = Rotation.from_quat(drawn[:, row, 3:]).as_rotvec()
        np.testing.assert_allclose((drawn[:, row, :3] - START).std(axis=0), 2e-3 * share, rtol=0.08)
        np.testing.assert_allclose(turned.std(axis=0), 0.05 * share, rtol=0.08)


@pytest.mark.slow
def test_poses_tell_what_the_tip_does_not():
    chosen, plain = problem(recording()), problem(recording(), poses=False)
    made = simulated_data(chosen, TRUTH, jax.random.key(3))
    assert made is not None
    step = 1e-3
    batch = {name: np.full(3, value) for name, value in TRUTH.items()}
    batch["slip"] = TRUTH["slip"] + np.array([0.0, -step, step])
    left, below, above = with_measured(chosen, made).residuals(batch, 30)
    slope = (above - below) / (2.0 * step)
    deviation = 1.0 / np.linalg.norm(slope)
    # A share of 75 mm, seen to 2 mm, and a turn of 0.37 rad, seen to 0.05 rad: five correlation times are a few looks.
    assert 0.005 < deviation < 0.05
    assert abs(slope @ left) * deviation < 4.0  # Gauss-Newton's step from the truth, in deviations
    assert np.sum(left**2) < 30 * 9 + 5.0 * np.sqrt(2.0 * 30 * 9)  # chi-squared of all that was measured
    assert np.ptp(plain.residuals(batch, 30), axis=0).max() == 0.0


def test_what_is_lacking_is_said():
    with pytest.raises(InputError, match="no pose of the pushed body"):
        ObjectPose.gather(Finger(), [recording(pose=False)], 30)
    with pytest.raises(InputError, match="no body whose pose"):
        ObjectPose.gather(object(), [recording()], 30)


@pytest.mark.slow
def test_methods_that_compare_rollouts_see_the_way_and_the_turn_of_the_body():
    """Columns are those of the tip, of the centre and of the turn; noise has the sizes and the start of the model's."""
    chosen = problem(recording(), lost=(7,))
    values = {name: jnp.full(4000, value) for name, value in TRUTH.items()}
    clean, status = chosen.rollouts({name: column[:1] for name, column in values.items()}, 30)
    assert clean.shape == (1, 30, 9)
    assert not status.any()
    way = TRUTH["reach"] * np.clip(np.maximum(STEP * np.arange(30) - STEP, 0.0), 0.0, 1.5)
    pushed = TRUTH["slip"] * way
    np.testing.assert_allclose(clean[0, :, 3], START[0] + pushed, atol=1e-9)
    np.testing.assert_allclose(clean[0, :, 7], LEVER * 2.0 * np.sin(2.5 * pushed), atol=1e-9)
    np.testing.assert_allclose(chosen.observed[:, 3:], clean[0, :, 3:], atol=1e-9)  # the body was read without noise
    assert not chosen.observed_mask[7, 3:].any()
    assert chosen.observed_mask[8].all()
    noise = noisy_rollouts(chosen, jax.random.key(0), values)[0] - clean
    assert not noise[:, 0, 3:].any()
    # 4000 draws know a deviation to 1.1 %: 5 times that.
    decayed = np.sqrt(1.0 - np.exp(-2.0 * 2.9 / 0.5))
    np.testing.assert_allclose(noise[:, 29, 3:6].std(axis=0), 2e-3 * decayed, rtol=0.056)
    np.testing.assert_allclose(noise[:, 29, 6:].std(axis=0), LEVER * 0.05 * decayed, rtol=0.056)
    np.testing.assert_allclose(noise[:, 29, :3].std(axis=0), 1e-3, rtol=0.056)
    np.testing.assert_allclose(chosen.noise_deviation(TRUTH), [1e-3] * 3 + [2e-3] * 3 + [LEVER * 0.05] * 3)
