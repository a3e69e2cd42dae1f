"""A CAN bus between processes that needs no kernel CAN: every client sees the frames of all others, in one order.

Frames travel as the kernel's own ``struct can_frame`` (16 bytes, little-endian: identifier with flags, length, three
bytes of padding, eight of data) over TCP, or over a Unix socket. A client takes a few lines in any language.
"""

from __future__ import annotations

import os
import select
import selectors
import socket
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can

from rfdropo_bayes.errors import InputError

FRAME = struct.Struct("<IB3x8s")
EXTENDED, REMOTE, ERROR = 0x80000000, 0x40000000, 0x20000000
_SEND_TIMEOUT = struct.pack("ll", 0, 50_000)  # 50 ms: a control loop must not hang with its hub
_QUEUE = 1 << 20  # [bytes]: sixty thousand frames, a quarter of an hour of nothing read


def encode(message: can.Message) -> bytes:
    """The 16 bytes of a frame."""
    identifier = message.arbitration_id
    identifier |= EXTENDED if message.is_extended_id else 0
    identifier |= REMOTE if message.is_remote_frame else 0
    identifier |= ERROR if message.is_error_frame else 0
    return FRAME.pack(identifier, message.dlc, bytes(message.data))


def decode(frame: bytes | memoryview, timestamp: float) -> can.Message:
    """The frame encoded in 16 bytes."""
    identifier, length, data = FRAME.unpack(frame)
    return can.Message(
        timestamp=timestamp,
        arbitration_id=identifier & 0x1FFFFFFF,
        is_extended_id=bool(identifier & EXTENDED),
        is_remote_frame=bool(identifier & REMOTE),
        is_error_frame=bool(identifier & ERROR),
        dlc=min(length, 8),
        data=None if identifier & REMOTE else data[: min(length, 8)],
    )


def address_of(channel: str) -> tuple[int, Any]:
    """Family and address of "HOST:PORT", or of the path of a Unix socket.

    Raises:
        InputError: for anything else.
    """
    if "/" in channel:
        return socket.AF_UNIX, channel
    host, _, port = channel.rpartition(":")
    if not host or not port.isdigit():
        raise InputError(
            f"{channel!r} is not a channel of a hub", where="bus.channel", remedy="give HOST:PORT or a path"
        )
    return socket.AF_INET, (host, int(port))


class HubBus(can.BusABC):
    """A client of the hub, as a python-can bus.

    Args:
        channel: "HOST:PORT", or the path of a Unix socket.
        patience: longest wait for the hub to appear [s].
    """

    def __init__(self, channel: str, patience: float = 5.0, **settings: Any) -> None:
        family, address = address_of(channel)
        self.channel_info = f"hub at {channel}"
        self._received = bytearray()
        self._socket = _connect(family, address, patience)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _SEND_TIMEOUT)
        super().__init__(channel=channel, **settings)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame.

        Raises:
            CanOperationError: if the hub has gone.
        """
        try:
            self._socket.sendall(encode(msg))
        except OSError as error:
            raise can.CanOperationError(f"the hub has gone ({error})") from None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        end = None if timeout is None else time.monotonic() + timeout
        while len(self._received) < FRAME.size:
            remaining = None if end is None else max(0.0, end - time.monotonic())
            try:
                if not select.select([self._socket], [], [], remaining)[0]:
                    return None, False
                data = self._socket.recv(65536)
            except (OSError, ValueError) as error:  # ValueError: closed by another thread
                raise can.CanOperationError(f"the hub has gone ({error})") from None
            if not data:
                raise can.CanOperationError("the hub has gone")
            self._received += data
        frame = bytes(self._received[: FRAME.size])
        del self._received[: FRAME.size]
        return decode(frame, time.time()), False

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self._socket.close()


def _connect(family: int, address: Any, patience: float) -> socket.socket:
    end = time.monotonic() + patience
    while True:
        connection = socket.socket(family, socket.SOCK_STREAM)
        try:
            connection.connect(address)
        except OSError as error:
            connection.close()
            if time.monotonic() > end:
                raise InputError(
                    f"no hub answers at {address} ({error})",
                    where="bus",
                    remedy="start one with `rfdropo drives`, or correct the channel",
                ) from None
            time.sleep(0.02)
            continue
        if family == socket.AF_INET:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection


class _Client:
    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.received, self.to_send = bytearray(), bytearray()


class Hub:
    """The server: passes every frame on to all other clients. A client that stops reading is let go.

    Args:
        channel: "HOST:PORT" (port 0 takes a free one), or the path of a Unix socket.

    Raises:
        InputError: if the address is taken.
    """

    def __init__(self, channel: str) -> None:
        family, address = address_of(channel)
        if family == socket.AF_UNIX and os.path.exists(address):
            Path(address).unlink()
        self._listener = socket.socket(family, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind(address)
        except OSError as error:
            raise InputError(
                f"cannot listen at {channel} ({error})", where="bus.channel", remedy="choose another"
            ) from None
        self._listener.listen()
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._clients: set[_Client] = set()
        name = self._listener.getsockname()
        self.channel = channel if family == socket.AF_UNIX else f"{name[0]}:{name[1]}"

    def serve(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Pass frames on until ``stop`` returns True; it is called twice a second."""
        try:
            while not stop():
                for key, events in self._selector.select(0.5):
                    if key.fileobj is self._listener:
                        self._accept()
                    elif events & selectors.EVENT_READ:
                        self._read(key.data)
                    elif key.data in self._clients:
                        self._flush(key.data)
        finally:
            for client in list(self._clients):
                self._drop(client)
            self._selector.unregister(self._listener)
            self._listener.close()
            self._selector.close()

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        if connection.family == socket.AF_INET:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = _Client(connection)
        self._clients.add(client)
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _read(self, client: _Client) -> None:
        if client not in self._clients:
            return
        try:
            data = client.connection.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        client.received += data
        whole = len(client.received) - len(client.received) % FRAME.size
        frames = bytes(client.received[:whole])
        del client.received[:whole]
        if frames:
            for other in list(self._clients - {client}):
                other.to_send += frames
                self._flush(other)

    def _flush(self, client: _Client) -> None:
        try:
            sent = client.connection.send(client.to_send)
            del client.to_send[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return
        if len(client.to_send) > _QUEUE:
            self._drop(client)
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.to_send else 0)
        if self._selector.get_key(client.connection).events != wanted:
            self._selector.modify(client.connection, wanted, client)

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.discard(client)
            self._selector.unregister(client.connection)
            client.connection.close()
