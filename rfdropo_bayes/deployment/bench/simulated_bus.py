"""Simulated drives of a robot in their own process, with a plant behind them, and the hub that they share."""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bench.hub import Hub
from rfdropo_bayes.deployment.bench.plant import START, PlantHere, PlantProcess, build_plant
from rfdropo_bayes.deployment.bench.simulated_node import SimulatedNode
from rfdropo_bayes.deployment.bus import BusTable, open_bus
from rfdropo_bayes.deployment.clock import real_time, steady_interpreter
from rfdropo_bayes.deployment.objects import Object, of_axis
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot

TICK = 0.002  # [s]: drives check their guards and move between frames
PLANT_PERIOD = 0.01  # [s]: time between updates of plant and markers without SYNC
DATAGRAM = struct.Struct("<4sId")
MAGIC = b"RFMK"


class SimulationTable(NamedTuple):
    """Settings of a simulation."""

    robot: str  # name or path of a robot with motors
    bus: BusTable  # the bus that the drives are on
    # plant, settings: see `build_plant`
    plant: str = "springs"
    settings: Mapping[str, Any] = {}
    own_process: bool = False  # whether the plant runs in its own process
    markers: str = ""  # "HOST:PORT" that markers are sent to; empty for none
    encoder_offset: int = 0  # counts that every encoder shows at length zero, less the motor's own offset
    start_length_m: float = 0.0  # cable on every drum at power-on
    values: Mapping[tuple[int, int], int] = {}  # entries of every node's dictionary, as for `SimulatedNode`
    eds: str = str(objects.SIMULATED_EDS)  # data sheet of the drives


