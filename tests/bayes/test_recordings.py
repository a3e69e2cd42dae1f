"""Recordings on a simulator's clock."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot


@pytest.mark.parametrize(
    ("unit", "settings", "message"),
    [
        ("m", {}, None),
        ("rad", {}, "recording has commands in rad, the robot in m"),
        ("m", {"mode": "shadow"}, "the recording is of a shadow session, in which no drive moved"),
    ],
)
def test_commands_in_another_unit_or_that_nothing_followed_are_refused(
    unit: str, settings: dict[str, bool], message: str | None
) -> None:
    simulator = build_simulator(ModelSpec(Robot.load("smooth_arm")))
    channels, time = len(simulator.channel_names), 0.05 * np.arange(6)
    trajectory = Trajectory.build(
        Origin(name="r", robot="smooth_arm", format="csv", settings=settings),
        SentCommands(
            command_time=time,
            command=np.zeros((6, channels)),
            command_unit=unit,
            cable_names=[f"u{k}" for k in range(channels)],
        ),
        Measured(
            time=time, position=np.tile(simulator.robot.marker_points(), (6, 1, 1)), marker_names=simulator.marker_names
        ),
    )
    if message is None:
        assert gather_recordings(simulator, [trajectory]).names == ("r",)
    else:
        with pytest.raises(InputError, match=message):
            gather_recordings(simulator, [trajectory])
