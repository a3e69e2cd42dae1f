"""The cube on a plate that a robot pushes, as its description and the parameters of a rollout have it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.pushing import MeshSpheres, PushGeometry, Spheres, mesh_spheres, push_scene, rod_spheres
from rfdropo_bayes.fem.rigid_body import Cube, cube_at, solid_gyration_radius
from rfdropo_bayes.fem.rod import Rod
from rfdropo_bayes.fem.tetrahedra import TetrahedralBody
from rfdropo_bayes.robots import PushScene, Robot
from rfdropo_bayes.simulators.body_engine import CubeInputs


def push_table(robot: Robot) -> PushScene:
    """The robot's cube and plate.

    Raises:
        InputError: the robot has no cube.
    """
    if robot.push is None:
        raise InputError(
            f"robot {robot.name!r} has no cube to push", where="[simulator] push", remedy="use push = false"
        )
    return robot.push


def plate_normal(robot: Robot) -> Float[np.ndarray, "3"]:
    """Unit vector against gravity, out of the plate."""
    return -robot.gravity / np.linalg.norm(robot.gravity)


def scene_of(robot: Robot, body: Rod | TetrahedralBody) -> PushGeometry:
    """Cube and plate of a robot, before its body; its section profile without notches is the body's outline.

    Raises:
        InputError: the robot has no cube.
    """
    table = push_table(robot)
    spheres: Spheres | MeshSpheres
    if isinstance(body, Rod):
        spheres = rod_spheres(body)
    else:
        half = np.asarray(robot.body.half_width_m, float).mean(axis=1)
        spheres = mesh_spheres(body.rest, np.asarray(robot.body.station_m, float), half)
    return push_scene(
        spheres,
        plate_normal=plate_normal(robot),
        plate_height=table.plate_height_m,
        contact_distance=table.contact_distance_m,
    )


def cube_inputs(robot: Robot, values: Mapping[str, Float[Array, ""]]) -> CubeInputs:
    side = jnp.asarray(values["cube_side"], float)
    centre = jnp.stack([jnp.asarray(values[f"cube_{axis}"], float) for axis in "xyz"])
    mass, friction = jnp.asarray(values["cube_mass"], float), jnp.asarray(values["friction"], float)
    solid = Cube(mass, side, solid_gyration_radius(side), friction)
    return CubeInputs(solid, cube_at(centre, values["cube_yaw"], plate_normal(robot)))


def cube_at_measured(robot: Robot, values: Mapping[str, Any], pose: Float[Any, "7"]) -> dict[str, Any]:
    """Place and yaw of the cube, by name; see `RobotSimulator.with_object_at`."""
    normal, table = plate_normal(robot), push_table(robot)
    offset = [values[f"offset_{axis}"] for axis in "xyz"]
    centre = jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(p - o) for p, o in zip(pose[:3], offset, strict=True))), -1)
    height = table.plate_height_m + table.contact_distance_m + 0.5 * jnp.asarray(values["cube_side"])
    centre = centre + (height - centre @ normal)[..., None] * normal
    yaw = 2.0 * jnp.arctan2(jnp.asarray(pose[3:6]) @ normal, pose[6])
    yaw = jnp.broadcast_to((yaw + jnp.pi) % (2.0 * jnp.pi) - jnp.pi, centre.shape[:-1])
    return {"cube_yaw": yaw} | {f"cube_{axis}": centre[..., i] for i, axis in enumerate("xyz")}
