"""Robots and formats of recordings to choose from, as rows of text; nothing here loads JAX."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rfdropo_bayes.data.format_descriptions import FORMATS
from rfdropo_bayes.robots import Robot, find_robot_file, known_robots

if TYPE_CHECKING:
    from rfdropo_bayes.simulators.black_box import BlackBox

Row = dict[str, str]


def robot_rows() -> list[Row]:
    """The robots that come with the package."""
    rows = []
    for name in known_robots():
        robot = Robot.load(name)
        rows.append(
            {
                "robot": name,
                "drives": str(len(robot.actuators)),
                "commands": f"{len(robot.channel_names)} in {robot.command_unit}",
                "markers": str(len(robot.markers)),
                "description": robot.description,
            }
        )
    return rows


def named_robot_facts(name: str) -> Row:
    """Facts about a robot, by name or path, with the path of its file."""
    return {"file": str(find_robot_file(name)), **robot_facts(Robot.load(name))}


def robot_facts(robot: Robot) -> Row:
    """Facts about a robot."""
    body = robot.body
    across = max(max(pair) for pair in body.half_width_m)
    return {
        "robot": f"{robot.name}: {robot.description}",
        "body": f"{1e3 * (body.station_m[-1] - body.station_m[0]):.4g} mm long, up to {2e3 * across:.3g} mm wide, "
        f"{len(body.station_m) - 1} layers, {robot.nominal()['trunk_mass']:.4g} kg, "
        f"E = {robot.nominal()['young_modulus']:.4g} Pa",
        "gravity": f"{', '.join(f'{g:g}' for g in robot.gravity_m_s2)} m/s2 along x, y, z; z runs along the body, away "
        "from the clamp",
        "starts": "undeformed" if robot.initial_state == "rest" else "in equilibrium with the command before row 0",
        "commands": f"{', '.join(robot.channel_names)} ({robot.command_unit})",
        **({"cables": ", ".join(robot.cable_names)} if robot.cables else {}),
        **({"chambers": ", ".join(chamber.name for chamber in robot.chambers)} if robot.chambers else {}),
        "markers": ", ".join(f"{m.name} (z = {1e3 * m.point_m[2]:.4g} mm)" for m in robot.markers),
        "parameters": ", ".join(robot.parameters),
    }


def simulator_facts(box: BlackBox) -> Row:
    """Facts about a black-box simulator."""
    return {
        "robot": box.name,
        "engine": f"{box.engine}, steps of {1e3 * box.time_step:.4g} ms",
        "commands": f"{', '.join(box.channel_names)} ({box.command_unit})",
        "markers": ", ".join(box.marker_names),
        **({"cables": ", ".join(box.cable_names)} if box.cable_names else {}),
        **({"candidates": ", ".join(sorted(set(box.families.values())))} if box.families else {}),
    }


def format_rows() -> list[Row]:
    """The formats of recordings."""
    return [{"format": name, "description": text} for name, text in FORMATS.items()]
