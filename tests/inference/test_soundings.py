"""Kinks and plateaus: where derivatives mislead, the density itself is followed."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from rfdropo_bayes.bayes.units import force_power
from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.evaluations import Ledger
from rfdropo_bayes.inference.modes.climb import Laplace, init, laplace, maximise
from rfdropo_bayes.inference.modes.climbs import RIVAL
from rfdropo_bayes.inference.modes.plateaus import Held, climbs_from, plateaus
from rfdropo_bayes.inference.modes.search import LaplaceConfig, Modes, find_modes
from rfdropo_bayes.inference.modes.targets import make_target, prior_derivatives
from rfdropo_bayes.inference.smc.bridge import BridgeConfig, sample_from_modes
from rfdropo_bayes.inference.smc.mixture import NARROWEST
from rfdropo_bayes.inference.smc.soundings import Sounding, sounded
from rfdropo_bayes.inference.smc.straight import StraightProblem

from .toys import Crooked, LinearGaussian, Ratio, Stuck

KEY = jax.random.key(12)


class Seen(NamedTuple):
    """An optimum with what found it."""

    problem: object
    target: object
    mode: Laplace
    ledger: Ledger


def climbed(problem, start) -> Seen:
    ledger = Ledger()
    noise = np.zeros(len(problem.names), dtype=bool)
    target = make_target(problem, problem.n_rows, ledger, np.array(start), prior_derivatives(problem), "central", noise)
    state, _ = maximise(target, np.array(start), max_steps=60, tolerance=1e-6)
    return Seen(problem, target, laplace(target, state), ledger)


def look(seen: Seen) -> Sounding:
    none = np.zeros(len(seen.problem.names), dtype=bool)
    return Sounding(seen.problem, none, none, Ledger())


def test_a_normal_posterior_is_left_as_it_is():
    problem = LinearGaussian(n_rows=20, d=4)
    seen = climbed(problem, problem.mean)
    sounding = look(seen)
    assert len(sounded(sounding, [seen.mode], KEY, 300.0)) == 1
    assert sounding.ledger.rollouts == 1 + 4 * 4


def test_a_ridge_that_ends_at_bounds_is_left_as_it_is():
    """What the prior cuts off says nothing against the model of the likelihood, and is not simulated."""
    problem = Ratio()
    seen = climbed(problem, np.zeros(2))
    straight = StraightProblem(problem, KEY)
    sounding = Sounding(straight, straight.logarithmic, np.zeros(2, dtype=bool), Ledger())
    mode = straight.mode(seen.mode)
    assert len(sounded(sounding, [mode], KEY, np.inf)) == 1
    assert sounding.ledger.rollouts < 1 + 4 * 2


def test_the_widths_on_both_sides_of_a_kink_are_found():
    problem = Crooked()
    seen = climbed(problem, np.array([0.3, 0.2]))
    first, found = sounded(look(seen), [seen.mode], KEY, 300.0)
    assert first is seen.mode
    turn = np.asarray(problem.turn)
    centre, deviation = turn @ found.mean, np.sqrt(np.diag(turn @ found.covariance @ turn.T))
    # Two nats below the top on either side. Axes are those of derivatives, not quite those of the kink.
    np.testing.assert_allclose(deviation, 0.5 * (problem.right + problem.left), rtol=0.15)
    assert centre[0] - 2.0 * deviation[0] == pytest.approx(-0.8, rel=0.2)
    assert abs(centre[1]) < 0.1


def test_a_cliff_between_wide_shelves_leaves_a_covariance():
    """Followed along axes that derivatives had too wide and too narrow, deviations are 1e9 apart: more than the square
    of a double holds."""
    problem = Crooked(right=(1e-12, 100.0), left=(1e-12, 100.0))
    turn = np.asarray(problem.turn)
    information = turn.T @ np.diag([1e14, 10.0]) @ turn
    mode = Laplace(np.zeros(2), np.linalg.inv(information), 0.0, information, np.zeros(2))
    none = np.zeros(2, dtype=bool)
    _, found = sounded(Sounding(problem, none, none, Ledger()), [mode], KEY, np.inf)
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(found.covariance), 0.0))
    assert spread[1] == pytest.approx(5.0, rel=0.2)
    assert spread[0] >= 0.9 * NARROWEST * spread[1]


def test_the_evidence_of_a_kinked_posterior_is_exact():
    """The mean of 4 replicates of 250 scatters by 0.03; the threshold is five times that."""
    problem = Crooked()
    result = methods.run(problem, "bridge", {"particles": 250, "replicates": 4}, KEY)
    assert result.log_evidence[0] == pytest.approx(problem.log_evidence(), abs=0.15)


@pytest.mark.parametrize("rollouts", [5.0, 30.0, 60.0, 250.0, 1000.0])
def test_soundings_keep_to_their_budget(rollouts):
    seen = climbed(Crooked(), np.array([0.3, 0.2]))
    sounding = look(seen)
    modes = sounded(sounding, [seen.mode] * 50, KEY, rollouts)
    assert sounding.ledger.rollouts <= rollouts
    assert 50 + (rollouts >= 60.0) <= len(modes) < 100


@pytest.mark.parametrize("rollouts", [1000, 1010, 1200])
def test_soundings_leave_the_sampler_what_it_needs(rollouts):
    """At least two rollouts a particle: with less it would refuse to start."""
    for problem in (LinearGaussian(n_rows=20, d=4), Crooked()):
        result = methods.run(problem, "bridge", {"particles": 250, "replicates": 2, "rollouts": rollouts}, KEY)
        assert result.details["sounding_rollouts"] <= rollouts - 1000


class Aside(Crooked):
    """Two modes: the right one with a kink, wide, holds most of the mass; the left one, narrow, is higher."""

    def _parts(self, u):
        wide = jnp.where(u[..., 0] > 0.0, (u[..., 0] - 1.0) / jnp.where(u[..., 0] > 1.0, 0.5, 0.1), 60.0)
        narrow = jnp.where(u[..., 0] > 0.0, 60.0, (u[..., 0] + 1.0) / 0.02)
        first = jnp.where(u[..., 0] > 0.0, jnp.sqrt(wide**2 + 4.0), narrow)
        return jnp.stack([first, u[..., 1] / 0.3], axis=-1)

    def by_quadrature(self):
        """Log evidence, and the share of the right mode."""
        x = np.linspace(-3.0, 8.0, 220001)
        first = np.asarray(self._parts(jnp.stack([jnp.array(x), jnp.zeros_like(x)], axis=-1)))[:, 0]
        density = np.exp(-0.5 * first**2) * norm.pdf(x, 0.0, 5.0)
        right = x > 0.0
        parts = [np.trapezoid(density[side], x[side]) for side in (right, ~right)]
        other = norm.pdf(0.0, 0.0, np.hypot(0.3, 5.0)) * np.sqrt(2.0 * np.pi) * 0.3
        return float(np.log(sum(parts) * other)), float(parts[0] / sum(parts))


def test_a_mode_that_soundings_leave_for_another_keeps_its_mass():
    """Replicates of 250 have a share of the right mode that scatters by 0.03, and evidences that scatter by 0.1."""
    problem = Aside()
    evidence, share = problem.by_quadrature()
    modes = [climbed(problem, np.array(start)).mode for start in ([1.2, 0.1], [-0.99, 0.1])]
    climbs = find_modes(problem, LaplaceConfig(starts=1), KEY).climbs
    result = sample_from_modes(problem, BridgeConfig(particles=250, replicates=4), Modes(modes, climbs, []), KEY)
    assert result.details["sounded"] >= 1
    assert result.log_evidence[0] == pytest.approx(evidence, abs=0.2)
    assert np.mean(result.draws["x0"] > 0.0) == pytest.approx(share, abs=0.1)


class Weighed(Ratio):
    """The ratio of a stiffness and a mass, by data with a kink: derivatives across it have both determined."""

    def __init__(self, unit: str = "kg") -> None:
        super().__init__()
        self.units = {"stiffness": "Pa" if unit == "kg" else "1", "mass": unit}

    def _row_density(self, u, horizon):
        values = self.from_unconstrained(u)
        return (
            -0.5
            * jax.vmap(lambda s, m: self.residuals({"stiffness": s, "mass": m}, horizon))(
                values["stiffness"], values["mass"]
            )
            ** 2
        )

    def residuals(self, values, horizon):
        away = jnp.log(values["stiffness"] / values["mass"]) - jnp.log(4.0)
        return jnp.where(away > 0.0, 10.0, 300.0) * away * self.gain[:horizon]


@pytest.mark.parametrize(("unit", "free"), [("kg", True), ("1", False)])
def test_a_common_scale_that_data_leave_free_is_as_wide_as_the_prior(unit, free):
    """The mode's information says otherwise, as differences across kinks do; only units tell where to look."""
    problem = Weighed(unit)
    straight = StraightProblem(problem, KEY)
    top = np.log([[2.8, 0.7]])
    information = np.array([[4e4, -3e4], [-3e4, 9e4]])
    density = float(np.asarray(straight.log_prior(top))[0])
    mode = Laplace(top[0], np.linalg.inv(information), density, information, np.zeros(2))
    sounding = Sounding(straight, straight.logarithmic, np.zeros(2, dtype=bool), Ledger())
    found = sounded(sounding, [mode], KEY, np.inf)[-1]
    along = np.array([1.0, 1.0]) / np.sqrt(2.0)
    deviation = np.sqrt(along @ found.covariance @ along)
    # From 2 to 4 of stiffness, where the mass ends: the logarithm of 2, times the root of 2, by four deviations.
    assert (deviation > 0.15) == free


