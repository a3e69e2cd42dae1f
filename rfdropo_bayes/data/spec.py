"""The [data] table of an experiment file, and the recordings it names."""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from rfdropo_bayes.data import lerobot
from rfdropo_bayes.data.asl_csv import NO_COMMANDS, read_asl_csv
from rfdropo_bayes.data.first_command import begun_alike, begun_from, undecided
from rfdropo_bayes.data.mapped_formats import FOLDERS, MAPPED, read_mapped
from rfdropo_bayes.data.named_columns import ROWS, CsvColumns
from rfdropo_bayes.data.optitrack_csv import read_optitrack_csv
from rfdropo_bayes.data.sofa_csv import read_sofa_csv
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import find_files
from rfdropo_bayes.tables import changed, parse_table

Format = Literal[
    "sofa-csv", "optitrack-csv", "asl-csv", "csv", "motive-csv", "rosbag", "lerobot", "mat", "npz", "netcdf"
]

InitialCommand = Literal["first", "zero"] | list[float] | None


class RecordingEntry(BaseModel):
    """One entry of ``fit`` or ``test``; a bare string is its ``observations``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    observations: str = Field(description="file, or several by wildcards; a folder for a ROS 2 bag or LeRobotDataset")
    commands: str | None = Field(default=None, description='file of the commands, if separate; "none": zero commands')
    rows: tuple[int, int] | None = Field(
        default=None, description="keep observation rows first to last only, both included, counted from 0"
    )
    every: int = Field(
        default=1, ge=1, description="with k, keep each k-th of these rows: a fit of poses at rest needs few"
    )
    episodes: list[int] | None = Field(
        default=None, description="numbers of a LeRobotDataset's episodes; all by default"
    )
    initial_command: InitialCommand = Field(default=None, description="command before the first row, as in [data]")
    command_offset: float | None = Field(
        default=None, description="command_offset of this recording, if the clocks of each begin apart"
    )


class DataSpec(BaseModel):
    """The [data] table: files and format of the recordings."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Format = Field(description="format of the files")
    fit: list[RecordingEntry] = Field(min_length=1, description="recordings that a fit may see")
    test: list[RecordingEntry] = Field([], description="recordings that no fit sees")
    columns: CsvColumns | None = Field(
        default=None,
        description="meaning of the columns, for formats with any order of columns: csv, motive-csv, rosbag, "
        "lerobot, mat, npz",
    )
    resample: float | None = Field(
        default=None, gt=0, description="sample time to bring every recording to [s]; as recorded by default"
    )
    missing: Literal["error", "mask"] = Field(
        default="error", description="treatment of lost marker positions: an error, or masked"
    )
    initial_command: InitialCommand = Field(
        default=None,
        description='command before the first row of a file: "first" (the first command was in force already), '
        '"zero", or one value per channel [m or rad]; by default stated by the file, or recognised from the first rows',
    )
    lead_in: float = Field(
        default=2.0,
        ge=0,
        description="time [s] before the first row during which commands are also simulated, so that a piece may "
        "start in motion; with 0, and with a tracked object, a piece starts at rest under the command in force",
    )

    @field_validator("fit", "test", mode="before")
    @classmethod
    def _bare_strings(cls, entries: Any) -> Any:
        if not isinstance(entries, list):
            return entries
        return [{"observations": entry} if isinstance(entry, str) else entry for entry in entries]

    @model_validator(mode="after")
    def _columns_fit(self) -> DataSpec:
        if (self.format in MAPPED) != (self.columns is not None):
            takes = "needs a" if self.format in MAPPED else "takes no"
            raise ValueError(f"format {self.format!r} {takes} [data.columns] table (columns= of rb.read)")
        return self

    def piece(self, whole: Trajectory, rows: tuple[int, int] | None, every: int = 1) -> Trajectory:
        """Each ``every``-th row, first to last, with the commands of `lead_in`; all rows without ``rows``.

        Commands with their own clock may begin long before the recording does.
        """
        if every > 1:
            timed = self.columns is None or self.columns.time != ROWS
            return self.piece(whole, rows).thin(every, timed)
        if rows is None and whole.command_time[0] >= -self.lead_in:
            return whole
        if rows is None:
            return self.piece(whole, (0, len(whole.time) - 1)).with_attributes(name=whole.name)
        return whole.slice_rows(*rows, self.lead_in if whole.object_pose is None else 0.0)

    @classmethod
    def parse(cls, table: Mapping[str, Any], where: str = "[data]") -> DataSpec:
        """Check a table as TOML gives it.

        Raises:
            InputError: naming the first key that is unknown (and the nearest that is known), missing or wrong.
        """
        return parse_table(cls, table, where=where)


