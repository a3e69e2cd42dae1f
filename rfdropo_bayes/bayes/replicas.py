"""Data sets that a model makes itself: simulated from known parameters, with the noise that it assumes."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from rfdropo_bayes.bayes.calibration_problem import CalibrationProblem
from rfdropo_bayes.bayes.trajectory_model import Measured


def simulated_data(problem: CalibrationProblem, truth: Mapping[str, float], key: PRNGKeyArray) -> Measured | None:
    """Simulated data under ``truth``, with the times, markers and faults of the problem's own data.

    Returns:
        None after a failed rollout.
    """
    observed = problem.observe({name: jnp.array([truth[name]]) for name in problem.names})
    if observed.status[0] != 0:
        return None
    single = jax.tree.map(lambda field: jnp.asarray(field[0]), observed)
    seen = problem.model.seen(single, {name: jnp.asarray(truth[name]) for name in problem.names})
    first, second, third = jax.random.split(key, 3)  # the order fixes the data sets of a seed
    keys = {"markers": jax.random.split(first, 1)[0], "tension": second, "weighed": third}
    keys |= {"motor_angle": jax.random.fold_in(key, 3), "object_pose": jax.random.fold_in(key, 4)}
    keys |= {"orientation": jax.random.fold_in(key, 5)}
    return {channel.name: np.asarray(channel.draw(keys[channel.name], seen)) for channel in problem.model.channels}
