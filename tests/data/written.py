"""One motion written as a Motive export, as bags of ROS 1 and ROS 2, and as LeRobotDatasets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
from pyarrow import parquet
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START = 1_700_000_000.0
"""When bags were recorded [s]."""
LATENCY = 0.013
"""From the stamp of a header to the recorder [s]."""
MOCAP = {
    "mocap4r2_msgs/msg/Marker": "int8 USE_NAME=0\nint8 USE_INDEX=1\nint8 USE_BOTH=2\nint8 id_type\nint32 marker_index\n"
    "string marker_name\ngeometry_msgs/Point translation",
    "mocap4r2_msgs/msg/RigidBody": "string rigid_body_name\nmocap4r2_msgs/Marker[] markers\ngeometry_msgs/Pose pose",
    "mocap4r2_msgs/msg/RigidBodies": "std_msgs/Header header\nuint32 frame_number\n"
    "mocap4r2_msgs/RigidBody[] rigidbodies",
    "mocap4r2_msgs/msg/Markers": "std_msgs/Header header\nuint32 frame_number\nmocap4r2_msgs/Marker[] markers",
}


class Motion(NamedTuple):
    """Times [s], positions [m] in the base frame, and commands with times of their own."""

    time: np.ndarray
    position: np.ndarray
    command_time: np.ndarray
    command: np.ndarray
    markers: tuple[str, ...] = ("low", "tip")

    @property
    def named(self) -> list[tuple[int, str]]:
        """The markers with their numbers."""
        return list(enumerate(self.markers))


def swaying(rows: int = 60, step: float = 0.02, every: int = 5) -> Motion:
    """Two markers of an arm of 0.2 m that sways, and four pulls that change at times between those of the rows."""
    time = step * np.arange(rows)
    noise = np.random.default_rng(3).normal(0.0, 1e-4, (rows, 2, 3))
    way = np.stack([0.02 * np.sin(3.0 * time), 0.01 * np.cos(2.0 * time), 0.002 * np.sin(time)], axis=1)
    position = np.array([0.5, 1.0])[None, :, None] * way[:, None] + noise
    position[..., 2] += np.array([0.1, 0.2])
    sent = step * every * np.arange(rows // every) + 0.3 * step
    return Motion(time, position, sent, 0.004 * np.sin(sent[:, None] + np.arange(4)) + 0.005)


def motive_csv(
    motion: Motion,
    path: Path,
    *,
    unit: str = "Millimeters",
    version: str = "1.25",
    lost: tuple[int, ...] = (),
    labelled: bool = True,
) -> Path:
    """A take with a rigid body for each marker, the markers on it, and an unlabelled one; y points up."""
    scale = {"Meters": 1.0, "Centimeters": 1e2, "Millimeters": 1e3}[unit]
    columns = []  # type, name, ID, quantity, axis, values
    for k, name in motion.named:
        place = scale * motion.position[:, k][:, [0, 2, 1]] * [1.0, -1.0, 1.0]
        turn = np.tile([0.0, 0.0, 0.6, 0.8], (len(place), 1))
        columns += [("Rigid Body", name, f"R{k}", "Rotation", axis, turn[:, c]) for c, axis in enumerate("XYZW")]
        columns += [("Rigid Body", name, f"R{k}", "Position", axis, place[:, c]) for c, axis in enumerate("XYZ")]
        columns.append(("Rigid Body", name, f"R{k}", "Mean Marker Error", "", 0.1 + 0.0 * motion.time))
        for kind in ("Rigid Body Marker", "Marker"):
            called = f"{name}:Marker 001"
            columns += [(kind, called, f"M{k}", "Position", a, 1.0 + place[:, c]) for c, a in enumerate("XYZ")]
    stray = np.full(len(motion.time), np.nan)
    columns += [("Marker", "Unlabeled 7", f"U{n}", "Position", axis, stray) for n in (1, 2) for axis in "XYZ"]
    facts = f"Format Version,{version},Take Name,sway,Export Frame Rate,50.000000,Rotation Type,Quaternion"
    lines = [f"{facts},Length Units,{unit},Coordinate Space,Global", ""]
    for row, label in enumerate(("Type", "Name", "ID", "")):
        lines.append(",".join(["", label if labelled else "", *(column[row] for column in columns)]))
    lines.append(",".join(["Frame", "Time (Seconds)", *(column[4] for column in columns)]))
    for frame, moment in enumerate(motion.time):
        seen = [np.nan if frame in lost and column[1] == motion.markers[-1] else column[5][frame] for column in columns]
        lines.append(",".join([str(frame), f"{moment:.6f}", *("" if np.isnan(v) else f"{v:.9f}" for v in seen)]))
    path.write_text("\r\n".join(lines) + "\r\n", encoding="utf-8")
    return path


def commands_csv(motion: Motion, path: Path, *, clock: float = 0.0) -> Path:
    """The commands with their own times, by a clock that shows ``clock`` less than that of the observations."""
    table = pd.DataFrame({"t": motion.command_time - clock})
    for channel, values in enumerate(motion.command.T, start=1):
        table[f"cmd_{channel}"] = values
    table.to_csv(path, index=False)
    return path


def _header(store, seconds: float, frame: str = "base"):
    """A header whose stamp is so many seconds after the start."""
    nanoseconds = round(1e9 * seconds) + int(START) * 10**9
    stamp = store.types["builtin_interfaces/msg/Time"](nanoseconds // 10**9, nanoseconds % 10**9)
    header = store.types["std_msgs/msg/Header"]
    return header(0, stamp, frame) if "seq" in header.__dataclass_fields__ else header(stamp, frame)


def _array(store, values: np.ndarray):
    layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    return store.types["std_msgs/msg/Float64MultiArray"](layout, np.asarray(values, dtype=float))


def _pose(store, place: np.ndarray):
    point = store.types["geometry_msgs/msg/Point"](*place)
    return store.types["geometry_msgs/msg/Pose"](point, store.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8))


def _stamped(store, motion: Motion, frames: tuple[str, ...]):
    """PoseStamped, a topic for each marker."""
    message = store.types["geometry_msgs/msg/PoseStamped"]
    for k, name in motion.named:
        for moment, place in zip(motion.time, motion.position[:, k], strict=True):
            header = _header(store, moment, frames[k % len(frames)])
            yield f"/mocap/{name}", message, moment, message(header, _pose(store, place))


def _transforms(store, motion: Motion, frames: tuple[str, ...]):
    """TFMessage, all markers on /tf."""
    many = store.types["tf2_msgs/msg/TFMessage"]
    one, vector = store.types["geometry_msgs/msg/TransformStamped"], store.types["geometry_msgs/msg/Vector3"]
    transform, turn = store.types["geometry_msgs/msg/Transform"], store.types["geometry_msgs/msg/Quaternion"]
    for row, moment in enumerate(motion.time):
        placed = [
            one(
                _header(store, moment, frames[k % len(frames)]),
                name,
                transform(vector(*motion.position[row, k]), turn(0.0, 0.0, 0.6, 0.8)),
            )
            for k, name in motion.named
        ]
        yield "/tf", many, moment, many(placed)


def _pose_array(store, motion: Motion, frames: tuple[str, ...]):
    message = store.types["geometry_msgs/msg/PoseArray"]
    for moment, places in zip(motion.time, motion.position, strict=True):
        yield "/poses", message, moment, message(_header(store, moment), [_pose(store, place) for place in places])


def _bodies(store, motion: Motion, frames: tuple[str, ...]):
    """mocap4r2_msgs/RigidBodies, which no typestore knows."""
    for name, definition in MOCAP.items():
        store.register(get_types_from_msg(definition, name))
    many, body = store.types["mocap4r2_msgs/msg/RigidBodies"], store.types["mocap4r2_msgs/msg/RigidBody"]
    marker, point = store.types["mocap4r2_msgs/msg/Marker"], store.types["geometry_msgs/msg/Point"]
    for row, moment in enumerate(motion.time):
        on_it = [marker(1, number, "", point(9.0, 9.0, 9.0)) for number in (1, 2)]
        bodies = [body(name, on_it, _pose(store, motion.position[row, k])) for k, name in motion.named]
        yield "/rigid_bodies", many, moment, many(_header(store, moment), row, bodies)


def _numbered(store, motion: Motion, frames: tuple[str, ...]):
    """mocap4r2_msgs/Markers, which have numbers from 3 on, the last one first."""
    for name, definition in MOCAP.items():
        store.register(get_types_from_msg(definition, name))
    many, one = store.types["mocap4r2_msgs/msg/Markers"], store.types["mocap4r2_msgs/msg/Marker"]
    point = store.types["geometry_msgs/msg/Point"]
    for row, moment in enumerate(motion.time):
        markers = [one(1, 3 + k, "", point(*motion.position[row, k])) for k, _ in reversed(motion.named)]
        yield "/markers", many, moment, many(_header(store, moment), row, markers)


def _multi_array(store, motion: Motion):
    """Float64MultiArray: without a header, so that the recorder's times count."""
    message = store.types["std_msgs/msg/Float64MultiArray"]
    for moment, values in zip(motion.command_time, motion.command, strict=True):
        yield "/commands", message, moment - LATENCY, _array(store, values)


