"""First table of an experiment with a MuJoCo model: elements of markers, commands and parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.adapters.mujoco_elements import ATTRIBUTES, element_names, field_of, places_of, plain_name

INFERRED = (
    ("body", "mass"),
    ("joint", "stiffness"),
    ("joint", "damping"),
    ("tendon", "stiffness"),
    ("tendon", "damping"),
)
"""Quantities inferred by default, each as a factor on all elements."""


def adapter_tables(
    model: Any, markers: Mapping[str, Float[np.ndarray, "3"] | None], channels: Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    """The table [adapter] of a first experiment, and its assumptions, in words.

    A marker is the site, body or geom of its name; else the site nearest to its first seen position in the model's
    reference pose, or the nearest body if no site remains.

    Args:
        model: MjModel.
        markers: names of measured markers, and their first seen positions [m].
        channels: names of the commands.

    Raises:
        InputError: more commands than the model has actuators, or more markers than elements.
    """
    placed, assumed = _markers(model, markers)
    sent, more = _channels(model, channels)
    table: dict[str, Any] = {"markers": placed, "channels": sent, "parameters": {}}
    for kind, attribute in INFERRED:
        numbers = range(len(element_names(model, kind)))
        places = [places_of(model, kind, k, ATTRIBUTES[kind][attribute])[0] for k in numbers]
        if any(np.any(field_of(model, place.field)[place.entries]) for place in places):
            table["parameters"][f"{kind}_{attribute}"] = f"{kind}/*/{attribute}"
    return table, assumed + more


def _markers(model: Any, markers: Mapping[str, np.ndarray | None]) -> tuple[dict[str, str], list[str]]:
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    places = {"site": data.site_xpos, "body": data.xpos, "geom": data.geom_xpos}
    named = {(kind, name): k for kind in places for k, name in enumerate(element_names(model, kind))}
    if not markers:
        return _all_markers(model, named)
    elements: dict[str, str] = {}
    for marker in markers:
        for kind, name in named:
            if plain_name(name).lower() == plain_name(marker).lower() and marker not in elements:
                elements[marker] = f"{kind}/{name}"
    unnamed = [marker for marker in markers if marker not in elements]
    free = [key for key in named if key[0] in ("site", "body") and f"{key[0]}/{key[1]}" not in elements.values()]
    free = [key for key in free if key != ("body", "world") and not key[1].isdigit()]
    sites = [key for key in free if key[0] == "site"]
    chosen = sites if len(sites) >= len(unnamed) else free
    if len(chosen) < len(unnamed):
        raise InputError(
            f"{len(unnamed)} markers ({', '.join(unnamed)}) for {len(chosen)} named sites and bodies",
            where="--recording",
            remedy="name sites in the model's file",
        )
    assumed = []
    if unnamed:
        seen = [markers[marker] for marker in unnamed]
        at = np.stack([places[kind][named[kind, name]] for kind, name in chosen])
        far = np.stack([np.linalg.norm(at - (0.0 if place is None else place), axis=1) for place in seen])
        for row, column in zip(*linear_sum_assignment(far), strict=True):
            kind, name = chosen[column]
            elements[unnamed[row]] = f"{kind}/{name}"
            assumed.append(
                f"marker {unnamed[row]} is the {kind} {name}, {1e3 * far[row, column]:.3g} mm from its first row"
            )
    return {marker: elements[marker] for marker in markers}, assumed


def _all_markers(model: Any, named: Mapping[tuple[str, str], int]) -> tuple[dict[str, str], list[str]]:
    """All sites, or else all moving bodies, as markers without a recording."""
    sites = [name for kind, name in named if kind == "site" and not name.isdigit()]
    if sites:
        return {name: f"site/{name}" for name in sites}, []
    bodies = [
        name
        for (kind, name), k in named.items()
        if kind == "body" and not name.isdigit() and int(model.body_weldid[k]) != 0
    ]
    if not bodies:
        raise InputError(
            "no site and no moving body has a name", where="markers", remedy="name sites in the model's file"
        )
    assumption = f"markers are all bodies that move, {', '.join(bodies)}: keep the measured bodies"
    return {name: f"body/{name}" for name in bodies}, [assumption]


def _channels(model: Any, channels: Sequence[str]) -> tuple[dict[str, str | int], list[str]]:
    names = element_names(model, "actuator")
    if not channels:
        return {name if not name.isdigit() else f"actuator_{name}": _numbered(name) for name in names}, []
    if len(channels) > len(names):
        raise InputError(
            f"{len(channels)} commands ({', '.join(channels)}) for {len(names)} actuators ({', '.join(names)})",
            where="--recording",
            remedy="leave columns that are no commands out of the file, or add actuators to the model",
        )
    alike = {plain_name(name).lower(): name for name in names}
    own = [alike.get(plain_name(channel).lower()) for channel in channels]
    if all(own):
        return dict(zip(channels, map(_numbered, own), strict=True)), []
    said = [f"commands belong to the first actuators, in order: {', '.join(names[: len(channels)])}"]
    return dict(zip(channels, map(_numbered, names), strict=False)), said


def _numbered(name: Any) -> str | int:
    """The number of an element without a name, otherwise its name."""
    return int(name) if str(name).isdigit() else name
