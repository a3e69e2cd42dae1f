"""Recordings as the arrays that a likelihood needs, on one clock and padded to one length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.bayes.noise import Timeline, timeline
from rfdropo_bayes.bayes.noise.autoregression import steps_of
from rfdropo_bayes.data import Trajectory, check_channels, shared_markers
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.commands import Commands, stack_commands
from rfdropo_bayes.simulators.extended import ExtendedSimulator
from rfdropo_bayes.simulators.protocol import Simulator


@dataclass(frozen=True)
class RecordingSet:
    """Recordings as the arrays a likelihood needs, padded to a common length (padding is not valid)."""

    names: tuple[str, ...]  # one per recording
    markers: tuple[str, ...]  # the markers that all recordings have
    marker_index: Int[np.ndarray, " marker"]  # indices of these markers in the simulator
    time: Float[np.ndarray, "recording time"]  # observation times, from zero [s]
    rows: Int[np.ndarray, " recording"]  # number of rows of each recording
    position: Float[np.ndarray, "recording time marker 3"]  # measured marker positions [m]; zero if masked
    line: Timeline
    commands: Commands  # commands on the simulator's clock

    @property
    def steps(self) -> Float[np.ndarray, " recording"]:
        """Time between rows of each recording [s]."""
        return steps_of(self.time)

    def of(self, index: Sequence[int], rows: int | None = None) -> RecordingSet:
        """The first rows of some recordings."""
        chosen = list(index)
        return RecordingSet(
            tuple(self.names[i] for i in chosen),
            self.markers,
            self.marker_index,
            self.time[chosen, :rows],
            np.minimum(self.rows[chosen], self.time.shape[1] if rows is None else rows),
            self.position[chosen, :rows],
            Timeline(*(np.asarray(part)[chosen, :rows] for part in self.line)),
            self.commands.of(chosen),
        )


def gather_recordings(simulator: Simulator, trajectories: Sequence[Trajectory]) -> RecordingSet:
    """Convert trajectories to the simulator's clock and markers: the robot's markers that every recording has.

    Raises:
        InputError: no trajectory, two trajectories of the same name, commands that no drive executed, no common marker,
            or another number of channels.
    """
    if not trajectories:
        raise InputError("no recordings", where="[data] fit", remedy="name at least one recording")
    names = tuple(trajectory.name for trajectory in trajectories)
    if len(set(names)) < len(names):
        raise InputError(f"two recordings share a name: {', '.join(names)}", where="[data]", remedy="list each once")
    for trajectory in trajectories:
        if trajectory.unsent:
            remedy = "leave it out: a shadow session has commands that were not executed"
            raise InputError(
                "the recording is of a shadow session, in which no drive moved", where=trajectory.name, remedy=remedy
            )
    length = max(len(trajectory.time) for trajectory in trajectories)
    markers = shared_markers(trajectories, simulator.marker_names)
    times, positions, valid, commands = [], [], [], []
    for trajectory in trajectories:
        chosen = [trajectory.marker_names.index(name) for name in markers]
        mask = np.asarray(trajectory.position_mask)[:, chosen]
        position = np.where(mask[:, :, None], np.asarray(trajectory.position)[:, chosen], 0.0)
        missing = length - len(trajectory.time)
        tail = trajectory.time[-1] + trajectory.dataset.attrs["sample_time"] * np.arange(1, missing + 1)
        times.append(np.concatenate([trajectory.time, tail]) - trajectory.time[0])
        positions.append(np.pad(position, ((0, missing), (0, 0), (0, 0))))
        valid.append(np.pad(mask, ((0, missing), (0, 0))))
        commands.append(commands_of(simulator, trajectory))
    lines = [timeline(time, ok) for time, ok in zip(times, valid, strict=True)]
    return RecordingSet(
        names,
        markers,
        np.array([simulator.marker_names.index(name) for name in markers]),
        np.stack(times),
        np.array([len(trajectory.time) for trajectory in trajectories]),
        np.stack(positions),
        Timeline(*(np.stack(part) for part in zip(*lines, strict=True))),
        stack_commands(commands),
    )


def commands_of(simulator: Simulator, trajectory: Trajectory) -> Commands:
    """Commands of a recording on the simulator's clock, as its drives take them.

    Raises:
        InputError: other channels or another unit than the simulator's, or drives that do not fit the recording.
    """
    unit = getattr(simulator, "command_unit", trajectory.command_unit)
    check_channels(trajectory, simulator.channel_names, unit)
    return commands_after(simulator, trajectory, trajectory.command_time, trajectory.command)


def commands_after(
    simulator: Simulator,
    trajectory: Trajectory,
    time: Float[np.ndarray, " command"],
    value: Float[np.ndarray, "command channel"],
) -> Commands:
    """Simulator inputs of other commands [m or rad] from the initial state of a recording, see `commands_of`.

    Raises:
        InputError: commands that the simulator refuses.
    """
    initial = trajectory.initial_command
    if isinstance(simulator, ExtendedSimulator):
        value = simulator.taken(trajectory.name, initial, value)
    try:
        return simulator.commands(time, value, initial, trajectory.time)
    except InputError as error:
        raise InputError(error.what, where=error.where or trajectory.name, remedy=error.remedy) from None
