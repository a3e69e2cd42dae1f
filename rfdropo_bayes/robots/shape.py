"""Shape of a robot at rest, as plain numbers for a picture."""

from __future__ import annotations

from typing import Any

import numpy as np

from rfdropo_bayes.robots.robot import Robot


def robot_shape(robot: Robot) -> dict[str, Any]:
    """Section widths along the axis, cables from anchor to last guide, chambers from end to end, markers, and gravity.

    All in metres and the base frame: ``station`` and ``half_width`` (x, y) of the body, ``cables``, with
    the chambers, and ``markers`` as points by name, ``gravity`` in m/s2.
    """
    cables = {cable.name: np.vstack([cable.anchor()[None], cable.guides()]).tolist() for cable in robot.cables}
    cables |= {chamber.name: chamber.ends().tolist() for chamber in robot.chambers}
    return {
        "station": list(robot.body.station_m),
        "half_width": np.asarray(robot.body.half_width_m).tolist(),
        "cables": cables,
        "markers": dict(zip(robot.marker_names, robot.marker_points().tolist(), strict=True)),
        "gravity": robot.gravity.tolist(),
    }
