"""Sources of marker positions: motion capture (NatNet), a simulation, or a recording that is played again."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float
from pydantic import BaseModel, ConfigDict, Field, model_validator

from rfdropo_bayes.deployment.bench.simulated_bus import DATAGRAM, MAGIC
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot

POSE = 7  # numbers: centre, and quaternion x, y, z, w


class Sighting(NamedTuple):
    """The newest frame of markers."""

    number: int  # rises with every frame; 0 before the first
    time: float  # time of arrival [s, monotonic]
    position: Float[np.ndarray, "marker 3"]  # positions of the markers in the robot's base frame [m]
    seen: Bool[np.ndarray, " marker"]  # False for a lost marker, whose position is then invalid
    # centre [m] and unit quaternion x, y, z, w of the pushed object; None if it was not seen
    object_pose: Float[np.ndarray, "7"] | None = None


class MarkerSensor(Protocol):
    """A source of marker positions."""

    def latest(self) -> Sighting:
        """The newest frame; returns at once."""
        ...

    def close(self) -> None:
        """Let go of sockets and threads."""
        ...


class SensorTable(BaseModel):
    """The table [sensor] of a deployment file.

    Attributes:
        kind: "natnet", "simulated" or "none".
        server, local: addresses of Motive's machine and of this machine (natnet).
        multicast: whether Motive streams by multicast (natnet).
        rigid_bodies: marker name -> identifier of the rigid body in Motive (natnet).
        object_body: identifier of the rigid body that the robot pushes (natnet); its pivot is the object's centre.
            Create the rigid body in Motive while the object is aligned with the robot's base.
        rotation: rows of the matrix from the sensor's frame to the robot's base frame.
        origin_m: origin of the base frame in the sensor's frame.
        port: UDP port that a simulation sends to (simulated).
        stale_s: older frames count as lost.
        lost_s: a policy that sees markers or the object ends if a marker or the object is lost for this long.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    kind: Literal["natnet", "simulated", "none"] = "none"
    server: str = "127.0.0.1"
    local: str = "127.0.0.1"
    multicast: bool = True
    rigid_bodies: dict[str, int] = {}
    object_body: int | None = None
    rotation: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    port: int = Field(default=0, ge=0, le=65535)
    stale_s: float = Field(default=0.05, gt=0.0)
    lost_s: float = Field(default=0.05, gt=0.0)

    @model_validator(mode="after")
    def _consistent(self) -> SensorTable:
        matrix = np.array(self.rotation)
        if matrix.shape != (3, 3) or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3):
            raise ValueError("rotation is no rotation matrix")
        if np.linalg.det(matrix) < 0.0:
            raise ValueError("rotation is a reflection: an axis points the wrong way")
        return self


def _nothing(markers: int) -> Sighting:
    return Sighting(0, 0.0, np.zeros((markers, 3)), np.zeros(markers, dtype=bool))


class NoSensor:
    """No markers: all are lost."""

    def __init__(self, markers: int) -> None:
        self._sighting = _nothing(markers)

    def latest(self) -> Sighting:
        """Nothing seen."""
        return self._sighting

    def close(self) -> None:
        """Nothing to let go of."""


