"""The rod that PyElastica moves: it is the robot of the file, and cables act on it as on the other engines' arms."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes import fem
from rfdropo_bayes.fem.effects import BodyEffects
from rfdropo_bayes.fem.native.rod_engine import NativeRod
from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.experiment import CommandsTable, SimulatorTable
from rfdropo_bayes.model.model_spec import ModelSpec
from studies.engine_study import TRUTHS
from studies.hidden_effects import Setting, blank_recordings
from studies.mujoco_truth import CABLE, CONTROL
from studies.pyelastica_truth import ElasticaArm

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


def cantilever(payload, pieces=4000):
    """The same of a beam that bends, stretches and shears by any amount (Reissner 1972), under its own weight."""
    body, modulus = ROBOT.body, VALUES["young_modulus"]
    ends = np.linspace(0.0, body.station_m[-1], pieces + 1)
    length = ends[1]
    layer = np.searchsorted(body.station_m, 0.5 * (ends[1:] + ends[:-1])) - 1  # each is uniform
    section = modulus * np.asarray(body.axial_area_m2)[layer]
    moment = modulus * np.asarray(body.bending_moment_area_m4)[layer, 0]
    mass = np.asarray(body.mass_area_m2)[layer]
    weight = 9.81 * VALUES["trunk_mass"] * mass / np.sum(mass)
    beyond = np.cumsum(weight[::-1])[::-1] - 0.5 * weight + 9.81 * payload
    slope = np.zeros(pieces)
    for _ in range(50):
        stretched = 1.0 - beyond * np.sin(slope) / section
        sheared = -beyond * np.cos(slope) / (6.0 / 7.0 * 0.5 * section)  # Cowper, for a round one
        along = stretched * np.cos(slope) - sheared * np.sin(slope)
        pull = beyond * along
        bend = -(np.cumsum(pull[::-1])[::-1] - 0.5 * pull) * length**2 / moment
        slope = np.cumsum(bend) - 0.5 * bend
    aside = stretched * np.sin(slope) + sheared * np.cos(slope)
    return np.array([np.sum(aside), np.sum(along)]) * length


@pytest.mark.parametrize("payload", [0.0, 0.01])
def test_with_slack_cables_it_sags_as_a_beam_that_bends_and_shears(payload):
    np.testing.assert_allclose(tip_under(-0.03, payload=payload)[1:], cantilever(payload), atol=5e-5)


def test_four_equal_pulls_shorten_it_by_what_the_servos_do_not_give():
    pull, free = 3e-3, ROBOT.model_copy(update={"gravity_m_s2": (0.0, 0.0, 0.0)})
    lengths = np.diff(ROBOT.body.station_m)
    give = np.sum(lengths / (VALUES["young_modulus"] * np.asarray(ROBOT.body.axial_area_m2)))
    shorter = pull / (1.0 + 1.0 / (4.0 * CABLE * give))
    np.testing.assert_allclose(tip_under(pull, free), [0.0, 0.0, lengths.sum() - shorter], atol=2e-5)


def at_rest(level):
    """The tip [m] by the package's rod under the same cables, with four elements for each of the robot's own."""
    settings = SimulatorTable(engine="numba", threads=1, refine=4)
    assembly = build_simulator(ModelSpec(ROBOT, simulator=settings)).assembly
    body = assembly.system.body
    material = fem.material(
        assembly.system,
        young_modulus=VALUES["young_modulus"],
        poisson_ratio=0.0,
        density=VALUES["trunk_mass"] / np.sum(np.diff(body.station) * body.mass_area),
        gravity=ROBOT.gravity_m_s2,
    )
    material = material._replace(effects=BodyEffects(cable_compliance=1.0 / CABLE))
    engine = NativeRod(assembly.system, assembly.markers, 0.01, threads=1, integrator="quasi-static")
    return engine.rollout(jax.tree.map(lambda part: np.asarray(part)[None], material), level[None, None]).position[
        0, -1
    ]


@pytest.mark.slow
@pytest.mark.parametrize("level", [(0.012, -0.03, -0.03, -0.03), (0.02, -0.03, -0.03, 0.006)])
def test_one_and_two_pulls_bend_it_as_the_rod_of_the_package(level):
    """Within .1 % of the tip's displacement."""
    periods = round(1.2 / CONTROL)
    held = np.array(level) * np.minimum(np.arange(periods) / (0.5 * periods), 1.0)[:, None]
    tip = ElasticaArm(ROBOT, VALUES, TRUTHS["pyelastica"].effects["payload at the tip"])._path(held, 0.0)[-1, -1]
    expected = at_rest(np.array(level))[-1]
    way = np.linalg.norm(expected - [0.0, 0.0, ROBOT.body.station_m[-1]])
    assert np.linalg.norm(tip - expected) < 1e-3 * way
