"""The object dictionary of a simulated drive and its SDO server: canopen's, made to obey CiA 301 strictly."""

from __future__ import annotations

import struct
from typing import Any

import canopen
from canopen.objectdictionary import ODVariable
from canopen.sdo import SdoAbortedError, SdoServer
from canopen.sdo.constants import (
    EXPEDITED,
    NO_MORE_DATA,
    REQUEST_ABORTED,
    REQUEST_BLOCK_UPLOAD,
    REQUEST_SEGMENT_DOWNLOAD,
    REQUEST_SEGMENT_UPLOAD,
    SIZE_SPECIFIED,
)

NO_SUCH_SUBINDEX = 0x06090011
READ_ONLY = 0x06010002


WRONG_LENGTH = 0x06070010
INVALID_COMMAND = 0x05040001


class StrictNode(canopen.LocalNode):
    """A node with subindex 0 only for a plain variable; it answers by `StrictServer`."""

    def __init__(self, node_id: int, object_dictionary: canopen.ObjectDictionary) -> None:
        super().__init__(node_id, object_dictionary)
        self.sdo = StrictServer(0x600 + node_id, 0x580 + node_id, self)

    def _find_object(self, index: int, subindex: int) -> Any:
        if subindex and isinstance(self.object_dictionary.get(index), ODVariable):
            raise SdoAbortedError(NO_SUCH_SUBINDEX)
        return super()._find_object(index, subindex)

    def variable(self, index: int, subindex: int) -> ODVariable:
        """An object.

        Raises:
            SdoAbortedError: the object is not in the data sheet.
        """
        return self._find_object(index, subindex)


class StrictServer(SdoServer):
    """An SDO server without block transfer, which enforces the order of segmented transfers.

    Segments without a started transfer, or of the other direction, are aborted. A download whose length differs from
    the announced length is aborted. A download that cannot be written is aborted at its first frame. An expedited
    download without a length takes the object's length. Frames that are not eight bytes long are ignored.
    """

    def __init__(self, rx_cobid: int, tx_cobid: int, node: StrictNode) -> None:
        super().__init__(rx_cobid, tx_cobid, node)
        self._running: int | None = None  # command of the segments that are awaited
        self._announced: int | None = None  # length of a download [bytes]

    def on_request(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Take a frame."""
        if len(data) != 8:
            return
        command = data[0] & 0xE0
        if command in (REQUEST_SEGMENT_UPLOAD, REQUEST_SEGMENT_DOWNLOAD):
            if self._running != command:
                self._index, self._subindex = self._index or 0, self._subindex or 0
                self.abort(INVALID_COMMAND)
                return
        else:
            self._running = None
            self._index, self._subindex = struct.unpack_from("<HB", data, 1)
        if command == REQUEST_BLOCK_UPLOAD and data[5] == 0:  # the client does not allow another protocol
            self.abort(INVALID_COMMAND)
        elif command != REQUEST_ABORTED:
            super().on_request(can_id, data, timestamp)

    def init_upload(self, request: bytearray) -> None:
        """Begin an upload."""
        self._buffer = None
        super().init_upload(request)
        if self._buffer:
            self._running = REQUEST_SEGMENT_UPLOAD

    def segmented_upload(self, command: int) -> None:
        """Send the next segment."""
        super().segmented_upload(command)
        if not self._buffer:
            self._running = None

    def init_download(self, request: bytearray) -> None:
        """Begin a download; SdoAbortedError if the object is read-only."""
        index, subindex = struct.unpack_from("<HB", request, 1)
        variable = self._node.variable(index, subindex)
        if not variable.writable:
            raise SdoAbortedError(READ_ONLY)
        if request[0] & EXPEDITED:
            if not request[0] & SIZE_SPECIFIED:
                size = min(4, max(1, len(variable) // 8))
                request = bytearray(request)
                request[0] |= SIZE_SPECIFIED | (4 - size) << 2
        else:
            self._running = REQUEST_SEGMENT_DOWNLOAD
            self._announced = struct.unpack_from("<L", request, 4)[0] if request[0] & SIZE_SPECIFIED else None
        super().init_download(request)

    def segmented_download(self, command: int, request: bytearray) -> None:
        """Take the next segment; SdoAbortedError if the length differs from the announced length."""
        size = len(self._buffer or b"") + 7 - (command >> 1 & 7)
        beyond = self._announced is not None and size > self._announced
        if beyond or (command & NO_MORE_DATA and self._announced not in (None, size)):
            raise SdoAbortedError(WRONG_LENGTH)
        super().segmented_download(command, request)
        if command & NO_MORE_DATA:
            self._running = None

    def abort(self, abort_code: int = 0x08000000) -> None:
        """End the transfer."""
        self._running = None
        super().abort(abort_code)
