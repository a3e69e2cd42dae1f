"""Bags of ROS 1 (``.bag``) and ROS 2 (folders, ``.db3``, ``.mcap``), read by the package rosbags without ROS.

A column is named as ``rqt_plot`` names it: the topic, a full stop, and the path within the message, such as
``/mocap/tip.pose.position.x`` or ``/commands.data[0]``. Elements of a list are named by the message, and numbered if it
has no names: ``/joint_states.position[motor1]``, ``/tf.transforms[tip].transform.translation.x``,
``/rigid_bodies.rigidbodies[tip].pose.position.x``. Every message of numbers is read, even if only the bag defines its
type.

The clock "header" takes header stamps, and times of arrival for topics without stamps. The clock "log" takes times of
arrival for all topics. Elements with their own header, as transforms, have its stamps.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast, get_args

import numpy as np
import pandas as pd

from rfdropo_bayes.data.csv_table import CsvTable, closest
from rfdropo_bayes.data.named_columns import CsvColumns, coordinates
from rfdropo_bayes.data.streams import Stream, commanded, in_order, observed, one_frame
from rfdropo_bayes.errors import InputError

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

FORMAT = "rosbag"
Clock = Literal["header", "log"]
CLOCKS = get_args(Clock)
STORAGE = (".bag", ".db3", ".mcap")
METADATA = "metadata.yaml"
NANOSECOND = 1e-9
ELEMENT_NAMES = ("child_frame_id", "rigid_body_name", "marker_name", "name", "marker_index", "index")
"""Fields that name or number an element of a list, e.g. of TFMessage, mocap4r2_msgs/RigidBodies and Markers."""
LISTS_OF_NAMES = ("name", "names", "joint_names", "interface_names")
"""Fields that name the elements of the message's other lists, e.g. of JointState and DynamicJointState."""
PASSED_OVER = ("header", "layout")
LARGEST_LIST = 256  # longer lists are pictures, scans and clouds of points


class _Reading(NamedTuple):
    """Numbers of one message, or of one element with a header."""

    name: str
    header: Any
    values: dict[str, float]


def bag_file(path: Path) -> Path:
    """Path to open: a folder with metadata, or the single file of a folder without metadata.

    Raises:
        InputError: no file or several.
    """
    if not path.is_dir() or (path / METADATA).is_file():
        return path
    files = sorted(file for file in path.iterdir() if file.suffix in STORAGE)
    if len(files) == 1:
        return files[0]
    raise InputError(
        f"has no {METADATA}, and {len(files)} files of recorded messages",
        where=str(path),
        remedy="run `ros2 bag reindex` on it, or name one of its files",
    )


