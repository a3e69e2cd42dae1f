"""All channels in one model, against densities written down anew; and known noise, from repeats or stated."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.infer.util import log_density
from scipy import stats

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.channels import Markers, MotorAngle, ObjectPose, Tension, Weighed, WeighedParts
from rfdropo_bayes.bayes.channels.motor_angle import MOTOR_ANGLE_NOISE
from rfdropo_bayes.bayes.channels.object_pose import OBJECT_CORRELATION_TIME, OBJECT_NOISE, OBJECT_TURN_NOISE
from rfdropo_bayes.bayes.channels.tension import TENSION_NOISE
from rfdropo_bayes.bayes.noise import Autoregression, noise_specs
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.bayes.repeat_noise import deviations, group_recordings, with_noise_of_repeats
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.simulators.commands import commands_on_grid, sample
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Observation
from studies.replicas import simulated_data

STEP, ROWS = 0.1, 12
SIZES = {"observation_noise": 2e-3, "tension_noise": 0.05, "motor_angle_noise": 0.01}
SIZES |= {"object_noise": 3e-3, "object_turn_noise": 0.05, "object_correlation_time": 0.5}


class Puller:
    """A tip, a cable, an encoder and a body, all in proportion to the command."""

    parameters = (ParameterSpec("reach", "m", 0.01, 1.0, 0.1, {"distribution": "LogNormal", "median": 0.1, "sigma": 0.5}, ""),)  # fmt: skip # noqa: E501
    pushes = True
    marker_names, cable_names, channel_names, lanes = ("tip",), ("a",), ("a",), 16
    description: dict[str, object] = {"engine": "closed form", "robot": "puller"}  # noqa: RUF012

    def commands(self, time, value, initial, observation_time):
        return commands_on_grid(time, value, initial, observation_time, time_step=STEP)

    def with_object_at(self, values, pose):
        return values

    def rollout(self, parameters, commands, steps=None):
        sent = sample(jnp.concatenate([commands.initial[None], jnp.asarray(commands.step)]), commands)[:, 0]
        way, zero = parameters["reach"] * sent, jnp.zeros_like(sent)
        pose = jnp.stack([way, zero, zero, zero, zero, zero, zero + 1.0], axis=1)
        position = jnp.stack([way, zero, zero], axis=1)[:, None]
        return Observation(position, (5.0 + sent)[:, None], pose, jnp.asarray(0), sent[:, None])


def recording(seed: int, noise: np.ndarray | None = None) -> Trajectory:
    rng, time = np.random.default_rng(seed), STEP * np.arange(ROWS)
    command = np.sin(time)[:, None]
    sent = np.concatenate([command[:1], command[:-1]])[:, 0]
    position = (0.12 * sent)[:, None] * [1.0, 0.0, 0.0]
    pose = np.concatenate([position + 1e-3 * rng.normal(size=(ROWS, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (ROWS, 1))], 1)
    own = 2e-3 * rng.normal(size=(ROWS, 3)) if noise is None else noise
    return Trajectory.build(
        Origin(name=f"r{seed}", robot="puller", format="netcdf"),
        SentCommands(
            command_time=time, command=command, command_unit="rad", cable_names=("a",), initial_command=command[0]
        ),
        Measured(
            time=time,
            position=(position + own)[:, None],
            marker_names=("tip",),
            tension=(5.0 + sent)[:, None] * (1.0 + 0.05 * rng.normal(size=(ROWS, 1))),
            motor_angle=sent[:, None] + 0.01 * rng.normal(size=(ROWS, 1)),
            object_pose=pose,
        ),
    )


def problem(*recordings: Trajectory, known: Autoregression | None = None) -> CalibrationProblem:
    """All channels, or markers of known noise alone."""
    simulator, gathered = Puller(), gather_recordings(Puller(), recordings)
    specs = (*simulator.parameters, *noise_specs("white"))
    channels = [Markers.gather(gathered, "white", known)]
    if known is None:
        specs += (TENSION_NOISE, MOTOR_ANGLE_NOISE, OBJECT_NOISE, OBJECT_TURN_NOISE, OBJECT_CORRELATION_TIME)
        channels += [Tension.gather(simulator, recordings, ROWS), MotorAngle.gather(recordings, ROWS)]
        channels += [ObjectPose.gather(simulator, recordings, ROWS), WeighedParts((Weighed(("reach",), 0.11, 0.01),))]
    else:
        specs = simulator.parameters
    space = build_scopes(specs, {spec.name: {} for spec in specs}, {}, gathered.names)
    return CalibrationProblem(TrajectoryModel(simulator, space, gathered, tuple(channels)))


@pytest.mark.slow
def test_the_log_likelihood_is_the_sum_of_the_channels_written_down_anew():
    reach, read = 0.1, recording(1)
    sent = np.concatenate([read.command[:1], read.command[:-1]])[:, 0]
    way = (reach * sent)[:, None] * [1.0, 0.0, 0.0]
    expected = stats.norm.logpdf(read.position[:, 0], way, 2e-3).sum(axis=1)
    expected += stats.norm.logpdf(read.tension[:, 0], 5.0 + sent, 0.05 * (5.0 + sent))
    expected += stats.norm.logpdf(read.motor_angle[:, 0], sent, 0.01)
    expected[0] += stats.norm.logpdf(reach, 0.11, 0.01)
    left, phi = read.object_pose[:, :3] - way, np.exp(-STEP / 0.5)
    for size, error in ((3e-3, left), (0.05, np.zeros_like(left))):
        spread = size * np.sqrt(1.0 - phi**2)
        expected[1:] += stats.norm.logpdf(error[1:], phi * error[:-1], spread).sum(axis=1)
    values = {"reach": jnp.array([reach])} | {name: jnp.array([size]) for name, size in SIZES.items()}
    chosen = problem(read)
    rows = chosen.row_log_likelihood(values, ROWS)[0][0]
    np.testing.assert_allclose(rows, expected, rtol=1e-9)
    assert chosen.model.channel_names == ("markers", "tension", "motor_angle", "object_pose", "weighed")
    assert chosen.physical_names == ("reach",)
    single = {name: value[0] for name, value in values.items()}
    joint, _ = log_density(chosen.model, (), {}, single)
    prior = sum(float(p.prior.log_prob(single[p.name])) for p in chosen.model.scopes.parameters)
    assert float(joint) == pytest.approx(rows.sum() + prior, rel=1e-9)
    replica = simulated_data(chosen, {"reach": reach, **SIZES}, jax.random.key(0))
    assert {name: array.shape for name, array in replica.items()} == {
        name: np.shape(array) for name, array in chosen.measured.items()
    }


def test_residuals_of_all_channels_have_one_layout_in_batches_and_taken_apart():
    """JAX returns dictionaries in the order of their keys, and the tension stands before the motor angle."""
    chosen = problem(recording(1), recording(3))
    values = {"reach": 0.1, **SIZES}
    single = {name: jnp.asarray(value) for name, value in values.items()}
    white = chosen.residuals({name: np.array([value]) for name, value in values.items()}, ROWS)[0]
    series = chosen.independent_series(white)
    assert set(series) == {"markers", "tension", "motor_angle"}
    own = chosen.model.white(chosen.model.seen(chosen.model.simulate(single), single))
    for name, (part, valid) in series.items():
        np.testing.assert_allclose(part, np.asarray(own[name])[..., : valid.shape[-1]], rtol=1e-9)


def across(share: float) -> np.ndarray:
    return share * np.ones((3, 3)) + (1.0 - share) * np.eye(3)


@pytest.mark.parametrize("correlation", [None, across(0.6)])
def test_known_noise_has_the_density_of_its_normal_distribution_and_draws_from_it(correlation):
    """AR(1) in time, shared between coordinates; a masked row splits a series in two. 4000 draws know a covariance to
    3 % of the variances: 6 standard errors."""
    read = recording(2)
    noise = Autoregression(np.array([1e-3, 2e-3, 3e-3]), np.array([1.0, 0.6]), "stated", np.inf, correlation)
    chosen = problem(read, known=noise)
    sent = np.concatenate([read.command[:1], read.command[:-1]])[:, 0]
    error = read.position[:, 0] - (0.1 * sent)[:, None] * [1.0, 0.0, 0.0]
    in_time = 0.6 ** np.abs(np.subtract.outer(np.arange(ROWS), np.arange(ROWS)))
    at_once = np.outer(noise.scale, noise.scale) * (np.eye(3) if correlation is None else correlation)
    expected = stats.multivariate_normal(cov=np.kron(in_time, at_once)).logpdf(error.reshape(-1))
    rows, _ = chosen.row_log_likelihood({"reach": jnp.array([0.1])}, ROWS)
    assert rows.sum() == pytest.approx(expected, rel=1e-9)
    joint, _ = log_density(chosen.model, (), {}, {"reach": jnp.asarray(0.1)})
    prior = float(chosen.model.scopes.parameters[0].prior.log_prob(0.1))
    assert float(joint) == pytest.approx(expected + prior, rel=1e-9)
    drawn = chosen.draw_noise(jax.random.key(1), {"reach": np.full(4000, 0.1)})[:, 0, -2:, 0].reshape(4000, 6)
    wanted = np.kron(in_time[-2:, -2:], at_once)
    sizes = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    np.testing.assert_allclose(np.cov(drawn.T) / sizes, wanted / sizes, atol=0.1)
    valid = np.ones((ROWS, 3), dtype=bool)
    valid[5] = False
    parts = [noise.row_log_density(error[rows], valid[rows]).sum() for rows in (slice(0, 5), slice(6, None))]
    assert noise.row_log_density(error, valid).sum() == pytest.approx(sum(parts))


def test_slow_noise_is_drawn_as_large_in_the_first_row_as_in_the_last():
    """4000 draws of 30 rows know a covariance to 3 % of the variance: 5 standard errors. A start at zero, 60 rows
    before, would leave a third of the variance out."""
    memory = np.array([1.0, 0.995, 0.988])
    noise = Autoregression(np.array([2.0]), memory, "stated", np.inf)
    drawn = noise.draw(np.random.default_rng(3), (4000, 30, 1))[..., 0]
    lags = np.array([*memory, *np.zeros(27)])
    for lag in range(3, 30):
        lags[lag] = noise.predictors[0][-1] @ lags[lag - 1 : lag - 3 : -1]
    wanted = 4.0 * lags[np.abs(np.subtract.outer(np.arange(30), np.arange(30)))]
    np.testing.assert_allclose(np.cov(drawn.T), wanted, atol=5 * 4.0 * np.sqrt(2.0 / 4000))


def test_a_repeat_that_a_marker_is_lost_in_adds_no_degrees_of_freedom():
    """The mean square over the degrees of freedom is the variance: 2000 rows of three repeats, one coordinate lost in
    the third, know it to 1.6 %; three times that."""
    errors = 2e-3 * np.random.default_rng(4).normal(size=(4, 2000, 2))
    valid = np.ones(errors.shape, dtype=bool)
    valid[2, :, 1] = False
    left, counted, share = deviations(errors, valid, ((0, 1, 2), (3,)))
    assert share == pytest.approx((2 + 1) / (3 + 2))
    assert np.sum(left**2) / (counted.sum() * share) == pytest.approx(2e-3**2, rel=0.055)


def test_noise_of_repeats_is_that_which_they_differ_by():
    """40 rows of three coordinates, twice: 6 degrees of freedom a row pooled know a deviation to 5 %, four times that;
    an experiment without repeats is refused."""
    rng = np.random.default_rng(7)
    reads = [recording(seed, 3e-3 * rng.normal(size=(ROWS, 3))) for seed in range(10, 20)]
    gathered = gather_recordings(Puller(), reads)
    groups = group_recordings(gathered, reads)
    assert groups == (tuple(range(10)),)
    markers = with_noise_of_repeats(Markers.gather(gathered, "repeats"), groups, gathered.steps)
    assert markers.specs == ()
    assert markers.known.source == "repeats"
    np.testing.assert_allclose(markers.known.scale, 3e-3, rtol=0.2)
    tension = Tension.gather(Puller(), reads, ROWS)
    np.testing.assert_allclose(with_noise_of_repeats(tension, groups, gathered.steps).known.scale, 0.05, rtol=0.3)
    with pytest.raises(InputError, match="carried out twice"):
        with_noise_of_repeats(markers, ((0,), (1,)), gathered.steps)


@pytest.mark.slow
def test_a_calibration_under_the_noise_of_repeats_has_the_width_of_generalised_least_squares():
    """Reach is linear and its prior wide: the posterior's deviation is that of the covariance that repeats show,
    and the truth lies within 4 of them (1 seed in 10^4). 4000 draws know a deviation to 1 %: 5 times that, and 1 % for
    the prior and what is not linear."""
    rng = np.random.default_rng(8)
    reads = []
    for seed in range(20, 28):
        noise = 2e-3 * rng.normal(size=(ROWS, 3))
        for row in range(1, ROWS):
            noise[row] = 0.6 * noise[row - 1] + 0.8 * noise[row]
        reads.append(recording(seed, noise))
    gathered = gather_recordings(Puller(), reads)
    groups = group_recordings(gathered, reads)
    known = with_noise_of_repeats(Markers.gather(gathered, "repeats"), groups, gathered.steps).known
    assert known.order >= 1
    options = {"starts": 1, "blocks": 1, "draws": 4000}
    result = methods.run(problem(*reads, known=known), "laplace", options, jax.random.key(3))
    sent = np.concatenate([reads[0].command[:1], reads[0].command[:-1]])[:, 0]
    white = known.whiten(np.stack([sent, 0.0 * sent, 0.0 * sent], axis=1), np.ones((ROWS, 3), dtype=bool))
    deviation = 1.0 / np.sqrt(len(reads) * np.sum(white**2))
    assert result.draws["reach"].std() == pytest.approx(deviation, rel=0.06)
    assert abs(result.draws["reach"].mean() - 0.12) < 4.0 * deviation
    assert set(result.draws) == {"reach"}
