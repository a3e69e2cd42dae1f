"""``rfdropo view``: a rollout as a picture or an animation."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.trajectory import open_netcdf
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import output_folder
from rfdropo_bayes.model.assembly import robot_of
from rfdropo_bayes.model.experiment_file import ROBOT_COPY
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.report.motion import DrawnMotion, cube_corners, smooth_line, upright
from rfdropo_bayes.report.motion_figures import save_animation, save_still
from rfdropo_bayes.results.predicted import OBJECT
from rfdropo_bayes.robots import Robot, known_robots
from rfdropo_bayes.simulators.black_box import BlackBox
from rfdropo_bayes.verbs.simulate import simulate

PREDICTED = "mean"  # variable of a prediction's file
SLENDER = 0.01  # half width of a line through markers over the extent of their motion
RATE = 20  # frames per second of an animation, in real time
STILLS, ANIMATIONS = (".png", ".svg", ".pdf"), (".gif", ".mp4")


def run_view(source: Path, out: Path, overrides: list[str], recording: str | None, robot: Path | None = None) -> None:
    """Draw a motion.

    Args:
        source: an experiment to simulate, or a NetCDF file of ``rfdropo simulate`` or ``rfdropo predict``, whose mean
            prediction is drawn.
        out: .png, .svg or .pdf for several instants in one picture, .gif or .mp4 for an animation.
        recording: name of the recording, if the experiment has several.
        robot: file of the robot, if a NetCDF file has none beside it and the robot is not bundled.

    Raises:
        InputError: bad input, or a format that needs a missing package.
    """
    motion = _from_file(source, robot) if source.suffix == ".nc" else _from_experiment(source, overrides, recording)
    if out.suffix not in STILLS + ANIMATIONS:
        known = ", ".join((*STILLS, *ANIMATIONS))
        raise InputError(f"unknown format {out.suffix!r}", where=str(out), remedy=f"use {known}")
    output_folder(out.parent)
    if out.suffix in STILLS:
        save_still(motion, out)
    else:
        save_animation(motion, out, RATE)


def _from_file(path: Path, robot: Path | None) -> DrawnMotion:
    dataset = open_netcdf(path)
    own = _robot_of(path, str(dataset.attrs.get("robot", "")), robot)
    if PREDICTED in dataset:
        return _predicted(dataset, own)
    return _motion(Trajectory.load(path), own, None, None)


def _robot_of(path: Path, name: str, given: Path | None) -> Robot:
    """The robot of a NetCDF file: the given robot, the robot in its run's folder, or the bundled robot of that name."""
    beside = path.resolve().parent / ROBOT_COPY
    if given is None and name not in known_robots() and not beside.is_file():
        raise InputError(
            f"its robot, {name!r}, does not come with the package",
            where=str(path),
            remedy="give the robot's file with --robot",
        )
    return Robot.load(given or (beside if beside.is_file() else name))


def _predicted(dataset: xr.Dataset, robot: Robot) -> DrawnMotion:
    """Mean of a prediction; an object is drawn as it moves in the draw that is nearest to the mean."""
    pose = None
    if OBJECT in dataset:
        centre = dataset[OBJECT].values[:, :, :3]
        nearest = int(np.argmin(np.sum((centre - centre.mean(axis=0)) ** 2, axis=(1, 2))))
        pose = dataset[OBJECT].values[nearest].astype(float)
    title = f"{dataset.attrs.get('recording', 'prediction')}, mean prediction"
    names = tuple(str(name) for name in dataset["marker"].values)
    return _motion(_Shown(title, dataset["time"].values, names, dataset[PREDICTED].values, pose), robot, None, None)


def _from_experiment(path: Path, overrides: list[str], recording: str | None) -> DrawnMotion:
    """Simulate one recording of an experiment."""
    model = Model.read(path, overrides)
    table, runs = model.settings.commands, {}
    if table is None:
        runs = {run.name: run for role in ("fit", "test") for run in model.recordings(role)}
    names = list(runs) if table is None else table.recordings
    name = recording or names[0]
    if name not in names:
        raise InputError(f"no recording {name!r}", where="view", remedy=f"recordings: {', '.join(names)}")
    made = simulate(model, [runs[name]] if table is None else table.model_dump(), seed=model.settings.seed)
    simulated = next(run for run in made if run.name == name)
    side = simulated.settings.get("parameters", {}).get("cube_side")
    if isinstance(model.robot, BlackBox):
        return _markers_alone(simulated, model.robot, runs.get(name))
    return _motion(simulated, robot_of(model.spec), runs.get(name), side)


def _markers_alone(shown: Trajectory, box: BlackBox, measured: Trajectory | None) -> DrawnMotion:
    """A line through the markers of a simulator that shows nothing else, from the origin if there is only one."""
    turn, position = upright(box.gravity), shown.position
    if position.shape[1] == 1:
        position = np.concatenate([np.zeros_like(position), position], axis=1)
    line, at = smooth_line(position, np.arange(float(position.shape[1])))
    extent = float(np.ptp(position.reshape(-1, 3), axis=0).max())
    dots = None
    if measured is not None:
        dots = np.where(measured.position_mask[..., None], measured.position, np.nan) @ turn.T
    return DrawnMotion(shown.name, shown.time, line @ turn.T, np.full(len(at), SLENDER * extent), dots, None, None)


class _Shown(NamedTuple):
    """Moving parts: markers [m] and, if there is one, an object's pose."""

    name: str
    time: Float[np.ndarray, " time"]
    marker_names: tuple[str, ...]
    position: Float[np.ndarray, "time marker 3"]
    object_pose: Float[np.ndarray, "time 7"] | None


def _motion(shown: Trajectory | _Shown, robot: Robot, measured: Trajectory | None, side: float | None) -> DrawnMotion:
    """Geometry of a robot's motion; the tube has the robot's outer width, and passes through the markers' means if
    several have the same height.
    """
    rest = {name: point[2] for name, point in zip(robot.marker_names, robot.marker_points(), strict=True)}
    known = [index for index, name in enumerate(shown.marker_names) if name in rest]
    if not known:
        raise InputError(
            f"no marker of the recording ({', '.join(shown.marker_names)}) is a marker of the robot "
            f"({', '.join(rest)})",
            where=shown.name,
            remedy="give the robot that was recorded",
        )
    heights, group = np.unique([rest[shown.marker_names[index]] for index in known], return_inverse=True)
    position = np.stack(
        [shown.position[:, [known[i] for i in np.flatnonzero(group == g)]].mean(axis=1) for g in range(len(heights))],
        axis=1,
    )
    base = float(robot.body.station_m[0])
    if heights[0] > base + 1e-6:  # the clamped section does not move
        clamp = np.broadcast_to([0.0, 0.0, base], (len(position), 1, 3))
        position, heights = np.concatenate([clamp, position], axis=1), np.concatenate([[base], heights])
    line, at = smooth_line(position, heights)
    width = np.mean(robot.body.half_width_m, axis=1)
    turn = upright(robot.gravity)
    pose, push = shown.object_pose, robot.push
    cube = None
    if pose is not None and push is not None:
        cube = cube_corners(pose, side or push.parameters["cube_side"].nominal) @ turn.T
    dots = None
    if measured is not None:
        dots = np.where(measured.position_mask[..., None], measured.position, np.nan) @ turn.T
    return DrawnMotion(
        shown.name,
        shown.time,
        line @ turn.T,
        np.interp(at, robot.body.station_m, width),
        dots,
        cube,
        push.plate_height_m if cube is not None and push is not None else None,
    )
