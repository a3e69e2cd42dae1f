"""The log of a session: a journal of every cycle that a crash cannot take back, and the recording made of it.

Each control cycle is one fixed-size record. A thread passes the records to the operating system, since a write may wait
for the disk. A killed program loses some hundredths of a second; a power failure loses at most the last second.
`session.nc` is written from the journal at the end, or after a crash.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Shaped

from rfdropo_bayes.data import Measured, Origin, SentCommands, Trajectory
from rfdropo_bayes.deployment.bus import FrameLog
from rfdropo_bayes.deployment.sensors import POSE
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import unwritten
from rfdropo_bayes.robots import Robot

JOURNAL, EVENTS, SESSION, FRAMES, SUMMARY = "cycles.bin", "log.jsonl", "session.nc", "frames.log", "summary.json"
FORMAT = "drive-session"
SCHEMA_VERSION = 3
_WRITE = 0.02  # [s]: time between writes
_SYNC = 1.0  # [s]: time between syncs of the disk
_HEADER = 4096  # [bytes]


def record_type(channels: int, markers: int) -> np.dtype[np.void]:
    """One cycle. Times in s (monotonic clock), lengths in m of cable, tensions in N, commands in the command unit."""
    return np.dtype(
        [
            ("time", "<f8"),
            ("lateness", "<f8"),
            ("missed", "<u2"),
            ("phase", "u1"),
            ("acted", "?"),  # a new command came into force in this cycle
            ("raw", "<f8", (channels,)),
            ("asked", "<f8", (channels,)),
            ("command", "<f8", (channels,)),
            ("set_point", "<f8", (channels,)),
            ("length", "<f8", (channels,)),
            ("tension", "<f8", (channels,)),
            ("fresh", "?", (channels,)),
            ("statusword", "<u2", (channels,)),
            ("controlword", "<u2", (channels,)),
            ("position", "<f8", (markers, 3)),
            ("seen", "?", (markers,)),
            ("object_pose", "<f8", (POSE,)),  # centre in m, quaternion x, y, z, w; last seen pose
            ("object_seen", "?"),  # anew
            ("seen_at", "<f8"),  # exposure time of the markers and the object in this cycle
        ]
    )


class SessionLog:
    """Writes a session's folder while it runs.

    Args:
        folder: folder to write to, without a session.
        robot: robot to drive.
        facts: facts about the session, kept in the recording's settings.

    Raises:
        InputError: if the folder holds a session, or cannot be written to.
    """

    def __init__(self, folder: Path, robot: Robot, facts: Mapping[str, Any]) -> None:
        self.folder = Path(folder)
        if (self.folder / JOURNAL).exists():
            raise InputError("holds a session already", where=str(folder), remedy="give another folder with --out")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._journal = os.open(self.folder / JOURNAL, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
            self._events = (self.folder / EVENTS).open("a", encoding="utf-8")
        except OSError as error:
            raise InputError(
                f"cannot be written ({error})", where=str(folder), remedy="choose another folder"
            ) from None
        header = {
            "robot": robot.model_dump(mode="json"),
            "facts": dict(facts),
            "wall_time": time.time(),
            "monotonic": time.monotonic(),
            "schema_version": SCHEMA_VERSION,
        }
        text = json.dumps(header).encode()
        size = _HEADER * (1 + len(text) // _HEADER)
        self._whole = 0  # bytes of the journal that are whole records
        try:
            self._append(str(size).encode().rjust(8) + text.ljust(size - 8))
        except OSError as error:
            raise unwritten(error, self.folder) from None
        self.record = np.zeros((), record_type(len(robot.channel_names), len(robot.marker_names)))
        self.frames = FrameLog(self.folder / FRAMES)
        self._records: deque[bytes] = deque()
        self._lines: deque[str] = deque()
        self._closed, self._writing = threading.Event(), threading.Lock()
        repeated = {"log": (self.flush, _WRITE), "log to disk": (self._sync, _SYNC)}
        self._threads = [
            threading.Thread(target=self._repeat, args=what, name=name, daemon=True) for name, what in repeated.items()
        ]
        for thread in self._threads:
            thread.start()

    def write(self) -> None:
        """Append ``record`` unchanged."""
        self._records.append(self.record.tobytes())

    def event(self, kind: str, text: str, **more: Any) -> None:
        """Add a line to log.jsonl."""
        line = {"time": time.time(), "monotonic": time.monotonic(), "event": kind, "text": text} | more
        self._lines.append(json.dumps(line) + "\n")

    def close(self) -> None:
        """End the journal.

        Raises:
            InputError: if a disk without room has not taken all of it.
        """
        self._closed.set()
        for thread in self._threads:
            thread.join()
        self.flush()
        self._sync()
        os.close(self._journal)
        try:
            self.frames.stop()
            self._events.close()
        except OSError as error:
            raise unwritten(error, self.folder) from None
        if self._records:
            lost = f"its last {len(self._records)} cycles could not be written"
            raise InputError(lost, where=str(self.folder / JOURNAL), remedy="make room on the disk")

    def _repeat(self, what: Callable[[], None], period: float) -> None:
        while not self._closed.wait(period):
            what()

    def flush(self) -> None:
        """Hand everything to the operating system; not for the thread that writes. Data that a full disk refuses wait
        for the next call: a robot in motion must not stop for it.
        """
        with self._writing, contextlib.suppress(OSError):
            while self._records:
                self._append(self._records[0])
                self._records.popleft()
            while self._lines:
                self._events.write(self._lines.popleft())
            self._events.flush()
            self.frames.flush()

    def _append(self, record: bytes) -> None:
        """Add bytes to the journal, all or none: behind a part of a record nothing could be read.

        Raises:
            OSError: the disk is full.
        """
        try:
            if os.write(self._journal, record) < len(record):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            os.ftruncate(self._journal, self._whole)
            os.lseek(self._journal, self._whole, os.SEEK_SET)
            raise
        self._whole += len(record)

    def _sync(self) -> None:
        with contextlib.suppress(OSError):  # a full disk must not stop a robot in motion; the end of the log says it
            os.fsync(self._journal)
            os.fsync(self._events.fileno())


def read_journal(folder: Path) -> tuple[dict[str, Any], Shaped[np.ndarray, " cycle"]]:
    """Header and records of a session; a record that a crash cut short is left out.

    Raises:
        InputError: if the journal is missing, or in another format.
    """
    path = Path(folder) / JOURNAL
    try:
        content = path.read_bytes()
        size = int(content[:8])
        header = json.loads(content[8:size])
    except (OSError, ValueError) as error:
        raise InputError(
            f"is not a journal of a session ({error})", where=str(path), remedy="give a session's folder"
        ) from None
    if header["schema_version"] != SCHEMA_VERSION:
        raise InputError(
            f"is of version {header['schema_version']} of the format, not {SCHEMA_VERSION}",
            where=str(path),
            remedy=f"read it with the version that wrote it; {SESSION} can be read by any",
        )
    robot = header["robot"]
    kind = record_type(len(robot["channels"]["names"]), len(robot["markers"]))
    whole = (len(content) - size) // kind.itemsize
    return header, np.frombuffer(content, kind, count=whole, offset=size)


def _seen_when(
    rows: Shaped[np.ndarray, " cycle"],
) -> tuple[Float[np.ndarray, "cycle marker 3"], Bool[np.ndarray, "cycle marker"], Float[np.ndarray, "cycle 7"] | None]:
    """Marker positions [m] in the cycle nearest to their exposure, a mask of new positions, and the object's pose. The
    pose is NaN in cycles without a sighting, and None if the object was never seen.
    """
    heard = np.flatnonzero(rows["seen"].any(axis=1) | rows["object_seen"])
    edges = 0.5 * (rows["time"][1:] + rows["time"][:-1])
    place = np.searchsorted(edges, rows["seen_at"][heard])
    position, seen = rows["position"].copy(), np.zeros_like(rows["seen"])
    position[place], seen[place] = rows["position"][heard], rows["seen"][heard]
    if not rows["object_seen"].any():
        return position, seen, None
    pose, sighted = np.full(rows["object_pose"].shape, np.nan), rows["object_seen"][heard]
    pose[place[sighted]] = rows["object_pose"][heard[sighted]]
    return position, seen, pose


def session_trajectory(folder: Path, phases: tuple[int, ...] | None = None) -> Trajectory:
    """The recording of a session, from its journal.

    Commands are stored at the policy's rate, after the limits on length and before the limits on rate and acceleration;
    drum angles [rad] are measured, tensions [N] come from the drives' torque. The tension is missing while a drive was
    silent. Statuswords, set-points and raw actions are stored outside the hash: they describe the session, not the
    robot's motion.

    Args:
        folder: folder of the session.
        phases: phases whose cycles are used, if there are at least two cycles.

    Raises:
        InputError: the journal has fewer than two cycles.
    """
    header, rows = read_journal(folder)
    robot = Robot.model_validate(header["robot"])
    before = rows["command"][:1]
    if phases is not None and np.count_nonzero(np.isin(rows["phase"], phases)) > 1:
        chosen = np.isin(rows["phase"], phases)
        before = rows["command"][max(int(np.argmax(chosen)) - 1, 0)][None]
        rows = rows[chosen]
    if len(rows) < 2:
        raise InputError(f"has {len(rows)} cycles", where=str(folder), remedy="there is nothing to make a recording of")
    position, seen, pose = _seen_when(rows)
    acted = np.flatnonzero(rows["acted"])
    first = acted if acted.size else np.array([0])
    radius = np.array([motor.drum_radius_m for motor in robot.motors])
    before = np.concatenate([before, rows["command"][: first[0]]])[-1]
    trajectory = Trajectory.build(
        Origin(
            name=Path(folder).name,
            robot=robot.name,
            format=FORMAT,
            synthetic=bool(header["facts"].get("simulated")),
            provenance=f"session of {time.strftime('%Y-%m-%d %H:%M:%S', time.gmtime(header['wall_time']))} UTC",
            settings=header["facts"] | ({} if seen.any() else {"unseen": True}),
        ),
        SentCommands(
            command_time=rows["time"][first],
            command=rows["command"][first],
            command_unit=robot.command_unit,
            cable_names=robot.channel_names,
            initial_command=before,
        ).trusted(),
        Measured(
            time=rows["time"],
            position=position,
            marker_names=robot.marker_names,
            position_mask=seen,
            tension=np.where(rows["fresh"], rows["tension"], np.nan),
            motor_angle=rows["length"] / radius,
            object_pose=pose,
        ),
    )
    cycle, command = ("time", "cable"), ("command_time", "cable")
    beside = {
        "set_point": xr.Variable(cycle, rows["set_point"], {"unit": "m"}),
        "length": xr.Variable(cycle, rows["length"], {"unit": "m"}),
        "statusword": xr.Variable(cycle, rows["statusword"]),
        "controlword": xr.Variable(cycle, rows["controlword"]),
        "phase": xr.Variable("time", rows["phase"]),
        "lateness": xr.Variable("time", rows["lateness"], {"unit": "s"}),
        "missed": xr.Variable("time", rows["missed"]),
        "raw_action": xr.Variable(command, rows["raw"][first]),
        "asked_command": xr.Variable(command, rows["asked"][first], {"unit": robot.command_unit}),
    }
    return Trajectory(trajectory.dataset.assign(beside))
