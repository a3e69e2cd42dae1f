"""The CAN bus of a session: any interface of python-can, or our hub; every received and sent frame is logged."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

import can
import canopen
from pydantic import BaseModel, ConfigDict, Field

from rfdropo_bayes.deployment.bench.hub import HubBus
from rfdropo_bayes.errors import InputError

_RETRY = 0.02  # [s]: between two tries to receive from a bus that fails


class BusTable(BaseModel):
    """The table [bus] of a deployment file.

    Attributes:
        interface: "hub", or any interface of python-can ("socketcan" on a robot).
        channel: channel of the interface; HOST:PORT or a path for the hub.
        bitrate: bit rate [bit/s], for interfaces that set a bit rate.
        options: further arguments of the interface.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: int | None = Field(default=None, gt=0)
    options: dict[str, Any] = {}


def open_bus(table: BusTable) -> can.BusABC:
    """Open the bus.

    Raises:
        InputError: the bus cannot be opened; the message names the interface and the reason.
    """
    if table.interface == "hub":
        return HubBus(table.channel, **table.options)
    options: dict[str, Any] = {} if table.bitrate is None else {"bitrate": table.bitrate}
    if table.interface == "udp_multicast":  # no frame may leave the machine, to drive motors of others in the network
        options["hop_limit"] = 0
    try:
        return can.Bus(interface=table.interface, channel=table.channel, **(options | table.options))
    except Exception as error:  # each interface passes on the exceptions of its driver
        raise InputError(
            f"cannot be opened ({type(error).__name__}: {error})",
            where=f"bus {table.interface} {table.channel}",
            remedy="bring the interface up (ip link set can0 up type can bitrate 1000000), or correct [bus]",
        ) from None


class FrameLog(can.Listener):
    """Every frame in a file that python-can chooses by its ending: .log (candump), .blf, .asc, .csv."""

    def __init__(self, path: Path) -> None:
        self._writer = can.Logger(str(path))
        self._waiting: deque[can.Message] = deque()

    def on_message_received(self, msg: can.Message) -> None:
        """Keep a frame for the next `flush`: sender and receiver must not wait for a disk."""
        self._waiting.append(msg)

    def flush(self) -> None:
        """Write the frames, and hand them to the operating system."""
        while self._waiting:
            self._writer.on_message_received(self._waiting.popleft())
        file = getattr(self._writer, "file", None)
        if file is not None:
            with contextlib.suppress(ValueError):  # closed meanwhile
                file.flush()

    def stop(self) -> None:
        """Close the file."""
        self.flush()
        self._writer.stop()


class Reception(can.Listener):
    """Keeps the first exception of the receiving thread, of any type: adapters pass on the exceptions of their drivers.

    python-can continues to receive after it, so that the drives' status is seen while they brake.
    """

    def __init__(self) -> None:
        self._lost: Exception | None = None
        self._told = False

    def on_message_received(self, msg: can.Message) -> None:
        """Frames are taken by the other listeners."""

    def on_error(self, exc: Exception) -> None:
        """Keep an exception; the wait keeps a bus that fails at once from taking the whole processor."""
        self._lost = self._lost or exc
        time.sleep(_RETRY)

    def check(self) -> None:
        """Raise the stored exception, once: the caller then stops the drives and must not be interrupted again.

        Raises:
            CanOperationError: if reception has failed.
        """
        if self._lost is not None and not self._told:
            self._told = True
            raise can.CanOperationError(f"reception has failed: {_words(self._lost)}")


class LoggedNetwork(canopen.Network):
    """canopen's network on an open bus, with a log of the frames of both directions.

    All that the bus raises, of whatever type, leaves this class as a CanError.
    """

    def __init__(self, bus: can.BusABC, log: FrameLog | None = None) -> None:
        super().__init__(bus)
        self._log, self._reception = log, Reception()
        listeners: list[can.Listener] = [*self.listeners, self._reception, *([log] if log is not None else [])]
        self.listeners = listeners  # type: ignore[assignment]
        before = set(threading.enumerate())
        self.connect()
        self.receivers = set(threading.enumerate()) - before
        """Threads that python-can receives with; they need the control loop's priority."""

    def check(self) -> None:
        """Raise a CanError if reception has failed; the first call alone does."""
        self._reception.check()

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        """Send a frame.

        Raises:
            CanError: the bus rejects the frame, or (raised once) reception has failed.
        """
        message = can.Message(is_extended_id=can_id > 0x7FF, arbitration_id=can_id, data=data, is_remote_frame=remote)
        with self.send_lock:
            if self.bus is None:
                raise can.CanOperationError("the bus is closed")
            try:
                self.bus.send(message)
            except can.CanError:
                raise
            except Exception as error:
                raise can.CanOperationError(_words(error)) from None
            if self._log is not None:
                message.is_rx = False
                message.timestamp = time.time()
                self._log.on_message_received(message)
        self.check()

    def disconnect(self) -> None:
        """Close the bus.

        Raises:
            CanError: the driver fails.
        """
        try:
            super().disconnect()
        except can.CanError:
            raise
        except Exception as error:
            raise can.CanOperationError(_words(error)) from None


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
