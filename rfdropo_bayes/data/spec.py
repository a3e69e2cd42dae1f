"""The [data] table of an experiment file, and the recordings it names."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from rfdropo_bayes.data.asl_csv import NO_COMMANDS, read_asl_csv
from rfdropo_bayes.data.csv_table import closest
from rfdropo_bayes.data.optitrack_csv import read_optitrack_csv
from rfdropo_bayes.data.plain_csv import CsvColumns, read_plain_csv
from rfdropo_bayes.data.sofa_csv import read_sofa_csv
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.errors import InputError

DATA_VARIABLE = "RFDROPO_DATA"
Format = Literal["sofa-csv", "optitrack-csv", "asl-csv", "csv", "netcdf"]
_GLOB = "*?["


class RecordingEntry(BaseModel):
    """One entry of ``fit`` or ``test``; a bare string is its ``observations``.

    ``observations`` may be a glob. ``commands`` is the file of commands where the format keeps them apart ("none": zero
    commands). ``rows`` keeps the observation rows first to last, both included, counted from 0.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    observations: str
    commands: str | None = None
    rows: tuple[int, int] | None = None


def _entry(value: Any) -> Any:
    return {"observations": value} if isinstance(value, str) else value


Entry = Annotated[RecordingEntry, BeforeValidator(_entry)]


