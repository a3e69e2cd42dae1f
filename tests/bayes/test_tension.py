"""Tension readings and weighed parts against closed forms, and that they determine what motion leaves free."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.channels import Markers, Seen, Tension, Weighed, WeighedParts
from rfdropo_bayes.bayes.channels.channel import ABOVE_ZERO
from rfdropo_bayes.bayes.channels.tension import TENSION_GAIN, TENSION_NOISE
from rfdropo_bayes.bayes.noise import noise_specs
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.posteriors import ParameterInfo, Scope
from rfdropo_bayes.simulators.commands import commands_on_grid
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.protocol import Observation

TRUTH = {"stiffness": 240.0, "mass": 0.13}


class HangingMass:
    """A mass on a spring that a cable lengthens: position -(u + m g / k), tension k u + m g. Motion sees m / k only."""

    parameters = tuple(
        ParameterSpec(
            name, unit, 1e-4, 1e5, nominal, {"distribution": "LogNormal", "median": nominal, "sigma": 0.8}, ""
        )
        for name, unit, nominal in (("stiffness", "N/m", 200.0), ("mass", "kg", 0.1))
    )
    marker_names, cable_names, channel_names, lanes = ("tip",), ("pull",), ("pull",), 16
    description: dict[str, object] = {"engine": "closed form", "robot": "hanging mass"}  # noqa: RUF012

    def commands(self, time, value, initial, observation_time):
        return commands_on_grid(time, value, initial, observation_time, time_step=0.1)

    def rollout(self, parameters, commands, steps=None):
        k, m = parameters["stiffness"], parameters["mass"]
        u = jnp.concatenate([commands.initial[None], commands.step])[commands.sample_step, 0]
        zero = jnp.zeros_like(u)
        position = jnp.stack([zero, zero, -u - 9.81 * m / k], axis=-1)[:, None]
        return Observation(position, (k * u + 9.81 * m)[:, None], None, jnp.asarray(0))


def recording(tension: bool = True) -> Trajectory:
    rng = np.random.default_rng(8)
    time = 0.1 * np.arange(15)
    command = np.linspace(0.0, 0.02, 15)[:, None]
    simulator = HangingMass()
    clean = simulator.rollout(TRUTH, simulator.commands(time, command, command[0], time))
    return Trajectory.build(
        Origin(name="r", robot="hanging mass", format="netcdf"),
        SentCommands(
            command_time=time, command=command, command_unit="m", cable_names=("pull",), initial_command=command[0]
        ),
        Measured(
            time=time,
            position=np.asarray(clean.position) + 1e-4 * rng.normal(size=(15, 1, 3)),
            marker_names=("tip",),
            tension=np.asarray(clean.tension) * (1.0 + 0.01 * rng.normal(size=(15, 1))) if tension else None,
        ),
    )


def problem(*, tension: bool, weighed: Sequence[Weighed] = (), gain: bool = False) -> CalibrationProblem:
    simulator, trajectory = HangingMass(), recording()
    specs = simulator.parameters + noise_specs("white") + (TENSION_NOISE, TENSION_GAIN) * tension
    priors = {spec.name: {} for spec in specs if gain or spec.name != "tension_gain"}
    space = build_scopes(specs, priors, {}, ["r"])
    recordings = gather_recordings(simulator, [trajectory])
    channels = [Markers.gather(recordings, "white")]
    channels += [Tension.gather(simulator, [trajectory], 15)] if tension else []
    channels += [WeighedParts(tuple(weighed))] if weighed else []
    return CalibrationProblem(TrajectoryModel(simulator, space, recordings, tuple(channels)))


def spread(result, name: str) -> float:
    return float(np.log(result.draws[name]).std())


def fit(problem: CalibrationProblem):
    return methods.run(problem, "laplace", {"starts": 1, "blocks": 1}, jax.random.key(2))


def test_the_density_of_the_readings_is_that_of_normals_with_relative_errors():
    chosen, plain = problem(tension=True), problem(tension=False)
    values = {"stiffness": 230.0, "mass": 0.12, "observation_noise": 2e-4, "tension_noise": 0.03}
    batch = {name: jnp.array([value]) for name, value in values.items()}
    rows = chosen.row_log_likelihood(batch, 15)[0][0]
    without = plain.row_log_likelihood(batch, 15)[0][0]
    read = recording().tension[:, 0]
    u = np.r_[0.0, np.linspace(0.0, 0.02, 15)[:-1]]  # a command is in force from its own row on
    least, expected = 0.05 * np.sqrt(np.mean(read**2)), 230.0 * u + 9.81 * 0.12
    size, size_read = (np.maximum(np.abs(tension), least) for tension in (expected, read))
    np.testing.assert_allclose(rows - without, stats.norm.logpdf(read, expected, 0.03 * size), rtol=1e-8)
    residuals = chosen.residuals(batch, 15)[0]
    constant = -15 * 3 * np.log(2e-4) - np.log(0.03 * size_read).sum() - 30 * np.log(2 * np.pi) + 15 * ABOVE_ZERO
    assert rows.sum() == pytest.approx(constant - 0.5 * np.sum(residuals**2), rel=1e-9)


def test_readings_that_happen_to_be_low_count_no_more_than_high_ones():
    """20000 readings of 10 %: the force that fits best scatters by 0.07 %, and would be 2 % low if errors were relative
    to what was read."""
    true, tension = 5.0, 5.0 * (1.0 + 0.1 * np.random.default_rng(4).normal(size=(1, 20000, 1)))
    channel = Tension(tension, np.ones(tension.shape, dtype=bool), cables=np.array([0]))
    force = true * np.linspace(0.97, 1.03, 121)
    values = {"tension_noise": 0.1}

    def log_density(force: float) -> float:
        observation = Observation(None, jnp.full(tension.shape, force), None, jnp.asarray(0))
        return float(channel.row_log_density(Seen(observation, values, np.zeros((1, 3))), tension).sum())

    density = [log_density(f) for f in force]
    assert force[np.argmax(density)] == pytest.approx(true, rel=0.0035)


def test_a_weighed_part_counts_once_and_in_every_prefix():
    chosen = problem(tension=False, weighed=[Weighed(("mass",), 0.13, 0.002)])
    values = {"stiffness": jnp.array([230.0]), "mass": jnp.array([0.128]), "observation_noise": jnp.array([2e-4])}
    plain = problem(tension=False)
    for horizon in (1, 15):
        gain = chosen.row_log_likelihood(values, horizon)[0].sum() - plain.row_log_likelihood(values, horizon)[0].sum()
        assert gain == pytest.approx(stats.norm.logpdf(0.128, 0.13, 0.002))
    assert chosen.fingerprint != plain.fingerprint


@pytest.mark.slow
def test_force_breaks_the_ridge():
    """Stiffness alone: free without force, to about 1 % with tension readings of 1 %. Thresholds are at twice that; a
    Laplace deviation has no randomness but that of 2000 draws."""
    assert spread(fit(problem(tension=False)), "stiffness") > 0.3
    pulled = fit(problem(tension=True))
    assert spread(pulled, "stiffness") < 0.02
    assert np.median(pulled.draws["stiffness"]) == pytest.approx(240.0, rel=0.04)
    assert np.median(pulled.draws[TENSION_NOISE.name]) == pytest.approx(0.01, rel=0.6)


@pytest.mark.slow
def test_a_balance_breaks_it_too_and_an_unknown_gain_restores_it():
    """The stiffness is then as uncertain as the weighed mass (1.5 %), or as the gain (10 %)."""
    balanced = fit(problem(tension=False, weighed=[Weighed(("mass",), 0.13, 0.002)]))
    assert spread(balanced, "stiffness") < 0.03
    unknown = fit(problem(tension=True, gain=True))
    assert spread(unknown, "stiffness") == pytest.approx(0.1, rel=0.25)


def test_what_cannot_be_used_is_refused():
    with pytest.raises(InputError, match="has no cable tensions"):
        Tension.gather(HangingMass(), [recording(tension=False)], 15)
    with pytest.raises(InputError, match="weighed but is not inferred"):
        WeighedParts((Weighed(("maas",), 0.1, 0.01),)).named([ParameterInfo("mass", "kg")])
    other = HangingMass()
    other.cable_names = ("push",)
    with pytest.raises(InputError, match="not cables of the robot"):
        Tension.gather(other, [recording()], 15)


def test_a_weighed_part_of_one_recording_goes_by_the_name_of_the_whole_where_one_piece_is_fitted():
    owners = ("a[0:99]", "b[0:9]", "b[20:29]", "")
    infos = [ParameterInfo("load", "kg", scope=Scope(owner)) for owner in owners]

    def named(name: str) -> tuple[str, ...]:
        return WeighedParts((Weighed((name,), 0.1, 0.01),)).named(infos).entries[0].parameters

    assert named("load@a") == named("load@a[0:99]") == ("load@a[0:99]",)
    assert named("load") == ("load",)
    assert named("load@b[20:29]") == ("load@b[20:29]",)
    with pytest.raises(InputError, match="several pieces"):
        named("load@b")
    with pytest.raises(InputError, match="not inferred"):
        named("load@c")


def test_a_parameter_of_the_second_recording_alone_acts_there_and_is_nominal_in_the_first():
    """The order of the recordings does not matter: whichever lacks the parameter has its nominal value."""
    simulator, first = HangingMass(), recording()
    second = Trajectory(first.dataset.assign_attrs(name="s"))
    for order in ([first, second], [second, first]):
        recordings = gather_recordings(simulator, order)
        specs = simulator.parameters + noise_specs("white")
        priors = {"stiffness": {}, "mass": {}, "observation_noise": {}}
        space = build_scopes(specs, priors, {"mass": ["s"]}, list(recordings.names))
        model = TrajectoryModel(simulator, space, recordings, (Markers.gather(recordings, "white"),))
        values = {"stiffness": jnp.asarray(200.0), "mass@s": jnp.asarray(0.4), "observation_noise": jnp.asarray(1e-4)}
        position = np.asarray(model.simulate(values).position)
        sag = dict(zip(recordings.names, np.abs(position[:, 0, 0]).max(axis=-1), strict=True))
        assert sag["s"] - sag["r"] == pytest.approx(9.81 * (0.4 - 0.1) / 200.0)
