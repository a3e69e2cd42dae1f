"""A CANopen node as the master sees it: data sheet, SDOs and heartbeat, which all axes of one drive share."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

import can
import canopen
from canopen.objectdictionary import ODVariable
from canopen.sdo.exceptions import SdoError

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bus import LoggedNetwork
from rfdropo_bayes.deployment.objects import Object
from rfdropo_bayes.deployment.sheets import EDS_REMEDY, data_sheet
from rfdropo_bayes.errors import InputError

SDO_REMEDY = "check power, node number, bit rate and termination; `rfdropo doctor` lists who answers"


class Node:
    """One node.

    Args:
        network: network of the node.
        number: number of the node.
        eds: path of the node's electronic data sheet.
        axes: number of the highest axis that is driven.
        answer: time limit of an answer to an SDO request [s].

    Raises:
        InputError: if the data sheet cannot be read.
    """

    def __init__(self, network: LoggedNetwork, number: int, eds: str, axes: int = 1, answer: float = 0.3) -> None:
        self.network, self.number = network, number
        self.remote = canopen.RemoteNode(number, data_sheet(eds, number, axes))
        self.remote.sdo.RESPONSE_TIMEOUT = answer
        network.add_node(self.remote)
        self._sdo = threading.Lock()
        self.nmt: int | None = None
        self.heartbeat = 0.0  # time of the last heartbeat [s, monotonic]
        network.subscribe(objects.HEARTBEAT + number, self._on_heartbeat)

    def _on_heartbeat(self, identifier: int, data: bytearray, timestamp: float) -> None:
        if data:
            self.nmt, self.heartbeat = data[0] & 0x7F, time.monotonic()

    def variable(self, index: int, subindex: int = 0) -> ODVariable | None:
        """The object in the data sheet; None if it has none."""
        return self.remote.object_dictionary.get_variable(index, subindex)

    @contextlib.contextmanager
    def sdo(self, what: str, where: str) -> Iterator[None]:
        """Lock the SDO client; its errors become InputErrors.

        Raises:
            InputError: names the failed action ``what`` and the reason.
        """
        try:
            with self._sdo:
                yield
        except (SdoError, can.CanError, KeyError) as error:  # KeyError: process data without an entry in the data sheet
            raise InputError(f"{what} ({error})", where=where, remedy=SDO_REMEDY) from None

    def read(self, index: int, subindex: int, name: str) -> int:
        """Read an object.

        Args:
            index, subindex: address of the object.
            name: name of the drive, for messages.

        Raises:
            InputError: if the drive does not answer, or refuses; with index and reason.
        """
        variable, where = self.variable(index, subindex), f"{name}, object 0x{index:04X}:{subindex}"
        if variable is None:
            raise InputError("is not in its data sheet", where=where, remedy=EDS_REMEDY)
        with self.sdo("cannot be read", where):
            data = self.remote.sdo.upload(index, subindex)
        if 8 * len(data) < len(variable):
            raise InputError(
                f"has {len(data)} bytes, {len(variable) // 8} by the data sheet", where=where, remedy=EDS_REMEDY
            )
        return int(variable.decode_raw(data))

    def write(self, index: int, value: int, subindex: int, name: str, read_back: bool = True) -> None:
        """Write an object, and read it again.

        Raises:
            InputError: if the drive does not answer, refuses, or keeps another value.
        """
        variable, where = self.variable(index, subindex), f"{name}, object 0x{index:04X}:{subindex}"
        if variable is None:
            raise InputError("is not in its data sheet", where=where, remedy=EDS_REMEDY)
        try:
            data = variable.encode_raw(value)
        except ValueError:
            bits = f"does not fit into {len(variable)} bits"
            raise InputError(
                f"{value} {bits}", where=where, remedy="correct the motor's limits, or its units"
            ) from None
        with self.sdo(f"does not take {value}", where):
            self.remote.sdo.download(index, subindex, data)
        if read_back and variable.readable and (kept := self.read(index, subindex, name)) != value:
            raise InputError(f"keeps {kept} where {value} was written", where=where, remedy="look into its manual")

    def switch_off_process_data(self, received: set[int], sent: set[int], name: str) -> None:
        """Switch off all process data but these numbers: a set-point of one axis must reach no other.

        Args:
            received, sent: numbers of the RPDOs and TPDOs that stay.
            name: name for messages.
        """
        for index, maps, used in ((Object.RPDO, self.remote.rpdo, received), (Object.TPDO, self.remote.tpdo, sent)):
            for number in set(maps) - used:
                cob = self.read(index + number - 1, 1, name)
                if not cob & objects.PDO_INVALID:
                    self.write(index + number - 1, cob | objects.PDO_INVALID, 1, name)