class DataSpec(BaseModel):
    """The [data] table: where the recordings are and how to read them.

    Args:
        format: how the files are written.
        fit: recordings that a fit may see.
        test: recordings that no fit sees.
        columns: what the columns are, for format "csv".
        resample: sample time [s] to bring every recording to; as recorded by default.
        missing: whether a lost marker position is an error or is masked.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Format
    fit: Annotated[list[Entry], Field(min_length=1)]
    test: list[Entry] = []
    columns: CsvColumns | None = None
    resample: Annotated[float, Field(gt=0)] | None = None
    missing: Literal["error", "mask"] = "error"

    @model_validator(mode="after")
    def _columns_fit(self) -> DataSpec:
        if (self.format == "csv") != (self.columns is not None):
            raise ValueError("format 'csv' needs a [data.columns] table, and no other format takes one")
        return self

    @classmethod
    def parse(cls, table: Mapping[str, Any], where: str = "[data]") -> DataSpec:
        """Check a table as TOML gives it.

        Raises:
            InputError: naming the first key that is unknown (and the nearest that is known), missing or wrong.
        """
        try:
            return cls.model_validate(dict(table))
        except ValidationError as error:
            raise explain(error, cls, where) from None


class _Source(NamedTuple):
    observations: Path
    commands: Path | None
    zero_command: bool
    rows: tuple[int, int] | None


def load_recordings(spec: DataSpec, base: Path, role: Literal["fit", "test"] = "fit") -> list[Trajectory]:
    """Read the recordings of one role, checked, masked and resampled, in the order of the file (globs sorted).

    Args:
        spec: the [data] table.
        base: folder that paths are relative to, unless the variable RFDROPO_DATA names another.
        role: "fit" or "test".

    Raises:
        InputError: if a file is missing or bad, a glob matches nothing, or a test recording shares rows with a fit one.
    """
    sources = list(_sources(spec.fit if role == "fit" else spec.test, base))
    _check_split(list(_sources(spec.fit, base)), list(_sources(spec.test, base)))
    loaded: dict[tuple[Path, Path | None], Trajectory] = {}
    recordings = []
    for source in sources:
        key = (source.observations, source.commands)
        if key not in loaded:
            loaded[key] = _read(spec, source)
        recording = loaded[key] if source.rows is None else loaded[key].slice_rows(*source.rows)
        recordings.append(recording if spec.resample is None else recording.resample(spec.resample))
    return _distinct_names(recordings, sources)


def explain(error: ValidationError, model: type[BaseModel], where: str) -> InputError:
    """One-line InputError for the first problem pydantic found in a table of the experiment file."""
    problem = error.errors()[0]
    path = [str(part) for part in problem["loc"]]
    place = ".".join([where, *path])
    if problem["type"] == "extra_forbidden":
        known = list(_model_at(model, path[:-1]).model_fields)
        hint = closest(path[-1], known)
        return InputError(f"unknown key {path[-1]!r}; {hint}", where=place, remedy="correct the key")
    if problem["type"] == "literal_error":
        choices = list(get_args(_model_at(model, path[:-1]).model_fields[path[-1]].annotation)) or [
            str(problem["ctx"]["expected"])
        ]
        return InputError(
            f"{problem['input']!r} is not one of {', '.join(map(str, choices))}; "
            f"{closest(str(problem['input']), [str(choice) for choice in choices])}",
            where=place,
            remedy="choose one of them",
        )
    if problem["type"] == "missing":
        return InputError(f"the key {path[-1]!r} is missing", where=place, remedy="add it")
    return InputError(
        problem["msg"].removeprefix("Value error, "), where=place, remedy="correct the value in the experiment file"
    )


def _model_at(model: type[BaseModel], path: list[str]) -> type[BaseModel]:
    """The table that a location leads to: list indices are skipped, fields are followed into their model."""
    for part in path:
        if part in model.model_fields:
            model = next(_models_in(model.model_fields[part].annotation), model)
    return model


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)


def _sources(entries: list[RecordingEntry], base: Path) -> Iterator[_Source]:
    variable = os.environ.get(DATA_VARIABLE)
    root = Path(variable) if variable else Path(base)
    looked = f"looked in {root} ({DATA_VARIABLE})" if variable else f"looked in {root} ({DATA_VARIABLE} is not set)"
    for entry in entries:
        commands = None
        if entry.commands not in (None, NO_COMMANDS):
            commands = _existing(root / str(entry.commands), looked)
        if any(sign in entry.observations for sign in _GLOB):
            pattern = Path(entry.observations)
            anchor = Path(pattern.anchor) if pattern.is_absolute() else root
            matches = sorted(anchor.glob(str(pattern.relative_to(pattern.anchor))))
            if not matches:
                raise InputError(f"nothing matches; {looked}", where=entry.observations, remedy=_WHERE_TO_PUT)
        else:
            matches = [_existing(root / entry.observations, looked)]
        for match in matches:
            yield _Source(match, commands, entry.commands == NO_COMMANDS, entry.rows)


_WHERE_TO_PUT = f"correct the path, or set {DATA_VARIABLE} to the folder that holds the data"


def _existing(path: Path, looked: str) -> Path:
    if not path.is_file():
        raise InputError(f"no such file; {looked}", where=str(path), remedy=_WHERE_TO_PUT)
    return path


def _read(spec: DataSpec, source: _Source) -> Trajectory:
    mask_missing = spec.missing == "mask"
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
                remedy="give {observations = ..., commands = ...}, with commands = 'none' for a recording at zero command",
            )
        return read_asl_csv(source.observations, source.commands, mask_missing=mask_missing)
    if spec.format == "csv" and spec.columns is not None:
        return read_plain_csv(source.observations, spec.columns, source.commands, mask_missing=mask_missing)
    return Trajectory.load(source.observations)


def _check_split(fit: list[_Source], test: list[_Source]) -> None:
    for tested in test:
        for fitted in fit:
            if tested.observations.resolve() == fitted.observations.resolve():
                first, last = tested.rows or (0, float("inf"))
                start, end = fitted.rows or (0, float("inf"))
                if first <= end and start <= last:
                    raise InputError(
                        "a test recording shares rows with a recording that is fitted",
                        where=str(tested.observations),
                        remedy="split by recording, or give rows that do not overlap",
                    )


def _distinct_names(recordings: list[Trajectory], sources: list[_Source]) -> list[Trajectory]:
    names = [recording.name for recording in recordings]
    distinct = []
    for recording, source in zip(recordings, sources, strict=True):
        if names.count(recording.name) > 1:
            recording = recording.with_attributes(name=f"{source.observations.parent.name}/{recording.name}")
        distinct.append(recording)
    renamed = [recording.name for recording in distinct]
    for name in renamed:
        if renamed.count(name) > 1:
            raise InputError("is listed twice", where=name, remedy="list each recording once")
    return distinct
