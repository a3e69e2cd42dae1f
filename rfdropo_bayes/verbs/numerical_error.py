"""Numerical error of the markers by time step, elements and kind of motion, measured on the experiment's commands."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.recordings import commands_of
from rfdropo_bayes.data import Trajectory, shared_markers
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.integrators import STAGES
from rfdropo_bayes.model.assembly import build_robot_simulator, physical_values
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.simulators.body_engine import QUASI_STATIC
from rfdropo_bayes.simulators.mechanisms import motions_of
from rfdropo_bayes.simulators.protocol import Result

FINER, MORE_ELEMENTS = 4, 2  # the time step is divided by this, and the number of elements is multiplied by the second
LIMIT = MORE_ELEMENTS**2 / (MORE_ELEMENTS**2 - 1)
"""Distance from the limit of infinitely many elements over the distance from `MORE_ELEMENTS` times the elements; the
rod is of second order.
"""
LONGEST, LONGEST_MESH = 20.0, 2.0
"""Longest simulated part of a recording [s], of a rod and of tetrahedra, whose steps take 100 times as long."""
SOLVES = 4.0  # linear solves that a row of a quasi-static motion takes on average, at most
ENOUGH = 0.02
"""Share of the markers' way by which a quasi-static motion may differ from a dynamic one and still be enough."""


class RestError(NamedTuple):
    """A quasi-static motion beside a dynamic one."""

    distance: float  # root mean square, of the markers [mm]
    way: float  # of the markers about their mean [mm]
    cheaper: float  # ratio of solves of the dynamic and the quasi-static motion

    @property
    def enough(self) -> bool:
        """Whether the quasi-static motion is enough."""
        return self.distance <= ENOUGH * self.way


class NumericalError(NamedTuple):
    """Root mean square distance of the markers [mm] from other simulations."""

    seconds: float  # that were simulated
    time_step: float | None  # a quarter of the step; None for a motion without steps
    elements: float | None  # twice the elements; None for a mesh of tetrahedra
    way: float  # of the markers about their mean
    rest: RestError | None = None  # the other kind of motion; None if it cannot be simulated, or for rows without times


def measure_numerical_error(spec: ModelSpec, recording: Trajectory) -> NumericalError:
    """Change at the markers with a quarter of the time step, twice the elements, and the other kind of motion.

    Values are nominal or fixed. An error of first order in the step, as of implicit Euler, is a third larger than this
    difference; an error of second order is a fifteenth larger.

    Raises:
        InputError: a black box, commands that do not fit, or a failed rollout.
    """
    simulator, table = build_robot_simulator(spec), spec.simulator
    longest = longest_of(simulator.engine.is_rod)

    def moved(**changes: Any) -> Float[np.ndarray, "time marker 3"]:
        return nominal_markers(replace(spec, simulator=table.model_copy(update=changes)), recording, longest)

    here, finer, elements, rest = moved(), None, None, None
    if not simulator.at_rest:
        finer = _distance(here, moved(time_step=simulator.time_step / FINER))
    if simulator.engine.is_rod:
        elements = _distance(here, moved(refine=MORE_ELEMENTS * table.refine))
    # Rows without times have no speed, nor have poses that were held until they rested.
    if (
        recording.timed
        and not (simulator.at_rest and recording.settings.get("settled_poses"))
        and simulator.engine.carries_loads
        and all(QUASI_STATIC in motions_of(m) for m in simulator.mechanisms)
    ):
        other = {"motion": "dynamic"} if simulator.at_rest else {"motion": QUASI_STATIC, **dict.fromkeys(MOVING)}
        dynamic = replace(spec, simulator=table.model_copy(update={"motion": "dynamic"}))
        moving = build_robot_simulator(dynamic) if simulator.at_rest else simulator
        rows, steps = len(here), min(longest, float(recording.time[-1])) / moving.time_step
        cheaper = steps * len(STAGES[moving.engine.integrator]) / (SOLVES * rows)
        with suppress(InputError):  # a stiff body at rest may have no motion with this time step
            rest = RestError(_distance(here, moved(**other)), _way(here), cheaper)
    return NumericalError(min(longest, float(recording.time[-1])), finer, elements, _way(here), rest)


MOVING = ("time_step", "integrator")  # keys of [simulator] that a quasi-static motion does not have


