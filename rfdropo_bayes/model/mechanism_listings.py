"""Mechanisms and methods to choose from, as rows of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rfdropo_bayes.data.mapped_formats import FORMATS
from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.mechanisms.registry import REGISTRY
from rfdropo_bayes.robots import Robot, find_robot_file, known_robots
from rfdropo_bayes.simulators.mechanisms import BODIES, ENGINES, Mechanism, bodies_of, engines_of

if TYPE_CHECKING:
    from rfdropo_bayes.simulators.black_box import BlackBox

Row = dict[str, str]
EXAMPLE_ROBOT = "smooth_arm"  # robot for which mechanisms with parameters per cable are listed


def mechanism_rows() -> list[Row]:
    """The mechanisms of the library, in the order of the physics."""
    robot = Robot.load(EXAMPLE_ROBOT)
    return [
        {"mechanism": m.name, "stage": m.stage, "runs on": where_it_runs(m), "cause": m.cause}
        for m in mechanisms_named(REGISTRY, robot)
    ]


def mechanism_facts(name: str) -> tuple[Row, list[Row]]:
    """Facts about a mechanism, and a row for each of its parameters on the example robot.

    Raises:
        InputError: no such mechanism.
    """
    (mechanism,) = mechanisms_named([name], Robot.load(EXAMPLE_ROBOT), where="mechanisms")
    facts = {
        "mechanism": mechanism.name,
        "what": first_paragraph(type(mechanism).__doc__),
        "stage": mechanism.stage,
        "cause": mechanism.cause,
        "remedy": mechanism.remedy,
        "runs on": where_it_runs(mechanism),
    }
    return facts, [
        {
            "parameter": spec.name,
            "unit": spec.unit,
            "null": f"{spec.nominal:g}",
            "bounds": f"{spec.low:g} to {spec.high:g}",
            "prior": prior_text(spec.prior),
            "meaning": spec.description + _tried(spec.grid),
        }
        for spec in mechanism.parameters
    ]


def _tried(grid: Sequence[float]) -> str:
    return f" (tried at {', '.join(f'{value:g}' for value in grid)})" if grid else ""


def method_rows() -> list[Row]:
    """The methods of inference."""
    from rfdropo_bayes.inference.methods import METHODS  # loads ArviZ, which a list of mechanisms needs not wait for

    return [{"method": name, "description": first_paragraph(method.config.__doc__)} for name, method in METHODS.items()]


def where_it_runs(mechanism: Mechanism) -> str:
    """Bodies and engines that simulate a mechanism, in words."""
    bodies, engines = bodies_of(mechanism), engines_of(mechanism)
    words = "every body" if set(bodies) == set(BODIES) else f"{' and '.join(bodies)} bodies"
    return words + (", every engine" if set(engines) == set(ENGINES) else f", engine {' or '.join(engines)}")


def prior_text(prior: Mapping[str, Any]) -> str:
    """A prior's table in a few characters: ``LogNormal(median 2e+06, sigma 0.5)``."""
    arguments = ", ".join(f"{name} {value:g}" for name, value in prior.items() if name != "distribution")
    return f"{prior['distribution']}({arguments})"


def first_paragraph(text: str | None) -> str:
    """The first paragraph of a docstring, in one line."""
    return " ".join((text or "").strip().split("\n\n")[0].split())


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
