"""Drives for tests: in this process, on a hub of their own, fed by a thread."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import can
import pytest

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bench.hub import Hub, HubBus
from rfdropo_bayes.deployment.bench.plant import PlantHere, SpringCables
from rfdropo_bayes.deployment.bench.simulated_bus import SimulatedDrives, SimulationTable
from rfdropo_bayes.deployment.bus import BusTable, LoggedNetwork
from rfdropo_bayes.deployment.drives import Drives, Guards, drives_of
from rfdropo_bayes.deployment.log import SessionLog
from rfdropo_bayes.deployment.loop import ControlLoop
from rfdropo_bayes.deployment.sensors import MarkerView, SensorTable, SimulatedMarkers
from rfdropo_bayes.deployment.settings import SafetyTable
from rfdropo_bayes.robots import Robot

ROBOT = "motor_arm"

# A loaded machine without real-time scheduling is no robot: tests ask what happens, not how punctually.
SEEN_LATE = SensorTable(stale_s=1.0, lost_s=1.0)  # a busy machine delivers frames late
PATIENT = SafetyTable(settle_s=0.1, misses=50, stale_cycles=30, heartbeat_s=1.0, following_error_m=0.02)


class Session(NamedTuple):
    """A control loop, what it writes to, what it sees by, and what it has said."""

    loop: ControlLoop
    log: SessionLog
    sensor: SimulatedMarkers
    said: list[str]


class Rig:
    """Simulated drives and a network that sees them."""

    def __init__(self, channel: str, robot: Robot, **table: object) -> None:
        self.robot, self.channel = robot, channel
        bus = BusTable(interface="hub", channel=channel)
        self._bus = HubBus(channel)
        plant = PlantHere(SpringCables(robot))
        self.simulated = SimulatedDrives(robot, SimulationTable(ROBOT, bus, **table), self._bus, plant)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()
        self.network = LoggedNetwork(HubBus(channel))

    def _serve(self) -> None:
        with contextlib.suppress(can.CanError):
            self.simulated.run(self._stop)

    def drives(
        self,
        guards: Guards | None = None,
        eds: str = str(objects.SIMULATED_EDS),
        answer: float = 1.0,
        network: LoggedNetwork | None = None,
    ) -> Drives:
        """The master's side."""
        network = self.network if network is None else network  # an empty network is false
        offsets = [motor.offset_counts for motor in self.robot.motors]
        made = drives_of(network, self.robot.motors, offsets, eds, answer)
        return Drives(network, made, guards or Guards())

    @contextlib.contextmanager
    def session(self, folder: Path, bus: can.BusABC | None = None) -> Iterator[Session]:
        """A loop on configured drives, by a bus of its own if one is given."""
        network = self.network if bus is None else LoggedNetwork(bus)
        drives = self.drives(Guards(master_timeout_s=5.0), network=network)
        drives.configure(0.01, lambda text: None)
        names, log, said = self.robot.marker_names, SessionLog(folder, self.robot, {}), list[str]()
        sensor = SimulatedMarkers(len(names))
        markers = MarkerView(sensor, SensorTable(), names)
        loop = ControlLoop(self.robot, drives, markers, log, PATIENT, 0.01, said.append)
        try:
            yield Session(loop, log, sensor, said)
        finally:
            sensor.close()
            log.close()
            if bus is not None:
                with contextlib.suppress(can.CanError):
                    network.disconnect()

    def close(self) -> None:
        """Let go of threads and sockets."""
        with contextlib.suppress(can.CanError):
            self.network.disconnect()
        self._stop.set()
        self._thread.join(5.0)
        self._bus.shutdown()


@pytest.fixture(scope="session")
def robot() -> Robot:
    """A robot with four motors."""
    return Robot.load(ROBOT)


@contextlib.contextmanager
def serving(channel: str) -> Iterator[str]:
    """A hub in a thread."""
    server, done = Hub(channel), threading.Event()
    thread = threading.Thread(target=server.serve, args=(done.is_set,), daemon=True)
    thread.start()
    yield server.channel
    done.set()
    thread.join(5.0)


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[str]:
    """Channel of a hub on a Unix socket."""
    with serving(str(tmp_path / "bus")) as channel:
        yield channel


@pytest.fixture
def tcp_hub() -> Iterator[str]:
    """Channel of a hub on TCP."""
    with serving("127.0.0.1:0") as channel:
        yield channel


@pytest.fixture
def rig(hub: str, robot: Robot) -> Iterator[Rig]:
    """Four drives, found where length is zero."""
    made = Rig(hub, robot)
    yield made
    made.close()
