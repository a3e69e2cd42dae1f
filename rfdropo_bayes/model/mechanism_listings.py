"""Mechanisms and methods to choose from, as rows of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.mechanisms.registry import REGISTRY
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import BODIES, ENGINES, Mechanism, bodies_of, engines_of

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
