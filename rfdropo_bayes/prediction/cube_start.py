"""Where a cube stands before a recording starts, taken from its measured pose, and where it is afterwards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from rfdropo_bayes.bayes.calibration import CalibrationProblem
from rfdropo_bayes.bayes.channels.object_pose import (
    OBJECT_CORRELATION_TIME,
    OBJECT_NOISE,
    OBJECT_TURN_NOISE,
    OFFSETS,
    draw_object_error,
)
from rfdropo_bayes.bayes.model import TrajectoryModel
from rfdropo_bayes.bayes.priors import prior_from_table
from rfdropo_bayes.bayes.space import SEPARATOR, Parameter, ParameterSpace
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator

SIZES = (OBJECT_NOISE, OBJECT_TURN_NOISE, OBJECT_CORRELATION_TIME)

Batch = dict[str, Float[np.ndarray, " n"]]

PLACE = ("cube_x", "cube_y", "cube_z", "cube_yaw")


def with_measured_starts(
    model: TrajectoryModel, trajectories: Sequence[Trajectory], values: Batch
) -> tuple[TrajectoryModel, Batch]:
    """Let the cube of every recording start where it was measured in the first row, standing on the plate.

    Whatever the values say of its place is replaced, for those recordings; the measuring frame's offset, which differs
    between draws, is taken off. A recording without a measured cube keeps what the values say.
    """
    simulator = model.simulator
    if not isinstance(simulator, RobotSimulator) or not simulator.pushes:
        return model, values
    specs = {spec.name: spec for spec in simulator.parameters}
    kept = [p for p in model.space.parameters if p.spec.name not in PLACE]
    placed = {p.name: values[p.name] for p in kept}
    parameters = list(kept)
    for trajectory in trajectories:
        known = model.space.for_recording(values, trajectory.name)
        known |= _place(simulator, model, trajectory, values)
        for name in PLACE:
            if name in known:
                prior = prior_from_table(specs[name], dict(specs[name].prior), where=name)
                parameters.append(Parameter(specs[name], prior, trajectory.name))
                placed[f"{name}{SEPARATOR}{trajectory.name}"] = np.asarray(known[name])
    return replace(model, space=ParameterSpace(tuple(parameters))), placed


def _place(simulator: RobotSimulator, model: TrajectoryModel, trajectory: Trajectory, values: Batch) -> Batch:
    """Centre [m] and yaw [rad] of the measured cube in the robot's frame, for every draw; empty if there is none."""
    pose = trajectory.object_pose
    if pose is None or not np.isfinite(pose[0]).all():
        return {}
    count = len(next(iter(values.values())))
    known = {**model.fixed, **model.space.for_recording(values, trajectory.name)}
    placed = simulator.with_object_at(known, pose[0])
    return {name: np.broadcast_to(np.asarray(placed[name]), (count,)) for name in PLACE}


def offsets(known: Mapping[str, object], count: int) -> Float[np.ndarray, "n 3"]:
    """Shift [m] of measured against simulated positions among the values of one recording; zero where it is none's."""
    return np.stack(
        [np.broadcast_to(np.asarray(known.get(name, 0.0), dtype=float), (count,)) for name in OFFSETS], axis=1
    )


def measured_objects(
    problem: CalibrationProblem, pose: Float[np.ndarray, "n recording time 7"], values: Batch, key: PRNGKeyArray
) -> Float[np.ndarray, "n recording time 7"]:
    """Simulated poses of the cube as they would be measured: with the offset of the measuring frame and, where measured
    poses were among the data, with the error that the model was found to have."""
    model = problem.model
    shifted = np.array(pose)
    count = len(shifted)
    for index, name in enumerate(model.recordings.names):
        known = {**model.fixed, **model.space.for_recording(values, name)}
        shifted[:, index, :, :3] += offsets(known, count)[:, None]
        sizes = {s.name: np.broadcast_to(known[s.name], (count,)) for s in SIZES if s.name in known}
        if sizes:
            keys = jax.random.split(jax.random.fold_in(key, index), count)
            draw = jax.vmap(draw_object_error, in_axes=(0, 0, None, 0))
            time = jnp.asarray(model.recordings.time[index])
            shifted[:, index] = draw(keys, jnp.asarray(shifted[:, index]), time, sizes)
    return shifted
