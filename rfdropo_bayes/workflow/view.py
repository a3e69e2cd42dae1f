"""``rfdropo view``: a rollout as pictures, an animation, or surfaces for ParaView."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.report.motion import Motion, cube_corners, smooth_line, upright
from rfdropo_bayes.report.motion_export import save_frames, save_vtk
from rfdropo_bayes.report.motion_figures import save_animation, save_still
from rfdropo_bayes.robots import Robot, load_robot
from rfdropo_bayes.workflow.assembly import find_robot, load_data
from rfdropo_bayes.workflow.experiment import load_experiment
from rfdropo_bayes.workflow.simulation import simulate_all

STILLS, ANIMATIONS = (".png", ".svg", ".pdf"), (".gif", ".mp4")


def run_view(source: Path, out: Path, overrides: list[str], recording: str | None, rate: int) -> list[Path]:
    """Draw a motion.

    Args:
        source: an experiment to simulate, or a trajectory that ``rfdropo simulate`` wrote (NetCDF).
        out: .png, .svg or .pdf for several instants in one picture, .gif or .mp4 for an animation, a name that ends in
            .vtk for a folder of surfaces, any other name for a folder of frames.
        recording: which recording of the experiment, where it has several.
        rate: frames per second, in real time.

    Returns:
        the files written, the first to open first.

    Raises:
        InputError: bad input, or a format that needs what is not installed.
    """
    motion = _from_file(source) if source.suffix == ".nc" else _from_experiment(source, overrides, recording)
    if out.suffix == ".vtk":
        return save_vtk(motion, out)
    if out.suffix == "":
        return save_frames(motion, out, rate)
    if out.suffix not in STILLS + ANIMATIONS:
        known = ", ".join((*STILLS, *ANIMATIONS, ".vtk"))
        raise InputError(f"unknown format {out.suffix!r}", where=str(out), remedy=f"use {known}, or a folder")
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix in STILLS:
        save_still(motion, out)
    else:
        save_animation(motion, out, rate)
    return [out]


def _from_file(path: Path) -> Motion:
    trajectory = Trajectory.load(path)
    return _motion(trajectory, load_robot(trajectory.dataset.attrs["robot"]), None, None)


def _from_experiment(path: Path, overrides: list[str], recording: str | None) -> Motion:
    """Simulate one recording of an experiment, in a folder of its own that is thrown away."""
    experiment, _ = load_experiment(path, overrides)
    folder = path.resolve().parent
    with tempfile.TemporaryDirectory() as scratch:
        found = simulate_all(experiment, folder, Path(scratch))
        names = list(found["recordings"])
        if recording is not None and recording not in names:
            raise InputError(f"no recording {recording!r}", where="view", remedy=f"recordings: {', '.join(names)}")
        name = recording or names[0]
        simulated = Trajectory.load(Path(found["recordings"][name]["files"][0]))
    measured = None
    if experiment.data is not None:
        sources = [*load_data(experiment, folder, "fit"), *load_data(experiment, folder, "test")]
        measured = next(entry for entry in sources if entry.name == name)
    side = found["parameters"].get("cube_side")
    return _motion(simulated, find_robot(experiment, folder), measured, side)


def _motion(trajectory: Trajectory, robot: Robot, measured: Trajectory | None, side: float | None) -> Motion:
    """Geometry of a trajectory of a robot; the tube has the robot's outer width."""
    rest = {name: point[2] for name, point in zip(robot.marker_names, robot.marker_points(), strict=True)}
    order = sorted(trajectory.marker_names, key=lambda name: rest[name])
    chosen = [trajectory.marker_names.index(name) for name in order]
    position, heights = trajectory.position[:, chosen], np.array([rest[name] for name in order])
    base = float(robot.body.station_m[0])
    if heights[0] > base + 1e-6:  # the clamped section does not move
        clamp = np.broadcast_to([0.0, 0.0, base], (len(position), 1, 3))
        position, heights = np.concatenate([clamp, position], axis=1), np.concatenate([[base], heights])
    line, at = smooth_line(position, heights)
    width = np.mean(robot.body.half_width_m, axis=1)
    turn = upright(robot.gravity)
    pose, push = trajectory.object_pose, robot.push
    cube = None
    if pose is not None and push is not None:
        cube = cube_corners(pose, side or push.parameters["cube_side"].nominal) @ turn.T
    dots = None
    if measured is not None:
        dots = np.where(measured.position_mask[..., None], measured.position, np.nan) @ turn.T
    return Motion(
        trajectory.name,
        trajectory.time,
        line @ turn.T,
        np.interp(at, robot.body.station_m, width),
        dots,
        cube,
        push.plate_height_m if cube is not None and push is not None else None,
    )
