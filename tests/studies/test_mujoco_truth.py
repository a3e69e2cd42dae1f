"""The arm that MuJoCo moves: it is the robot of the file, and each effect changes what its name says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.model.experiment import CommandsTable
from studies.engine_study import CLOSE, TRUTHS, as_table, run_engine_study, size_of
from studies.hidden_effects import Setting, blank_recordings
from studies.mujoco_truth import CABLE, ENGINE_EFFECTS, MuJoCoArm, arm_xml, write_arm

pytest.importorskip("mujoco")

CENTRE = TRUTHS["mujoco"].centre
WALK = CommandsTable(duration=1.0, interval=0.2, step=0.005, low=0.0, high=0.01, sample_time=0.05, recordings=["any"])


@pytest.fixture(scope="module")
def blank():
    return blank_recordings(replace(Setting(), commands=WALK), np.random.default_rng(3), ["one"], [0])


@pytest.fixture(scope="module")
def arm():
    return MuJoCoArm(rb.Robot.load("smooth_arm"), CENTRE, links=20)


def apart(arm, blank, **parameters):
    """Distance of the tips, and way of ours, root mean square [m]; ours has the servos' compliance."""
    (chain,) = arm.positions(blank, 0.0)
    fine = rb.Model("smooth_arm", simulator={"refine": 3, "time_step": 0.005}, mechanisms=["cable_compliance"])
    given = {**CENTRE, "rayleigh_mass": 0.0, "cable_compliance": 1.0 / CABLE, **parameters}
    (body,) = rb.simulate(fine, blank, parameters=given)
    tips = body.position[:, -1]
    return (np.sqrt(np.mean(np.sum(off**2, axis=1))) for off in (chain[:, -1] - tips, tips - tips[0]))


def test_two_engines_that_know_nothing_of_each_other_agree(arm, blank):
    """Rigid links and springs against a rod of finite elements, under the same cables, gravity and damping."""
    away, way = apart(arm, blank)
    assert way > 0.01
    assert away < 0.01 * way


def test_a_payload_hangs_where_ours_does(arm, blank):
    """With slack cables the arm is a cantilever, and the tip sinks by as much in both engines."""
    slack = [recording_of(blank[0], -0.03)]
    heavy = replace(arm, effect=ENGINE_EFFECTS["payload at the tip"], _seen={})
    (light,), (chain,) = arm.positions(slack, 0.0), heavy.positions(slack, 0.01)
    ours = rb.Model("smooth_arm", simulator={"refine": 3, "time_step": 0.005}, mechanisms=["payload"])
    sunk = [
        rb.simulate(ours, slack, parameters={**CENTRE, "rayleigh_mass": 0.0, "payload_mass": mass})[0].position[-1, -1]
        for mass in (0.0, 0.01)
    ]
    assert chain[-1, -1, 1] - light[-1, -1, 1] < -4e-3
    np.testing.assert_allclose(chain[-1, -1] - light[-1, -1], sunk[1] - sunk[0], rtol=0.01, atol=3e-5)


def test_the_file_moves_as_the_arm_that_is_recorded(arm, blank, tmp_path):
    """Effects stand in the file, whose actuators take displacements of cables."""
    robot = arm.robot.without_command_timing()
    write_arm(
        tmp_path / "arm.xml",
        arm_xml(robot, CENTRE, arm.links),
        {"payload at the tip": 0.01, "gain of one actuator": 0.2},
    )
    names = {name: f"site/{name}" for name in robot.marker_names}
    channels = {name: name for name in robot.channel_names}
    file = rb.MuJoCo(tmp_path / "arm.xml", markers=names, channels=channels, start="rest", command_unit="m")
    (moved,) = rb.simulate(rb.Model(file), blank)

    def both(model, size):
        for name, share in (("payload at the tip", 0.01), ("gain of one actuator", 0.2)):
            ENGINE_EFFECTS[name].model(model, share * size)

    effect = replace(ENGINE_EFFECTS["payload at the tip"], model=both)
    plain, known = (replace(arm, robot=robot, effect=effect, _seen={}).positions(blank, size)[0] for size in (0.0, 1.0))
    off = np.sqrt(np.mean(np.sum((moved.position - known)[:, -1] ** 2, axis=1)))
    assert off < 0.01 * np.sqrt(np.mean(np.sum((plain - known)[:, -1] ** 2, axis=1)))
    assert np.linalg.norm((plain - known)[:, -1], axis=1).max() > 2e-3


