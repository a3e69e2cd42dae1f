"""The rod that PyElastica moves: it is the robot of the file, and cables act on it as on the other engines' arms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_bvp

import rfdropo_bayes as rb
from rfdropo_bayes.model.experiment import CommandsTable
from rfdropo_bayes.studies.engine_study import TRUTHS
from rfdropo_bayes.studies.hidden_effects import Setting, blank_recordings
from rfdropo_bayes.studies.mujoco_truth import CABLE
from rfdropo_bayes.studies.pyelastica_truth import ElasticaArm

from .test_mujoco_truth import recording_of

pytest.importorskip("elastica")

HELD = CommandsTable(duration=0.8, interval=0.2, step=0.005, low=0.0, high=0.01, sample_time=0.05, recordings=["any"])
VALUES = {**TRUTHS["pyelastica"].centre, "rayleigh_mass": 25.0}  # it comes to rest within the recording
ROBOT = rb.Robot.load("smooth_arm")


def tip_under(level, robot=ROBOT, payload=0.0):
    """Where the tip [m] comes to rest with all cables at one displacement."""
    blank = blank_recordings(replace(Setting(), commands=HELD), np.random.default_rng(3), ["one"], [0])
    effect = TRUTHS["pyelastica"].effects["payload at the tip"]
    (path,) = ElasticaArm(robot, VALUES, effect).positions([recording_of(blank[0], level)], payload)
    return path[-1, -1]


def cantilever(payload):
    """The same of an elastica with the robot's sections under its own weight."""
    body, modulus = ROBOT.body, VALUES["young_modulus"]
    station, area = np.asarray(body.station_m), np.asarray(body.mass_area_m2)
    moment, middle = np.asarray(body.bending_moment_area_m4)[:, 0], 0.5 * (station[1:] + station[:-1])
    weight = np.append(0.0, np.cumsum(area * np.diff(station)))
    weight = 9.81 * (VALUES["trunk_mass"] * weight / weight[-1])

    def slope(s, y):
        beyond = weight[-1] - np.interp(s, station, weight) + 9.81 * payload
        return np.stack(
            [y[1] / (modulus * np.interp(s, middle, moment)), beyond * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]
        )

    along = np.linspace(0.0, station[-1], 201)
    found = solve_bvp(slope, lambda a, b: np.array([a[0], b[1], a[2], a[3]]), along, np.zeros((4, 201)))
    return found.sol(station[-1])[[3, 2]]


@pytest.mark.parametrize("payload", [0.0, 0.01])
def test_with_slack_cables_it_sags_as_an_elastica(payload):
    np.testing.assert_allclose(tip_under(-0.03, payload=payload)[1:], cantilever(payload), atol=5e-5)


def test_four_equal_pulls_shorten_it_by_what_the_servos_do_not_give():
    pull, free = 3e-3, ROBOT.model_copy(update={"gravity_m_s2": (0.0, 0.0, 0.0)})
    lengths = np.diff(ROBOT.body.station_m)
    give = np.sum(lengths / (VALUES["young_modulus"] * np.asarray(ROBOT.body.axial_area_m2)))
    shorter = pull / (1.0 + 1.0 / (4.0 * CABLE * give))
    np.testing.assert_allclose(tip_under(pull, free), [0.0, 0.0, lengths.sum() - shorter], atol=2e-5)