class _Source(NamedTuple):
    observations: Path
    commands: Path | None
    zero_command: bool
    rows: tuple[int, int] | None
    every: int
    initial_command: InitialCommand
    command_offset: float | None
    episode: int | None

    @property
    def recording(self) -> tuple[Path, int | None]:
        """Identity of the recording, regardless of rows."""
        return self.observations.resolve(), self.episode

    @property
    def key(self) -> tuple[Path, int | None, Path | None, str]:
        """Identity of what is read: the recording, its commands, their clock, and the command before them."""
        return self.observations, self.episode, self.commands, str((self.initial_command, self.command_offset))

    def shares_rows(self, other: _Source) -> bool:
        """Whether a row belongs to both, parts of the same recording."""
        first, last = self.rows or (0, sys.maxsize - 1)
        start, end = other.rows or (0, sys.maxsize - 1)
        low, high = max(first, start), min(last, end)
        if low > high:
            return False
        step = self.every // math.gcd(self.every, other.every) * other.every
        later = range(max(low, start), min(high, low + step) + 1)
        return any((row - first) % self.every == 0 and (row - start) % other.every == 0 for row in later)


def load_recordings(spec: DataSpec, base: Path, role: Literal["fit", "test"] = "fit") -> list[Trajectory]:
    """Read the recordings of one role, checked, masked and resampled, in the order of the file (globs sorted).

    Args:
        spec: the [data] table.
        base: folder that paths are relative to, if the folder named by RFDROPO_DATA does not have them.
        role: "fit" or "test".

    Raises:
        InputError: if a file is missing or bad, a glob matches nothing, or a test recording shares rows with a fit
            recording.
    """
    fit, test = list(_sources(spec, spec.fit, base)), list(_sources(spec, spec.test, base))
    sources = fit if role == "fit" else test
    _check_split(fit, test)
    loaded: dict[tuple[Path, int | None, Path | None, str], Trajectory] = {}
    for source in (*sources, *fit):  # fitted recordings show how the others begin, not the other way round
        if source.key not in loaded and (source in sources or any(map(undecided, loaded.values()))):
            loaded[source.key] = begun_from(_read(spec, source), source.initial_command)
    begun = dict(zip(loaded, begun_alike(list(loaded.values())), strict=True))
    for key in dict.fromkeys(source.key for source in sources):
        said = begun[key].name, begun[key].first_command
        logging.getLogger(__name__).info("%s: command before the first row: %s", *said)
    recordings = []
    for source in sources:
        recording = spec.piece(begun[source.key], source.rows, source.every)
        recordings.append(recording if spec.resample is None else recording.resample(spec.resample))
    return _distinct_names(recordings, sources, [*fit, *test])


def find_data_file(name: str | Path, base: Path, *, folders: bool = False) -> Path:
    """A file beside the recordings, e.g. a mesh, found in RFDROPO_DATA if set, else in ``base``.

    Args:
        name: name of the file; a pattern may match a single file.
        base: folder of relative names.
        folders: whether a folder may stand for the files in it.

    Raises:
        InputError: no such file, or a pattern that several match.
    """
    files = find_files(str(name), base, folders=folders)
    if len(files) > 1:
        raise InputError(
            f"matches {len(files)} files ({', '.join(file.name for file in files[:3])}{', ...' if files[3:] else ''}) "
            "but one file is expected",
            where=str(name),
            remedy="name the file; if every recording has its own commands, give an entry for each recording",
        )
    return files[0]


