"""Mechanisms and methods to choose from, as rows of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import BodyEffects, LayeredBody, Material
from rfdropo_bayes.fem.layered_pushing import check_effects
from rfdropo_bayes.inference.methods import METHODS
from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.mechanisms.registry import REGISTRY
from rfdropo_bayes.robots import Robot, load_robot
from rfdropo_bayes.simulators.compiled import effects_lacking
from rfdropo_bayes.simulators.mechanisms import BodyMechanism, Mechanism
from rfdropo_bayes.simulators.trunk import refined_body

Row = dict[str, str]
EXAMPLE_ROBOT = "smooth_arm"
"""Mechanisms with parameters per cable are listed for this one."""


def mechanism_rows() -> list[Row]:
    """The mechanisms of the library, in the order of the physics."""
    robot = load_robot(EXAMPLE_ROBOT)
    return [
        {"mechanism": m.name, "stage": m.stage, "runs on": where_it_runs(m, robot), "cause": m.cause}
        for m in mechanisms_named(REGISTRY, robot)
    ]


def mechanism_facts(name: str, robot: str = EXAMPLE_ROBOT) -> tuple[Row, list[Row]]:
    """What one mechanism is, and a row for each of its parameters.

    Raises:
        InputError: no such mechanism, or no such robot.
    """
    made_for = load_robot(robot)
    (mechanism,) = mechanisms_named([name], made_for, where="mechanisms")
    facts = {
        "mechanism": mechanism.name,
        "what": first_paragraph(type(mechanism).__doc__),
        "stage": mechanism.stage,
        "cause": mechanism.cause,
        "remedy": mechanism.remedy,
        "runs on": where_it_runs(mechanism, made_for),
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
    return [{"method": name, "description": first_paragraph(method.config.__doc__)} for name, method in METHODS.items()]


def where_it_runs(mechanism: Mechanism, robot: Robot) -> str:
    """Bodies and engines that simulate a mechanism, in words."""
    effects = _effects(mechanism, robot)
    if not effects.present:
        return "layers and meshes, every engine"
    words = "layers" if not effects_lacking(effects) else "layers, JAX engine"
    try:
        check_effects(effects)
    except InputError:
        return f"{words}, without a cube"
    return words


def prior_text(prior: Mapping[str, Any]) -> str:
    """A prior's table in a few characters: ``LogNormal(median 2e+06, sigma 0.5)``."""
    arguments = ", ".join(f"{name} {value:g}" for name, value in prior.items() if name != "distribution")
    return f"{prior['distribution']}({arguments})"


def first_paragraph(text: str | None) -> str:
    """The first paragraph of a docstring, in one line."""
    return " ".join((text or "").strip().split("\n\n")[0].split())


def _effects(mechanism: Mechanism, robot: Robot) -> BodyEffects:
    """Effects of the body that a mechanism switches on at its null value."""
    if not isinstance(mechanism, BodyMechanism):
        return BodyEffects()
    layers: LayeredBody = refined_body(robot.layered_arrays(), 1, 2)
    count = len(layers.station)
    nominal = robot.nominal()
    material = Material(
        young_modulus=jnp.asarray(nominal["young_modulus"]),
        poisson_ratio=jnp.asarray(nominal["poisson_ratio"]),
        density=jnp.asarray(robot.density(nominal["trunk_mass"])),
        rayleigh_mass=jnp.asarray(nominal["rayleigh_mass"]),
        rayleigh_stiffness=jnp.asarray(nominal["rayleigh_stiffness"]),
        gravity=jnp.asarray(robot.gravity),
        stiffness_scale=jnp.ones(count - 1),
        point_mass=jnp.zeros(count),
    )
    values = {spec.name: jnp.asarray(spec.nominal) for spec in mechanism.parameters}
    return mechanism.embody(values, material, layers).effects