def read_streams(path: Path, topics: Collection[str] | None = None, clock: Clock = "header") -> list[Stream]:
    """All numbers of a bag, in streams of equal times.

    Args:
        path: path of the bag.
        topics: topics to read; by default all with known messages.
        clock: "header" for header stamps, if any; "log" for the recorder's times.

    Raises:
        InputError: rosbags is not installed, a bag that is damaged, or a topic that it does not have or define.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        remedy = 'install it: pip install "rfdropo_bayes[formats]"'
        raise InputError(
            "bags need the package rosbags, which is not installed", where=str(path), remedy=remedy
        ) from None
    if not path.exists():
        raise InputError("no such file", where=str(path), remedy="correct the path")
    file = bag_file(path)
    standard = get_typestore(Stores.ROS2_HUMBLE if file.suffix != ".bag" else Stores.ROS1_NOETIC)
    try:
        with AnyReader([file], default_typestore=standard) as reader:
            return _streams(reader, path, topics, clock)
    except InputError:
        raise
    except Exception as error:  # each storage, codec and message definition raises its own types on damaged files
        raise InputError(
            f"is not a bag that rosbags can read ({type(error).__name__}: {error})".replace("\n", " "),
            where=str(path),
            remedy="fetch it again; `ros2 bag reindex` or `mcap recover` repairs a bag whose recorder was stopped; an "
            "MCAP file has to hold messages of ROS 2",
        ) from None


def read_observations(path: Path, columns: CsvColumns) -> CsvTable:
    """Observations at the times of the first marker.

    Raises:
        InputError: see `read_streams`; also a missing column, or positions in several coordinate frames.
    """
    clock, places, pose = clock_of(columns), coordinates(columns), columns.object_pose
    names = [*places, *(columns.tensions or ()), *(columns.motor_angles or ())]
    streams = read_streams(path, _topics([*names, *(pose or ())]), clock)
    one_frame(streams, [*places, *(pose or ())], str(path))
    return CsvTable.of_frame(observed(streams, clock, names, pose, str(path)), str(path), places)


def read_commands(path: Path, columns: CsvColumns) -> CsvTable:
    """Commands and their times.

    Raises:
        InputError: see `read_streams`; also a missing or empty column.
    """
    clock, names = clock_of(columns), columns.commands
    sent = commanded(read_streams(path, _topics(names), clock), clock, names, str(path))
    return CsvTable.of_frame(sent, str(path), names)


def _topics(names: Sequence[str]) -> set[str]:
    return {name.split(".")[0] for name in names}


def clock_of(columns: CsvColumns) -> Clock:
    """The clock of a bag, which is the name of its column of times [s]; header stamps if rows are numbered.

    Raises:
        InputError: a bag has no such clock.
    """
    if columns.time is None:
        return "header"
    if columns.time in CLOCKS:
        return cast(Clock, columns.time)
    raise InputError(
        f"time = {columns.time!r} is not a clock of a bag",
        where="[data.columns]",
        remedy='write "header", for header stamps if there are any, or "log", for the recorder\'s times',
    )


def _streams(reader: AnyReader, path: Path, topics: Collection[str] | None, clock: str) -> list[Stream]:
    there = {connection.topic: connection.msgtype for connection in reader.connections}
    known = reader.typestore.fielddefs
    for topic in sorted(topics or ()):
        if topic not in there:
            remedy = "correct it under [data.columns]"
            raise InputError(f"has no topic {topic!r}; {closest(topic, sorted(there))}", where=str(path), remedy=remedy)
        if there[topic] not in known:
            raise InputError(
                f"does not define the message {there[topic]} of {topic}",
                where=str(path),
                remedy=(
                    "convert it to MCAP on a machine with the message type (`ros2 bag convert`): MCAP holds definitions"
                ),
            )
    wanted = [
        connection
        for connection in reader.connections
        if connection.msgtype in known and (topics is None or connection.topic in topics)
    ]
    readings: dict[str, list[tuple[float, float, str, dict[str, float]]]] = defaultdict(list)
    for connection, logged, raw in reader.messages(wanted) if wanted else ():
        for name, header, values in _readings(reader.deserialize(raw, connection.msgtype), connection.topic):
            frame = "" if header is None else str(header.frame_id)
            readings[name].append((_stamp(header), NANOSECOND * logged, frame, values))
    return [_stream(name, entries, clock) for name, entries in readings.items()]


def _stream(name: str, readings: list[tuple[float, float, str, dict[str, float]]], clock: str) -> Stream:
    stamp, logged = (np.array([reading[k] for reading in readings]) for k in (0, 1))
    frames = frozenset(reading[2] for reading in readings) - {""}
    values = pd.DataFrame([reading[3] for reading in readings])
    return in_order(name, stamp if clock == "header" and stamp.all() else logged, values, frames)


def _stamp(header: Any) -> float:
    """The stamp of a header [s]; zero if there is none or it was not set."""
    return 0.0 if header is None else header.stamp.sec + NANOSECOND * header.stamp.nanosec


def _readings(message: Any, topic: str) -> Iterator[_Reading]:
    """The numbers of a message, with separate readings for elements that have their own header."""
    values: dict[str, float] = {}
    apart: list[tuple[str, Any]] = []
    _gather(message, f"{topic}.", values, apart)
    if values:
        yield _Reading(topic, getattr(message, "header", None), values)
    for name, element in apart:
        inner: dict[str, float] = {}
        _gather(element, f"{name}.", inner, [])
        if inner:
            yield _Reading(name, element.header, inner)


def _gather(message: Any, prefix: str, values: dict[str, float], apart: list[tuple[str, Any]]) -> None:
    """Put a message's numbers into ``values``, by their paths, and elements with their own header ``apart``."""
    fields = {field.name: getattr(message, field.name) for field in dataclasses.fields(message)}
    names: list[str] = next((fields[key] for key in LISTS_OF_NAMES if isinstance(fields.get(key), list)), [])
    for key, value in fields.items():
        if key in PASSED_OVER or isinstance(value, str):
            continue
        if dataclasses.is_dataclass(value):
            _gather(value, f"{prefix}{key}.", values, apart)
        elif isinstance(value, list | np.ndarray):
            if len(value) <= LARGEST_LIST:
                _gather_list(value, f"{prefix}{key}", names if len(names) == len(value) else [], values, apart)
        else:
            values[f"{prefix}{key}"] = float(value)


def _gather_list(
    elements: Any, path: str, names: list[str], values: dict[str, float], apart: list[tuple[str, Any]]
) -> None:
    called = names or [_element_name(element) for element in elements]
    unique = len(set(called)) == len(called) and all(called)
    for index, element in enumerate(elements):
        name = f"{path}[{called[index] if unique else index}]"
        if isinstance(element, str):
            continue
        if not dataclasses.is_dataclass(element):
            values[name] = float(element)
        elif hasattr(element, "header"):
            apart.append((name, element))
        else:
            _gather(element, f"{name}.", values, apart)


def _element_name(element: Any) -> str:
    """Name of an element of a list in a message; empty without a name."""
    fields = (getattr(element, key, "") for key in ELEMENT_NAMES)
    return next((str(field) for field in fields if field != "" and isinstance(field, str | int)), "")