def test_a_plateau_beside_a_summit_is_found():
    problem = Stuck()
    seen = climbed(problem, np.array([1.0, 0.7]))
    assert seen.mode.mean[1] == pytest.approx(0.974, abs=2e-3)
    found = plateaus(seen.target, seen.mode, problem.sd, RIVAL)
    assert [plateau.coordinate for plateau in found] == [1]
    assert found[0].point[1] > problem.edge
    before = seen.ledger.rollouts
    (end,) = climbs_from(seen.target, found, 1e-6, 500.0)
    assert seen.ledger.rollouts - before <= 500.0
    assert end.position[1] == found[0].point[1]
    # Least squares of the pull alone, its prior being wide.
    design = problem.design[:, 0]
    assert end.position[0] == pytest.approx(design @ problem.data / (design @ design), abs=1e-3)


def test_without_a_budget_a_plateau_is_where_it_was_found():
    problem = Stuck()
    seen = climbed(problem, np.array([1.0, 0.7]))
    found = plateaus(seen.target, seen.mode, problem.sd, RIVAL)
    (end,) = climbs_from(seen.target, found, 1e-6, 0.0)
    np.testing.assert_array_equal(end.position, found[0].point)


@pytest.mark.parametrize("start", [0.3, 2.0])
def test_a_posterior_without_plateaus_has_none(start):
    problem = LinearGaussian(n_rows=20, d=3)
    seen = climbed(problem, start * problem.mean)
    assert plateaus(seen.target, seen.mode, problem.sd, RIVAL) == []


