"""Whatever a bus raises, in sending, receiving or closing: it leaves the network as a CanError, and the drives stop."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest

from rfdropo_bayes.deployment.bench.hub import HubBus
from rfdropo_bayes.deployment.bus import LoggedNetwork
from rfdropo_bayes.deployment.causes import Cause, Stop
from rfdropo_bayes.deployment.cia402 import DriveState
from rfdropo_bayes.deployment.log import read_journal
from rfdropo_bayes.deployment.loop import ControlLoop, Phase
from rfdropo_bayes.deployment.sensors import Sighting

from .conftest import Session

ANYTHING = [
    ValueError("garbled"),
    OSError(100, "down"),
    struct.error("short"),
    KeyError("x"),
    can.CanOperationError("y"),
]


class Failing(can.BusABC):
    """A bus on a hub, or on nothing, whose methods raise what they are told to."""

    def __init__(self, inner: can.BusABC | None = None) -> None:
        self._inner = inner
        self.channel_info = "failing"
        self.raising: dict[str, Exception] = {}
        super().__init__(channel=None)

    def _fail(self, method: str) -> None:
        if method in self.raising:
            raise self.raising[method]

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._fail("send")
        if self._inner is not None:
            self._inner.send(msg, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._fail("recv")
        if self._inner is not None:
            return self._inner._recv_internal(timeout)
        time.sleep(0.002)
        return can.Message(arbitration_id=0x7FF, is_extended_id=False), False

    def shutdown(self) -> None:
        super().shutdown()
        if self._inner is not None:
            self._inner.shutdown()
        self._fail("shutdown")


@pytest.mark.parametrize("error", ANYTHING, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("method", ["send", "shutdown"])
def test_whatever_a_bus_raises_is_an_error_of_the_bus(method: str, error: Exception) -> None:
    bus = Failing()
    bus.raising[method] = error
    network = LoggedNetwork(bus)
    if method == "send":
        with pytest.raises(can.CanError, match=str(error.args[-1])):
            network.send_message(0x80, b"")
        network.disconnect()
    else:
        with pytest.raises(can.CanError, match=str(error.args[-1])):
            network.disconnect()


@pytest.mark.parametrize("error", ANYTHING, ids=lambda error: type(error).__name__)
def test_a_failure_of_reception_is_told_once_and_reception_goes_on(error: Exception) -> None:
    """Once: the frames that stop the drives, which come next, must go out."""
    bus = Failing()
    bus.raising["recv"] = error
    network = LoggedNetwork(bus)
    time.sleep(0.005)
    with pytest.raises(can.CanError, match=f"reception has failed: {type(error).__name__}"):
        network.send_message(0x80, b"")
    network.send_message(0x80, b"")
    bus.raising.clear()
    (receiver,) = network.receivers
    assert receiver.is_alive()
    network.disconnect()


def ended(session: Session, fail: Callable[[], object]) -> Stop:
    """How a loop ends in which something fails in the middle of a motion."""

    def phases(loop: ControlLoop) -> None:
        loop.enable()
        fail()
        loop.go_to(loop.set_points.length + 0.002, Phase.STARTING, 0.0)

    return session.loop.run(phases)


def braked(session: Session, rig) -> bool:
    """Whether the drives stopped, the loop looked on, and the journal has it."""
    session.log.flush()
    stopped = all(drive.state is DriveState.QUICK_STOP_ACTIVE for drive in rig.simulated.drives)
    phases = read_journal(session.log.folder)[1]["phase"]
    sent = not any("quick stop not sent" in line for line in session.said)
    return stopped and sent and np.count_nonzero(phases == Phase.BRAKED) > 3


def test_a_bus_that_garbles_frames_stops_the_drives(rig, tmp_path: Path) -> None:
    bus = Failing(HubBus(rig.channel))
    with rig.session(tmp_path, bus) as session:
        stop = ended(session, lambda: bus.raising.update(recv=ValueError("garbled")))
        assert stop.cause is Cause.SEND_ERROR
        assert "reception has failed: ValueError: garbled" in stop.detail
        assert braked(session, rig)


def test_a_sensor_that_raises_in_every_cycle_stops_the_drives(rig, tmp_path: Path, monkeypatch) -> None:
    def broken() -> Sighting:
        raise RuntimeError("the camera is off")

    with rig.session(tmp_path) as session:
        stop = ended(session, lambda: monkeypatch.setattr(session.sensor, "latest", broken))
        assert stop.cause is Cause.PROGRAM_ERROR
        assert "the camera is off" in stop.detail
        assert braked(session, rig)