class SimulatedMarkers:
    """Markers of a simulation, which comes as UDP datagrams; the newest is kept.

    Args:
        markers: number of markers.
        port: local port to listen at; 0 takes a free port.
    """

    def __init__(self, markers: int, port: int = 0) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", port))
        except OSError as error:
            self._socket.close()
            raise InputError(f"port {port} is taken ({error})", where="sensor.port", remedy="choose another") from None
        self._socket.setblocking(False)
        self._sighting = _nothing(markers)

    @property
    def address(self) -> str:
        """Address to send to, HOST:PORT."""
        host, port = self._socket.getsockname()
        return f"{host}:{port}"

    def latest(self) -> Sighting:
        """Read the datagrams received so far; a datagram of another size belongs to another robot and is ignored."""
        markers = len(self._sighting.seen)
        size = DATAGRAM.size + 24 * markers
        while True:
            try:
                data = self._socket.recv(65536)
            except (BlockingIOError, OSError):
                return self._sighting
            if len(data) in (size, size + 8 * POSE) and data[:4] == MAGIC:
                numbers = np.frombuffer(data, dtype="<f8", offset=DATAGRAM.size).copy()
                position, pose = numbers[: 3 * markers].reshape(-1, 3), numbers[3 * markers :]
                seen = np.all(np.isfinite(position), axis=1)
                _, number, instant = DATAGRAM.unpack_from(data)  # of this machine's clock: the simulation runs here
                known = pose.size and np.all(np.isfinite(pose))
                self._sighting = Sighting(number, instant, position, seen, pose if known else None)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class NatNetMarkers:
    """Rigid bodies that OptiTrack's Motive streams, by the package natnet; each stands for one marker.

    Args:
        table: addresses, identifiers and frame.
        robot: robot with these markers.

    Raises:
        InputError: if a marker has no rigid body of its own, the package is missing, or Motive does not answer.
    """

    def __init__(self, table: SensorTable, robot: Robot) -> None:
        missing = [name for name in robot.marker_names if name not in table.rigid_bodies]
        if missing:
            raise InputError(
                f"marker {missing[0]!r} has no rigid body", where="sensor.rigid_bodies", remedy="give its identifier"
            )
        self._identifiers = {table.rigid_bodies[name]: place for place, name in enumerate(robot.marker_names)}
        if len(self._identifiers) < len(robot.marker_names):
            remedy = "give each marker its own identifier"
            raise InputError("two markers have the same rigid body", where="sensor.rigid_bodies", remedy=remedy)
        if table.object_body in self._identifiers:
            remedy = "give the identifier of the object's own"
            raise InputError(
                "a marker and the object have the same rigid body", where="sensor.object_body", remedy=remedy
            )
        self._object = table.object_body
        self._rotation, self._origin = np.array(table.rotation), np.array(table.origin_m)
        self._lock = threading.Lock()
        self._sighting = _nothing(len(robot.marker_names))
        self._client = self._connect(table)

    def _connect(self, table: SensorTable) -> Any:
        try:
            from natnet import NatNetClient, NatNetError
        except ImportError:
            raise InputError(
                "natnet is not installed", where="sensor", remedy="pip install rfdropo_bayes[deploy]"
            ) from None
        client = NatNetClient(table.server, table.local, use_multicast=table.multicast)
        client.on_data_frame_received_event.handlers.append(self.receive)
        try:
            client.connect(timeout=3.0)
            client.run_async()
        except (NatNetError, OSError) as error:
            raise InputError(
                f"Motive does not answer at {table.server} ({error})",
                where="sensor",
                remedy="switch streaming on in Motive, and check server and local",
            ) from None
        return client

    def receive(self, frame: Any) -> None:
        """Take a frame of natnet's: rigid bodies that are not tracked count as lost."""
        position, pose = self._sighting.position.copy(), None
        seen = np.zeros(len(position), dtype=bool)
        for body in frame.rigid_bodies:
            if body.tracking_valid is False or not np.all(np.isfinite(body.pos)):
                continue
            place = self._identifiers.get(body.id_num)
            if place is not None:
                position[place] = self._rotation @ (np.array(body.pos) - self._origin)
                seen[place] = True
            elif body.id_num == self._object:
                pose = self._pose(body)
        with self._lock:
            self._sighting = Sighting(self._sighting.number + 1, time.monotonic(), position, seen, pose)

    def _pose(self, body: Any) -> Float[np.ndarray, "7"] | None:
        """Centre, and the turn since the body was aligned with the base, both in the frame of the base."""
        quaternion = np.array(body.rot, dtype=float)
        if not np.all(np.isfinite(quaternion)) or not quaternion.any():
            return None
        # The same turn about an axis that is written in the frame of the base.
        turned = np.append(self._rotation @ quaternion[:3], quaternion[3]) / np.linalg.norm(quaternion)
        centre = self._rotation @ (np.array(body.pos) - self._origin)
        return np.concatenate([centre, turned if turned[3] >= 0.0 else -turned])

    def latest(self) -> Sighting:
        """The newest frame."""
        with self._lock:
            return self._sighting

    def close(self) -> None:
        """Stop streaming."""
        self._client.stop_async()
        self._client.shutdown()


def open_sensor(table: SensorTable, robot: Robot) -> MarkerSensor:
    """The sensor that the table describes.

    Raises:
        InputError: the server cannot be reached.
    """
    makers: Mapping[str, Callable[[], MarkerSensor]] = {
        "natnet": lambda: NatNetMarkers(table, robot),
        "simulated": lambda: SimulatedMarkers(len(robot.marker_names), table.port),
        "none": lambda: NoSensor(len(robot.marker_names)),
    }
    return makers[table.kind]()


class MarkerView:
    """A sensor as the control loop sees it: each marker's last good position, its age, its displacement; and the
    object.

    Args:
        sensor: sensor to read.
        table: gives the times after which a marker is stale or lost.
        names: names of the markers.
    """

    def __init__(self, sensor: MarkerSensor, table: SensorTable, names: tuple[str, ...]) -> None:
        self._sensor, self._table, self._names = sensor, table, names
        self.position = np.zeros((len(names), 3))
        self.moved = np.zeros((len(names), 3))  # between the last two acts
        self.fresh = np.zeros(len(names), dtype=bool)
        self.object_pose = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])  # the last good one
        self.object_fresh = False
        self.instant = 0.0  # of the newest frame [s, monotonic]
        self._last = np.full(len(names), -np.inf)  # time of the last good position
        self._object_last = -np.inf
        self._number = 0
        self._acted: np.ndarray | None = None

    def update(self, now: float) -> None:
        """Read the sensor, once per cycle."""
        self.fresh, self.object_fresh = np.zeros_like(self.fresh), False  # if the sensor raises, nothing was seen
        sighting = self._sensor.latest()
        new = sighting.number != self._number and now - sighting.time <= self._table.stale_s
        self._number, self.instant = sighting.number, sighting.time
        self.fresh = sighting.seen & new & np.all(np.isfinite(sighting.position), axis=1)
        self.position[self.fresh] = sighting.position[self.fresh]
        self._last[self.fresh] = sighting.time
        self.object_fresh = new and sighting.object_pose is not None
        if new and sighting.object_pose is not None:
            self.object_pose, self._object_last = sighting.object_pose, sighting.time

    def lost(self, now: float) -> str:
        """Name of a marker that has been lost for too long; empty if none."""
        gone = np.flatnonzero(now - self._last > self._table.lost_s)
        return self._names[gone[0]] if gone.size else ""

    def object_lost(self, now: float) -> bool:
        """Whether the object has been lost for too long."""
        return now - self._object_last > self._table.lost_s

    def act(self) -> None:
        """Note an act of the policy: marker displacements count from the previous act."""
        if self._acted is not None:
            self.moved = self.position - self._acted
        self._acted = self.position.copy()
