"""How far the time step and the mesh of an experiment move its markers, measured on its own commands."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.recordings import commands_of
from rfdropo_bayes.data import Trajectory, shared_markers
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.model.assembly import build_robot_simulator, physical_values
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.simulators.protocol import Result

FINER, MORE_LAYERS = 4, 2
"""The time step is divided by this, and every layer cut into so many more."""
LONGEST, LONGEST_MESH = 20.0, 2.0
"""[s] that are simulated of a recording, of layers and of tetrahedra, each of whose steps takes 100 times as long."""


class NumericalError(NamedTuple):
    """Root mean square distance of the markers [mm] from those of a finer simulation."""

    seconds: float  # that were simulated
    time_step: float  # against a quarter of the step
    mesh: float | None  # against twice the layers; None for a mesh of tetrahedra


def measure_numerical_error(spec: ModelSpec, recording: Trajectory) -> NumericalError:
    """What a quarter of the time step, and twice the layers, change at the markers of a recording.

    Values are nominal or fixed. An error that falls with the step as implicit Euler's does is a third larger than this
    difference, one of second order a fifteenth.

    Raises:
        InputError: a black box, commands that do not fit, or a rollout that did not end well.
    """
    simulator = build_robot_simulator(spec)
    layered = simulator.engine.layered
    longest = longest_of(layered)
    fine = spec.simulator.model_copy(update={"time_step": simulator.time_step / FINER})
    here, finer = (
        nominal_markers(spec, recording, longest),
        nominal_markers(replace(spec, simulator=fine), recording, longest),
    )
    mesh = None
    if layered:
        more = spec.simulator.model_copy(update={"refine": MORE_LAYERS * spec.simulator.refine})
        mesh = _distance(here, nominal_markers(replace(spec, simulator=more), recording, longest))
    return NumericalError(min(longest, float(recording.time[-1])), _distance(here, finer), mesh)


def longest_of(layered: bool) -> float:
    """Seconds that are simulated of a recording: fewer of a mesh of tetrahedra."""
    return LONGEST if layered else LONGEST_MESH


def _distance(one: Float[np.ndarray, "time marker 3"], other: Float[np.ndarray, "time marker 3"]) -> float:
    return float(1e3 * np.sqrt(np.mean(np.sum((one - other) ** 2, axis=-1))))


def nominal_markers(spec: ModelSpec, recording: Trajectory, longest: float) -> Float[np.ndarray, "time marker 3"]:
    """Markers of the nominal model that the recording has [m], at its times up to ``longest`` [s].

    Raises:
        InputError: a black box, commands that do not fit, or a rollout that did not end well.
    """
    simulator = build_robot_simulator(spec)
    commands, values = commands_of(simulator, recording), physical_values(spec, simulator)
    rows = int(np.sum(recording.time <= longest))
    steps = np.asarray(commands.sample_step)[rows - 1] + 1
    found = jax.jit(lambda given: simulator.rollout(given, commands, steps))(values)
    # Rows beyond the last step mean nothing, whatever the status of a rollout that was not taken there.
    if int(found.status) != Result.OK:
        word = Result(int(found.status)).name.lower().replace("_", " ")
        raise InputError(f"the simulation of {recording.name!r} ended: {word}", where="[simulator]")
    shared = shared_markers([recording], simulator.marker_names)
    chosen = [simulator.marker_names.index(name) for name in shared]
    return np.asarray(found.position)[:rows, chosen]


def numerical_error_lines(spec: ModelSpec, recording: Trajectory) -> list[tuple[str, str]]:
    """The same in words, as `Check.lines`, beside the noise where it is stated."""
    found, table = measure_numerical_error(spec, recording), spec.simulator
    simulator = build_robot_simulator(spec)
    integrator, step = simulator.engine.integrator, 1e3 * simulator.time_step
    over = f"at the markers over the first {found.seconds:.3g} s of {recording.name}, root mean square"
    lines = [
        ("numerics", f"a quarter of the time step ({step:.4g} ms, {integrator}): {found.time_step:.2g} mm {over}"),
    ]
    if found.mesh is None:
        lines.append(("", "the mesh of tetrahedra is as given: what a finer one would change is not measured"))
    else:
        cut = "" if table.refine == 1 else f" (refine = {table.refine})"
        lines.append(("", f"twice the layers{cut}: {found.mesh:.2g} mm"))
    if spec.stated is not None and spec.stated.standard_deviation > 0.0:
        lines.append(("", f"the noise that [noise] states: {1e3 * spec.stated.standard_deviation:.2g} mm a coordinate"))
    return lines
