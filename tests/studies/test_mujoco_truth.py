"""The arm that MuJoCo moves: it is the robot of the file, and each effect changes what its name says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import rfdropo_bayes as rb
from rfdropo_bayes.model.experiment import CommandsTable
from rfdropo_bayes.studies.engine_study import CENTRE, CLOSE, as_table, run_engine_study, size_of
from rfdropo_bayes.studies.hidden_effects import Setting, blank_recordings
from rfdropo_bayes.studies.mujoco_truth import ENGINE_EFFECTS, MuJoCoArm

pytest.importorskip("mujoco")

WALK = CommandsTable(duration=1.0, interval=0.2, step=0.005, low=0.0, high=0.01, sample_time=0.05, recordings=["any"])


@pytest.fixture(scope="module")
def blank():
    return blank_recordings(replace(Setting(), commands=WALK), np.random.default_rng(3), ["one"], [0])


@pytest.fixture(scope="module")
def arm():
    return MuJoCoArm(rb.Robot.load("smooth_arm"), CENTRE)


def test_two_engines_that_know_nothing_of_each_other_agree(arm, blank):
    """Rigid links and springs against a layered body of finite elements, under the same cables, gravity and damping."""
    (chain,) = arm.positions(blank, 0.0)
    fine = rb.Model("smooth_arm", simulator={"refine": 3, "time_step": 0.005})
    (body,) = rb.simulate(fine, blank, parameters={**CENTRE, "rayleigh_mass": 0.0})
    way = np.linalg.norm(body.position[:, -1] - body.position[0, -1], axis=1)
    apart = np.linalg.norm(chain[:, -1] - body.position[:, -1], axis=1)
    assert np.sqrt(np.mean(way**2)) > 0.01
    assert np.sqrt(np.mean(apart**2)) < 0.03 * np.sqrt(np.mean(way**2))


def test_more_links_change_little(arm, blank):
    (few,), (many,) = (replace(arm, links=links, _seen={}).positions(blank, 0.0) for links in (20, 30))
    assert np.sqrt(np.mean(np.sum((few - many)[:, -1] ** 2, axis=1))) < 2e-4


@pytest.mark.parametrize("name", ENGINE_EFFECTS)
def test_an_effect_of_no_size_changes_nothing_and_one_of_its_usual_size_does(arm, blank, name):
    effect = ENGINE_EFFECTS[name]
    own = replace(arm, effect=effect, _seen={})
    still = arm.positions(blank, 0.0)
    np.testing.assert_allclose(own.positions(blank, 1e-9), still, atol=2e-6)
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