class SimulatedDrives:
    """All drives of a robot on one bus, fed by one thread.

    The plant is computed while the time from one SYNC to the next passes, with the positions that the drives will have
    then: status, tensions and markers of a cycle belong to one instant.
    """

    def __init__(self, robot: Robot, table: SimulationTable, bus: can.BusABC, plant: PlantHere | PlantProcess) -> None:
        if not robot.motors:
            raise InputError("has no motors", where=f"robot {robot.name}", remedy="add [[motors]], one per channel")
        self.robot, self._bus, self._plant = robot, bus, plant
        self._zero = [motor.offset_counts + table.encoder_offset for motor in robot.motors]
        self._start = [
            motor.counts(table.start_length_m, zero) for motor, zero in zip(robot.motors, self._zero, strict=True)
        ]
        self.nodes = {number: self._node(number, table) for number in dict.fromkeys(m.node for m in robot.motors)}
        self.drives = [self.nodes[motor.node].drives[motor.axis - 1] for motor in robot.motors]
        for motor, drive in zip(robot.motors, self.drives, strict=True):
            drive.counts_per_turn = motor.counts_per_turn
        self._markers = _marker_socket(table.markers)
        self._next_plant = self._reached = time.monotonic()
        plant.request(self.lengths(), 0.0)
        self.state = plant.newest()
        self._frame = 0

    def _node(self, number: int, table: SimulationTable) -> SimulatedNode:
        rows = zip(self.robot.motors, self._start, strict=True)
        mine = {motor.axis: (motor, start) for motor, start in rows if motor.node == number}
        rated = {
            (of_axis(Object.RATED_TORQUE, axis), 0): round(1e3 * motor.rated_torque_n_m)
            for axis, (motor, _) in mine.items()
        }
        positions = [mine[axis][1] if axis in mine else 0 for axis in range(1, max(mine) + 1)]
        return SimulatedNode(number, self._send, positions, table.eds, rated | dict(table.values))

    def lengths(self, ahead: float = 0.0) -> np.ndarray:
        """Cable on each drum [m], now or a time ahead [s]."""
        rows = zip(self.robot.motors, self.drives, self._zero, strict=True)
        return np.array([motor.length(drive.ahead(ahead), zero) for motor, drive, zero in rows])

    def _send(self, identifier: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def run(self, stop: threading.Event) -> None:
        """Run until told to stop, or until the bus closes.

        Ticks that a slow plant has cost are left out, so that the next one lies ahead: the thread sleeps until then,
        and the hub, of the same priority, has its turn on the same processor.
        """
        due = time.monotonic()
        while not stop.is_set():
            now = time.monotonic()
            message = self._bus.recv(max(0.0, due - now))
            now = time.monotonic()
            if message is not None and not (message.is_remote_frame or message.is_error_frame):
                beat = message.arbitration_id == objects.SYNC
                if beat:
                    self._show(now)
                for node in self.nodes.values():
                    node.receive(message.arbitration_id, bytes(message.data), now)
                if beat:
                    period = self.drives[0].interpolation_time or PLANT_PERIOD
                    self._next_plant = now + 2.5 * period
                    self._request(now, period)
            if now >= due:
                self.tick(now)
                due += TICK * max(1, math.ceil((time.monotonic() - due) / TICK))

    def tick(self, now: float) -> None:
        """Let time pass for the drives, and for the plant if no SYNC drives it."""
        for node in self.nodes.values():
            node.tick(now)
        if now < self._next_plant:
            return
        self._next_plant = max(self._next_plant + PLANT_PERIOD, now)
        self._show(now)
        self._request(now, 0.0)

    def _request(self, now: float, ahead: float) -> None:
        """Ask the plant for its state at a time ahead of now."""
        duration = now + ahead - self._reached
        if duration > 0.0:
            self._plant.request(self.lengths(ahead), duration)
            self._reached = now + ahead

    def _show(self, now: float) -> None:
        """Torques and markers as the plant has them by now."""
        self.state = self._plant.newest()
        for motor, drive, tension in zip(self.robot.motors, self.drives, self.state.tension, strict=True):
            drive.torque = motor.sign * motor.per_mille(float(tension))
        if self._markers is not None:
            self._frame += 1
            late = self._plant.late if isinstance(self._plant, PlantProcess) else 0.0
            header, pose = DATAGRAM.pack(MAGIC, self._frame, now - late), self.state.object_pose
            seen = np.append(self.state.position, () if pose is None else pose)
            with contextlib.suppress(OSError):  # nobody listens
                self._markers.send(header + np.asarray(seen, dtype="<f8").tobytes())


def _marker_socket(address: str) -> socket.socket | None:
    if not address:
        return None
    host, _, port = address.rpartition(":")
    if not port.isdigit():
        raise InputError(
            f"{address!r} is not of the form HOST:PORT", where="markers", remedy="give one, 127.0.0.1:5100"
        )
    connection = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    connection.connect((host or "127.0.0.1", int(port)))
    connection.setblocking(False)
    return connection


def serve(table: SimulationTable, ready: Path | None = None) -> None:
    """Run the drives until SIGINT or SIGTERM, with a hub of their own if the bus is one and nobody serves it.

    Args:
        table: settings of the simulation.
        ready: file to write the channel of the bus to once the drives are on it.

    Raises:
        InputError: for a robot without motors, an unknown plant, or a bus that cannot be opened.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with contextlib.ExitStack() as stack:
        bus_table = table.bus
        if table.bus.interface == "hub":
            bus_table = stack.enter_context(_hub_process(table.bus))
        bus = open_bus(bus_table)
        stack.callback(bus.shutdown)
        robot = Robot.load(table.robot)
        if table.own_process:
            process = PlantProcess(table.plant, robot, table.settings)
            stack.callback(process.close)
            plant: PlantHere | PlantProcess = process
        else:
            plant = PlantHere(build_plant(table.plant, robot, table.settings))
        drives = SimulatedDrives(robot, table, bus, plant)
        with real_time(), steady_interpreter():  # left before the processes of plant and hub are waited for
            if ready is not None:  # last of all: making the interpreter steady takes longer than an SDO client waits
                ready.write_text(bus_table.channel, encoding="utf-8")
            with contextlib.suppress(can.CanError):  # the bus has gone, and the drives with it
                drives.run(stop)


@contextlib.contextmanager
def _hub_process(table: BusTable) -> Iterator[BusTable]:
    """A hub in a child process, which ends with its parent."""
    program = "import sys; from rfdropo_bayes.deployment.bench.simulated_bus import run_hub; run_hub(sys.argv[1])"
    process = subprocess.Popen([sys.executable, "-c", program, table.channel], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        channel = process.stdout.readline().strip()
        if not channel:
            raise InputError(f"the hub does not start at {table.channel}", where="bus.channel", remedy="choose another")
        yield table.model_copy(update={"channel": channel})
    finally:
        process.terminate()
        process.wait(5.0)
        if process.stdout is not None:
            process.stdout.close()


def run_hub(channel: str) -> None:
    """Body of the hub's process: reports the address it listens on, and ends with its parent."""
    hub, parent = Hub(channel), os.getppid()
    print(hub.channel, flush=True)
    with real_time(), steady_interpreter():
        hub.serve(stop=lambda: os.getppid() != parent)


@contextlib.contextmanager
def simulated_drives(table: SimulationTable) -> Iterator[BusTable]:
    """The drives in their own process; yields the bus to find them on.

    Raises:
        InputError: the drives do not start; the message includes their output.
    """
    with tempfile.TemporaryDirectory(prefix="rfdropo_") as folder:
        ready, errors = Path(folder) / "ready", Path(folder) / "errors"
        values = [[index, subindex, value] for (index, subindex), value in table.values.items()]
        description = json.dumps(
            table._asdict() | {"bus": table.bus.model_dump(), "values": values, "settings": dict(table.settings)}
        )
        program = (
            "import sys; from rfdropo_bayes.deployment.bench.simulated_bus import main; main(sys.argv[1], sys.argv[2])"
        )
        with errors.open("w") as sink:
            command = [sys.executable, "-c", program, description, str(ready)]
            process = subprocess.Popen(command, stderr=sink)
        try:
            end = time.monotonic() + START
            while not (ready.is_file() and ready.read_text(encoding="utf-8")):
                if process.poll() is not None or time.monotonic() > end:
                    said = errors.read_text(encoding="utf-8").strip().splitlines() or ["no word"]
                    raise InputError(f"they do not start: {said[-1]}", where="simulated drives")
                select.select([], [], [], 0.02)
            yield table.bus.model_copy(update={"channel": ready.read_text(encoding="utf-8")})
        finally:
            process.terminate()
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def main(description: str, ready: str) -> None:
    """Body of the drives' process."""
    content = json.loads(description)
    values = {(index, subindex): value for index, subindex, value in content.pop("values")}
    bus = BusTable.model_validate(content.pop("bus"))
    try:
        serve(SimulationTable(bus=bus, values=values, **content), Path(ready))
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
