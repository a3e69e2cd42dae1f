"""Data sets that a model makes itself: simulated from known parameters, with the noise that it assumes."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from rfdropo_bayes.bayes.angles import MOTOR_ANGLE_NOISE
from rfdropo_bayes.bayes.calibration import CalibrationProblem
from rfdropo_bayes.bayes.forces import TENSION_GAIN, TENSION_NOISE, reading_size
from rfdropo_bayes.bayes.model import Measured
from rfdropo_bayes.bayes.objects import draw_object_error, offset_of


def simulated_data(problem: CalibrationProblem, truth: Mapping[str, float], key: PRNGKeyArray) -> Measured | None:
    """What would be measured if ``truth`` held, at the times, markers and faults of the problem's own data.

    Returns:
        None where the rollout does not end well.
    """
    position_key, tension_key, weighed_key = jax.random.split(key, 3)
    batch = {name: jnp.array([truth[name]]) for name in problem.names}
    seen = problem.observe(batch)
    if seen.status[0] != 0:
        return None
    model = problem.model
    known = {**model.fixed, **truth}
    valid = model.recordings.line.valid[..., None]
    measured = np.where(valid, seen.position[0] + problem.draw_noise(position_key, batch)[0], 0.0)
    read = angle = pose = None
    if model.tension is not None:
        error = known[TENSION_NOISE.name] * np.asarray(jax.random.normal(tension_key, model.tension.measured.shape))
        clean = (
            known.get(TENSION_GAIN.name, TENSION_GAIN.nominal) * np.asarray(seen.tension)[0][..., model.tension.cables]
        )
        size = np.asarray(reading_size(clean, model.tension.valid, clean))
        read = np.where(model.tension.valid, clean + error * size, 0.0)
    if model.motor_angle is not None:
        normal = np.asarray(jax.random.normal(jax.random.fold_in(key, 3), model.motor_angle.measured.shape))
        turned = np.asarray(seen.motor_angle)[0] + known[MOTOR_ANGLE_NOISE.name] * normal
        angle = np.where(model.motor_angle.valid, turned, 0.0)
    if model.object_pose is not None:
        single = {name: column[0] for name, column in batch.items()}
        offset = np.stack([offset_of(model.rollout_values(single, name)) for name in model.recordings.names])
        clean = np.array(seen.object_pose)[0]
        clean[..., :3] += offset[:, None]
        keys = jax.random.split(jax.random.fold_in(key, 4), len(clean))
        noisy = jax.vmap(lambda k, p, t: draw_object_error(k, p, t, known))(keys, clean, model.recordings.time)
        pose = np.where(model.object_pose.line.valid, np.asarray(noisy), 0.0)
    normal = np.asarray(jax.random.normal(weighed_key, (len(model.weighed),)))
    weighed = np.array(
        [sum(truth[n] for n in entry.parameters) + entry.sd * z for entry, z in zip(model.weighed, normal, strict=True)]
    )
    return Measured(measured, read, angle, weighed, pose)