def longest_of(rod: bool) -> float:
    """Seconds that are simulated of a recording: fewer of a mesh of tetrahedra."""
    return LONGEST if rod else LONGEST_MESH


def _distance(one: Float[np.ndarray, "time marker 3"], other: Float[np.ndarray, "time marker 3"]) -> float:
    return float(1e3 * np.sqrt(np.mean(np.sum((one - other) ** 2, axis=-1))))


def _way(position: Float[np.ndarray, "time marker 3"]) -> float:
    """Root mean square distance of the last marker from its mean [mm]."""
    return _distance(position[:, -1:], position[:, -1:].mean(axis=0))


def nominal_markers(spec: ModelSpec, recording: Trajectory, longest: float) -> Float[np.ndarray, "time marker 3"]:
    """Markers of the nominal model that the recording has [m], at its times up to ``longest`` [s].

    Raises:
        InputError: a black box, commands that do not fit, or a rollout that failed.
    """
    simulator = build_robot_simulator(spec)
    commands, values = commands_of(simulator, recording), physical_values(spec, simulator)
    rows = int(np.sum(recording.time <= longest))
    steps = np.asarray(commands.sample_step)[rows - 1] + 1
    rollout = jax.jit(lambda given: simulator.rollout(given, commands, steps))(values)
    # Rows beyond the last step mean nothing, whatever the status of a rollout that was not taken there.
    if int(rollout.status) != Result.OK:
        result = Result(int(rollout.status))
        word = result.name.lower().replace("_", " ")
        about = f"the simulation of {recording.name!r} at nominal values ended: {word}"
        raise InputError(about, where="[simulator]", remedy=result.remedy)
    shared = shared_markers([recording], simulator.marker_names)
    chosen = [simulator.marker_names.index(name) for name in shared]
    return np.asarray(rollout.position)[:rows, chosen]


def numerical_error_lines(spec: ModelSpec, recording: Trajectory) -> list[tuple[str, str]]:
    """The numerical error in words, as `Check.lines`, compared with stated noise."""
    error, table = measure_numerical_error(spec, recording), spec.simulator
    simulator = build_robot_simulator(spec)
    integrator, step = simulator.engine.integrator, 1e3 * simulator.time_step
    over = f"at the markers over the first {error.seconds:.3g} s of {recording.name}, root mean square"
    said = []
    if error.time_step is not None:
        said.append(f"a quarter of the time step ({step:.4g} ms, {integrator}): {error.time_step:.2g} mm {over}")
        if 1e3 * simulator.robot.command.ramp_s < step:
            said.append("drives carry out a change within a step: state their time, ramp_s in the robot file")
    if error.elements is None:
        said.append("the mesh of tetrahedra is as given: the error of the mesh is not measured")
    else:
        cut = "" if table.refine == 1 else f" (refine = {table.refine})"
        limit = LIMIT * error.elements
        share = f", {100.0 * limit / error.way:.2g} % of the way" if error.way > 0.0 else ""
        said.append(
            f"twice the elements{cut}: {error.elements:.2g} mm{'' if said else f' {over}'}; their limit is about "
            f"{limit:.2g} mm away{share}"
        )
    if error.rest is not None:
        said.append(rest_words(error.rest, rests=simulator.at_rest))
    if spec.stated is not None and spec.stated.standard_deviation > 0.0:
        said.append(f"the noise that [noise] states: {1e3 * spec.stated.standard_deviation:.2g} mm a coordinate")
    return [("numerics" if k == 0 else "", words) for k, words in enumerate(said)]


def rest_words(rest: RestError, *, rests: bool) -> str:
    """Which kind of motion is enough; ``rests``: the experiment's is quasi-static."""
    share = f"{rest.distance:.2g} mm, {100.0 * rest.distance / max(rest.way, 1e-12):.2g} % of the way"
    if not rest.enough:
        wrong = 'set motion = "dynamic"' if rests else 'motion = "dynamic" is right'
        return f"the robot moves as fast as its body answers: a quasi-static motion differs by {share}; {wrong}"
    cost = f"is {rest.cheaper:.2g} times cheaper and" if rest.cheaper > 1.0 else "is not cheaper, and"
    words = f"the robot moves slower than its body answers: a quasi-static motion {cost} differs by {share}"
    return words if rests or rest.cheaper <= 1.0 else f'{words}; motion = "quasi-static" is enough'