def test_what_is_flat_as_far_as_derivatives_say_is_no_plateau():
    """A direction that only the prior limits: the normal approximation has it."""
    problem = LinearGaussian(n_rows=20, d=3)
    problem.design[:, 2] = 0.0
    seen = climbed(problem, problem.mean)
    assert plateaus(seen.target, seen.mode, problem.sd, RIVAL) == []


def test_the_plateau_and_the_summit_beside_it_keep_their_shares():
    """The survey of this key leads to the summit alone, which without plateaus has all the particles. 4 replicates: the
    evidence's mean scatters by 0.03, the share by 0.04."""
    problem = Stuck()
    evidence, share = problem.by_quadrature()
    found = find_modes(problem, LaplaceConfig(starts=2, survey=64, rollouts=4000.0), jax.random.key(15))
    held = [row for row in found.climbs.trace if "plateau" in row]
    assert [row["plateau"] for row in held] == [1]
    assert found.climbs.positions[:, 1].max() < problem.edge
    result = sample_from_modes(problem, BridgeConfig(particles=250, replicates=4), found, KEY)
    assert result.log_evidence[0] == pytest.approx(evidence, abs=0.15)
    assert np.mean(result.draws["weight"] > problem.edge) == pytest.approx(share, abs=0.15)


def test_a_slope_is_no_plateau():
    """Behind a kink the likelihood falls more slowly, but falls: nine nats and more from one reach to the next."""
    problem = Crooked(right=(0.02, 0.3), left=(0.1, 0.3))
    problem.turn = jnp.eye(2)
    seen = climbed(problem, np.array([0.01, 0.2]))
    assert plateaus(seen.target, seen.mode, problem.sd, RIVAL) == []


def test_a_held_coordinate_has_no_gradient():
    problem = LinearGaussian(n_rows=20, d=3)
    seen = climbed(problem, problem.mean)
    gradient, curvature = Held(seen.target, 1).quadratic(problem.mean)
    whole = seen.target.quadratic(problem.mean)
    assert gradient[1] == 0.0
    np.testing.assert_array_equal(gradient[[0, 2]], whole[0][[0, 2]])
    np.testing.assert_array_equal(curvature[np.ix_([0, 2], [0, 2])], whole[1][np.ix_([0, 2], [0, 2])])
    assert np.count_nonzero(curvature[1]) == 1
    assert init(Held(seen.target, 1), problem.mean).log_density == init(seen.target, problem.mean).log_density


def test_where_all_coordinates_are_noise_there_is_nothing_to_look_for():
    problem = LinearGaussian(n_rows=20, d=2)
    seen = climbed(problem, problem.mean)
    assert plateaus(seen.target._replace(noise=np.ones(2, dtype=bool)), seen.mode, problem.sd, RIVAL) == []
    sounding = look(seen)._replace(noise=np.ones(2, dtype=bool))
    assert len(sounded(sounding, [seen.mode], KEY, np.inf)) == 1
    assert sounding.ledger.rollouts == 0


POWERS = {
    1: ("kg", "Pa", "N/m", "N m", "Pa s", "kg/m3", "N/m2", "J"),
    -1: ("1/Pa", "m/N"),
    0: ("N/kg", "m/s", "rad", "-"),
}


@pytest.mark.parametrize(("unit", "power"), [(unit, power) for power, units in POWERS.items() for unit in units])
def test_the_power_of_a_force_in_a_unit(unit, power):
    assert force_power(unit) == power