def recording_of(blank, level):
    """A recording of the same rows whose cables all stand at one displacement [m]."""
    dataset = blank.dataset.copy(deep=True)
    dataset["command"] = dataset["command"].copy(data=np.full(dataset["command"].shape, level))
    dataset["initial_command"] = dataset["initial_command"].copy(data=np.full(dataset["initial_command"].shape, level))
    return Trajectory(dataset)


@pytest.mark.slow
def test_twice_as_many_links_change_little(arm, blank):
    """A link's middle carries the guides in both arms; with another number of links joints would lie there."""
    (few,), (many,) = (replace(arm, links=links, _seen={}).positions(blank, 0.0) for links in (20, 40))
    assert np.sqrt(np.mean(np.sum((few - many)[:, -1] ** 2, axis=1))) < 2e-4


def test_the_arm_sags_as_a_beam_that_bends_and_shears(arm, blank):
    """Under a fiftieth of its weight, against Timoshenko's closed form; bending alone is 5 % less at marker m1."""
    gravity = 9.81 / 50.0
    light = replace(arm, robot=arm.robot.model_copy(update={"gravity_m_s2": (0.0, -gravity, 0.0)}), _seen={})
    (seen,) = light.positions([recording_of(blank[0], -0.03)], 0.0)
    shape, pieces = arm.robot.body, 4000
    ends = np.linspace(0.0, shape.station_m[-1], pieces + 1)
    length, middle = ends[1], 0.5 * (ends[1:] + ends[:-1])
    layer = np.searchsorted(shape.station_m, middle) - 1
    area, inertia, mass = (
        np.asarray(table)[layer] for table in (shape.axial_area_m2, shape.bending_moment_area_m4, shape.mass_area_m2)
    )
    weight = CENTRE["trunk_mass"] * gravity * mass / np.sum(mass)
    force = np.cumsum(weight[::-1])[::-1] - 0.5 * weight
    moment = length * (np.cumsum(force[::-1])[::-1] - 0.5 * force)
    bend = length * moment / (CENTRE["young_modulus"] * inertia[:, 0])
    slope = np.cumsum(bend) - 0.5 * bend + force / (6.0 / 7.0 * 0.5 * CENTRE["young_modulus"] * area)
    sag = np.interp([m.point_m[2] for m in arm.robot.markers], ends, np.append(0.0, np.cumsum(slope * length)))
    np.testing.assert_allclose(-seen[-1, :, 1], sag, rtol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ENGINE_EFFECTS)
def test_an_effect_of_no_size_changes_nothing_and_one_of_its_usual_size_does(arm, blank, name):
    effect = ENGINE_EFFECTS[name]
    own = replace(arm, effect=effect, _seen={})
    still = arm.positions(blank, 0.0)
    np.testing.assert_allclose(own.positions(blank, 0.0), still, atol=2e-6)
    moved = np.abs(own.positions(blank, effect.usual) - still)
    assert moved.max() > 1e-4
    if name == "site moved":
        assert moved[:, :, [0, 1, 3]].max() < 1e-12


@pytest.mark.parametrize("power", [0.6, 1.0, 1.5])
def test_a_size_is_one_at_which_the_effect_has_what_was_asked_for(power):
    size, reached = size_of(lambda size: (size / 3.0) ** power, 0.01, 0.5)
    assert reached == (size / 3.0) ** power
    assert abs(reached - 0.5) <= CLOSE * 0.5


def test_no_size_is_given_where_none_has_what_was_asked_for():
    """An effect of which a refit absorbs all but a part that does not grow never gets there."""

    def breaks(size):
        raise rb.InputError("MuJoCo warns of the motion")

    for rho_at in (lambda size: 0.4 * size / (1.0 + size), lambda size: 0.0, breaks):
        assert size_of(rho_at, 0.01, 0.5) is None


def test_a_wrong_name_is_told_the_right_ones(tmp_path):
    with pytest.raises(rb.InputError, match="soft tendons"):
        run_engine_study(tmp_path, 1, 0, effects=["soft tendon"])


def test_the_table_counts_what_is_named_described_and_explained_wrongly():
    rows = [
        {"effect": "nothing", "named": [], "named_rightly": False, "verdict": "no_discrepancy"},
        {"effect": "soft tendons", "named": ["payload"], "named_rightly": False, "verdict": "explained"},
        {"effect": "soft tendons", "named": [], "named_rightly": False, "verdict": "described"},
        {"effect": "site moved", "named": ["marker_offset"], "named_rightly": True, "verdict": "explained"},
    ]
    told = as_table(rows)
    assert "| nothing | 1 | 0 | 0 | 1 | no_discrepancy |" in told
    assert "Named rightly or described: 2 of 3 [9, 99] % (exact 95 % interval); explained by another cause: 1;" in told
