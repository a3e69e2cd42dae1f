"""Whether a recording is of a robot: markers by name, channels of commands by number and order, and their unit."""

from __future__ import annotations

from collections.abc import Sequence

from rfdropo_bayes.data.mapped_formats import MAPPED
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError


def shared_markers(trajectories: Sequence[Trajectory], markers: Sequence[str]) -> tuple[str, ...]:
    """The robot's ``markers`` that every recording has, in the robot's order.

    Raises:
        InputError: no file matches.
    """
    for trajectory in trajectories:
        if not set(trajectory.marker_names) & set(markers):
            own = ", ".join(trajectory.marker_names)
            raise InputError(
                f"no marker matches by name: recording has {own}, robot has {', '.join(markers)}",
                where=trajectory.name,
                remedy="name them under [data.columns] markers"
                if trajectory.dataset.attrs["format"] in MAPPED
                else "use the robot that was recorded, or use the same marker names in its file",
            )
    shared = set.intersection(*(set(trajectory.marker_names) for trajectory in trajectories))
    common = tuple(name for name in markers if name in shared)
    if not common:
        each = "; ".join(f"{trajectory.name} has {', '.join(trajectory.marker_names)}" for trajectory in trajectories)
        raise InputError(
            f"no marker of the robot ({', '.join(markers)}) is in all recordings: {each}",
            where="[data]",
            remedy="fit recordings of the same markers together",
        )
    return common


def check_channels(trajectory: Trajectory, channels: Sequence[str], unit: str) -> None:
    """Raise InputError if the commands of a recording do not match a robot's ``channels``, in ``unit``."""
    own = trajectory.cable_names
    plain = trajectory.dataset.attrs["format"] in MAPPED
    if len(own) != len(channels):
        raise InputError(
            f"recording has {_counted(own)}, robot has {_counted(channels)}",
            where=trajectory.name,
            remedy="list one column for each of the robot's under [data.columns] commands, in its order"
            if plain
            else "use the robot that was recorded",
        )
    if set(own) == set(channels) and tuple(own) != tuple(channels):
        raise InputError(
            f"commands are in the order {', '.join(own)}, channels of the robot in the order {', '.join(channels)}",
            where=trajectory.name,
            remedy="list the columns under [data.columns] commands in the robot's order"
            if plain
            else "give the commands in the robot's order",
        )
    if trajectory.command_unit != unit:
        raise InputError(
            f"the recording has commands in {trajectory.command_unit}, the robot in {unit}",
            where=trajectory.name,
            remedy="correct command_unit under [data.columns]; for other drives, run init again with --command-unit"
            if plain
            else "use the robot that was recorded",
        )


def _counted(names: Sequence[str]) -> str:
    """A number and names, such as "2 channels of commands (a, b)"."""
    return f"{len(names)} channel{'s' if len(names) > 1 else ''} of commands ({', '.join(names)})"