def _joint_state(store, motion: Motion):
    message = store.types["sensor_msgs/msg/JointState"]
    names = [f"cable{channel}" for channel in range(1, motion.command.shape[1] + 1)]
    for moment, values in zip(motion.command_time, motion.command, strict=True):
        velocity = np.zeros(len(names))
        yield (
            "/joint_command",
            message,
            moment,
            message(_header(store, moment), names, values.copy(), velocity, velocity),
        )


def _single(store, motion: Motion):
    """Float64, a topic for each channel, one after the other."""
    message = store.types["std_msgs/msg/Float64"]
    for channel in range(motion.command.shape[1]):
        for moment, value in zip(motion.command_time, motion.command[:, channel], strict=True):
            yield f"/cable{channel + 1}/command", message, moment + 1e-4 * channel - LATENCY, message(value)


POSES = {"stamped": _stamped, "tf": _transforms, "array": _pose_array, "mocap": _bodies, "markers": _numbered}
COMMANDS = {"array": _multi_array, "joint": _joint_state, "single": _single}


def rosbag(
    motion: Motion,
    path: Path,
    *,
    poses: str = "stamped",
    commands: str = "array",
    storage: str = "db3",
    frames: tuple[str, ...] = ("base",),
) -> Path:
    """A bag: a folder for "db3" and "mcap", a file for "bag" (ROS 1)."""
    store = get_typestore(Stores.ROS1_NOETIC if storage == "bag" else Stores.ROS2_HUMBLE)
    if storage == "bag":
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    messages = [*POSES[poses](store, motion, frames), *COMMANDS[commands](store, motion)]
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Bag1(path) if storage == "bag" else Bag2(path, version=9, storage_plugin=plugin) as bag:
        connections = {}
        for topic, kind, moment, message in sorted(messages, key=lambda entry: entry[2]):
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind.__msgtype__, typestore=store)
            pack = store.serialize_ros1 if storage == "bag" else store.serialize_cdr
            received = int(START) * 10**9 + round(1e9 * (moment + LATENCY))
            bag.write(connections[topic], received, pack(message, kind.__msgtype__))
    return path


