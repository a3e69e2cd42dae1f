"""Effects that the library lacks: where they act on robots of several cables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from rfdropo_bayes.mechanisms.ports import port_map
from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.robots import Robot
from studies.hidden_effects import Setting, experiment_tables
from studies.unknown_effects import EFFECTS, EffectSimulator, Scene


def simulator_of(name: str):
    return build_simulator(spec_of(experiment_tables(replace(Setting(), robot=name)), Path()))


@pytest.mark.parametrize("name", ["smooth_arm", "trunk_sofa"])
def test_effects_act_at_ports_that_a_robot_has(name):
    robot = Robot.load(name)
    known = {port.name for port in port_map(simulator_of(name), robot.marker_names).ports}
    for effect in EFFECTS.values():
        assert set(effect.ports_of(robot)) <= known


@pytest.mark.parametrize(("effect", "cable"), [("bouc_wen", 0), ("crosstalk", 1), ("one_lagging_cable", 2)])
def test_an_effect_of_one_cable_moves_the_trunk_as_that_cable_does(effect, cable):
    simulator, robot = simulator_of("trunk_sofa"), Robot.load("trunk_sofa")
    assert EFFECTS[effect].ports_of(robot) == (f"cable {robot.channel_names[cable]}",)
    time = 0.05 * np.arange(8)
    levels = 1e-3 * np.outer(np.arange(8), [1, 1, 1, 0, 0, 0, 0, 0])
    scene = Scene(jnp.asarray(levels), jnp.zeros((8, 3)), jnp.asarray(time))
    acted = EFFECTS[effect].acts(1.0, scene)["command"]
    assert acted.shape == levels.shape
    assert np.flatnonzero(np.abs(acted).max(axis=0)).tolist() == [cable]
    commands = simulator.commands(time, levels, np.zeros(8), time)
    own = EffectSimulator(simulator, EFFECTS[effect], {})
    batch = type(commands)(*(None if part is None else np.asarray(part)[None] for part in commands))
    moved = own.positions(batch, 1.0) - own.positions(batch, 0.0)
    assert np.abs(moved).max() > 1e-5