def _sources(spec: DataSpec, entries: list[RecordingEntry], base: Path) -> Iterator[_Source]:
    for entry in entries:
        commands = None
        if entry.commands not in (None, NO_COMMANDS):
            commands = find_data_file(str(entry.commands), base)
        for match in find_files(entry.observations, base, folders=spec.format in FOLDERS):
            zero = entry.commands == NO_COMMANDS
            for episode in _episodes(spec, entry, match):
                initial = spec.initial_command if entry.initial_command is None else entry.initial_command
                yield _Source(match, commands, zero, entry.rows, entry.every, initial, entry.command_offset, episode)


def _episodes(spec: DataSpec, entry: RecordingEntry, path: Path) -> list[int] | list[None]:
    """The episodes of a file in an entry; None if the file is a single recording."""
    if spec.format == lerobot.FORMAT:
        return lerobot.episode_numbers(path) if entry.episodes is None else entry.episodes
    if entry.episodes is not None:
        raise InputError(f"format {spec.format!r} has no episodes", where=entry.observations, remedy="drop the key")
    return [None]


def _read(spec: DataSpec, source: _Source) -> Trajectory:
    mask_missing = spec.missing == "mask"
    if source.command_offset is not None and spec.columns is None:
        raise InputError(
            f"format {spec.format!r} has a single clock", where=str(source.observations), remedy="drop command_offset"
        )
    if spec.format in ("sofa-csv", "optitrack-csv", "netcdf") and source.commands is not None:
        raise InputError(
            f"format {spec.format!r} keeps the commands in the same file", where=str(source.commands), remedy="drop it"
        )
    if spec.format == "sofa-csv":
        return read_sofa_csv(source.observations)
    if spec.format == "optitrack-csv":
        return read_optitrack_csv(source.observations, mask_missing=mask_missing)
    if spec.format == "asl-csv":
        if source.commands is None and not source.zero_command:
            raise InputError(
                "has no commands",
                where=str(source.observations),
                remedy="give {observations = ..., commands = ...}, or --commands FILE; commands = 'none' if "
                "nothing was commanded",
            )
        return read_asl_csv(source.observations, source.commands, mask_missing=mask_missing)
    if spec.columns is not None:
        columns = spec.columns
        if source.command_offset is not None:
            columns = changed(columns, where="[data.columns]", command_offset=source.command_offset)
        return read_mapped(
            spec.format, source.observations, columns, source.commands, source.episode, mask_missing=mask_missing
        )
    return Trajectory.load(source.observations)


def _check_split(fit: list[_Source], test: list[_Source]) -> None:
    for tested in test:
        for fitted in fit:
            if tested.recording == fitted.recording and tested.shares_rows(fitted):
                raise InputError(
                    "a test recording shares rows with a recording that is fitted",
                    where=str(tested.observations),
                    remedy="split by recording, or give rows that do not overlap",
                )


def _distinct_names(recordings: list[Trajectory], sources: list[_Source], listed: list[_Source]) -> list[Trajectory]:
    """Recordings whose files have equal names in different folders get names that include the folder."""
    names = [recording.name for recording in recordings]
    distinct = []
    for recording, source in zip(recordings, sources, strict=True):
        path = source.observations.resolve()
        others = {each.observations.resolve() for each in listed if each.observations.name == path.name} - {path}
        if others or names.count(recording.name) > 1:
            recording = recording.with_attributes(name=f"{_folders(path, others)}/{recording.name}")
        distinct.append(recording)
    renamed = [recording.name for recording in distinct]
    for name in renamed:
        if renamed.count(name) > 1:
            raise InputError("is listed twice", where=name, remedy="list each recording once")
    return distinct


def _folders(path: Path, others: Iterable[Path]) -> str:
    """The shortest trailing part of a file's folders that differs from the other files."""
    parts = path.parent.parts
    apart = (count for count in range(1, len(parts)) if all(o.parent.parts[-count:] != parts[-count:] for o in others))
    return "/".join(parts[-next(apart, len(parts)) :])