def lerobot(motions: list[Motion], folder: Path, *, version: str = "v3.0", named: bool = True) -> Path:
    """A dataset with an episode for each motion, whose commands come in every frame."""
    step = float(np.median(np.diff(motions[0].time)))
    places = [f"{name}_{axis}" for name in motions[0].markers for axis in "xyz"]
    channels = [f"cable{channel}.pos" for channel in range(1, motions[0].command.shape[1] + 1)]
    features = {
        "observation.state": {"dtype": "float32", "shape": [len(places)], "names": places if named else None},
        "action": {"dtype": "float32", "shape": [len(channels)], "names": {"motors": channels} if named else None},
        "observation.images.top": {"dtype": "video", "shape": [4, 4, 3], "names": ["height", "width", "channels"]},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    features |= {key: {"dtype": "int64", "shape": [1], "names": None} for key in ("frame_index", "episode_index")}
    tables, facts = [], []
    for number, motion in enumerate(motions):
        frames = np.arange(len(motion.time))
        columns = {
            "observation.state": pa.array(list(motion.position.reshape(len(frames), -1).astype(np.float32))),
            "action": pa.array(list(motion.command[: len(frames)].astype(np.float32))),
            "timestamp": pa.array((step * frames).astype(np.float32)),
            "frame_index": pa.array(frames),
            "episode_index": pa.array(np.full(len(frames), number)),
        }
        tables.append(pa.table(columns))
        facts.append({"episode_index": number, "tasks": ["sway"], "length": len(frames)})
    second = version.startswith("v2")
    path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info = {
        "codebase_version": version,
        "fps": round(1.0 / step),
        "chunks_size": 1000,
        "total_episodes": len(motions),
        "data_path": path if second else "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": features,
    }
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    if second:
        (folder / "meta" / "episodes.jsonl").write_text("".join(json.dumps(fact) + "\n" for fact in facts))
        for number, table in enumerate(tables):
            parquet.write_table(table, folder / path.format(episode_chunk=0, episode_index=number))
        return folder
    (folder / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
    listed = [fact | {"data/chunk_index": 0, "data/file_index": 0} for fact in facts]
    parquet.write_table(pa.Table.from_pylist(listed), folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    parquet.write_table(pa.concat_tables(tables), folder / "data" / "chunk-000" / "file-000.parquet")
    return folder
