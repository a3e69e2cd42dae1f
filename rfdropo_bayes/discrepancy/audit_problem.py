"""The problem of an audit: a simulator with all candidates, recordings, and rules."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field

from rfdropo_bayes.bayes.channels import ObjectPose, Series
from rfdropo_bayes.bayes.lanes import Lanes
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.bayes.trajectory_model import TrajectoryModel
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.discrepancy.candidates import Candidate
from rfdropo_bayes.discrepancy.coordinates import Coordinates
from rfdropo_bayes.discrepancy.deadline import Deadline
from rfdropo_bayes.discrepancy.differences import Groups
from rfdropo_bayes.discrepancy.extension import Rules
from rfdropo_bayes.discrepancy.forward import Forward
from rfdropo_bayes.discrepancy.measurements import Measurements, gather_measurements
from rfdropo_bayes.mechanisms.ports import PortMap
from rfdropo_bayes.simulators.commands import Commands


@dataclass(frozen=True)
class AuditProblem:
    """Problem of an audit.

    Attributes:
        lanes: simulator with the base model's mechanisms, and every candidate at its null value.
        finer: the same on a finer mesh and time step, with the commands on its own clock; None without.
        coordinates: coordinates of all parameters.
        model: base model and candidates, for all recordings, fitted recordings first.
        trajectories: fitted recordings.
        candidates: mechanisms that may be named.
        stated_noise: noise of the experiment file, used if nothing was repeated; None without it.
        start: start values of base parameters from an earlier calibration; None for a search.
        rules, seed: see `Rules`.
        left_out: mechanisms that do not run on this body, engine or data, with the reason.
        groups: groups of recordings with their own candidates; None without groups.
        ports: ports of the simulator for the search for unknown causes; None if not requested.
    """

    lanes: Lanes
    finer: tuple[Lanes, Commands] | None
    coordinates: Coordinates
    model: TrajectoryModel
    trajectories: Sequence[Trajectory]
    candidates: Sequence[Candidate]
    stated_noise: Stacked | None
    start: dict[str, float] | None
    rules: Rules
    seed: int
    left_out: Mapping[str, str] = field(default_factory=dict)
    groups: Groups | None = None
    ports: PortMap | None = None

    @property
    def compared(self) -> Groups | None:
        """The two compared groups; None for an audit of all recordings."""
        return self.groups if self.groups is not None and self.groups.compared else None

    @property
    def timed(self) -> bool:
        """Whether rows have times."""
        return all(trajectory.timed for trajectory in self.trajectories)

    def candidate(self, name: str) -> Candidate | None:
        """A candidate by its name; None for the mesh and time step, which are not in the library."""
        return next((candidate for candidate in self.candidates if candidate.name == name), None)

    def group_of(self, name: str) -> str:
        """The group of recordings that a candidate is in; empty for all."""
        candidate = self.candidate(name)
        return "" if candidate is None else candidate.group

    def kinds(self, names: Sequence[str]) -> list[Hashable]:
        """Keys that distinguish recordings beside their commands: their parameters, and their group, in which a
        mechanism or a law may act alone. Recordings of one kind may be repeats of each other.
        """
        groups = [""] * len(names) if self.groups is None else [self.groups.group_of(name) for name in names]
        return [(*slots, group) for slots, group in zip(self.coordinates.slots(names), groups, strict=True)]


def measurements_of(problem: AuditProblem, chosen: Sequence[int], repeats: Sequence[Trajectory] = ()) -> Measurements:
    """Measurements of some recordings, cut to the longest; repeats are joined if given."""
    index = list(chosen)
    kinds = problem.kinds([problem.model.recordings.names[i] for i in index])
    rows = int(problem.model.recordings.rows[index].max())
    channels = [c.of_recordings(index, rows) if isinstance(c, Series) else c for c in problem.model.channels]
    return gather_measurements(problem.model.recordings.of(index, rows), channels, repeats, kinds)


def simulated(
    problem: AuditProblem,
    finer: bool,
    measurements: Measurements,
    chosen: Sequence[int],
    deadline: Deadline | None = None,
) -> Forward:
    """Some of the recordings, on the simulator itself or the finer simulator; an object starts at its measured pose."""
    lanes, commands = problem.lanes, problem.model.recordings.commands
    if finer and problem.finer is not None:
        lanes, commands = problem.finer
    names = {problem.model.recordings.names[i]: i for i in chosen}
    rows = int(problem.model.recordings.rows[list(chosen)].max())
    start = next((c.readings[:, 0] for c in measurements.channels if isinstance(c, ObjectPose)), None)
    return Forward(lanes, problem.coordinates, commands, names, rows, deadline, start)
