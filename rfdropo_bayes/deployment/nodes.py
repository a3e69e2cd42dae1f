"""A CANopen node as the master sees it: data sheet, SDOs and heartbeat, which all axes of one drive share.

Electronic data sheets (EDS) of drives; the simulated drive's sheet has any requested number of axes.
"""

from __future__ import annotations

import contextlib
import io
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import canopen
from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.eds import import_eds
from canopen.sdo.exceptions import SdoError

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bus import LoggedNetwork
from rfdropo_bayes.deployment.objects import Object
from rfdropo_bayes.errors import InputError

EDS_REMEDY = "give the data sheet that came with this drive"
_PDO = (0x1400, 0x1600, 0x1800, 0x1A00)
_COPIED = re.compile(r"^\[(?P<index>[0-9A-F]{4})(?P<sub>\w*)\]$")

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


def data_sheet(eds: str, node: int, axes: int = 1) -> canopen.ObjectDictionary:
    """Read the object dictionary of a drive.

    Args:
        eds: path of the drive's data sheet. The simulated drive's sheet describes one axis; further axes are copies.
        node: number of the drive.
        axes: number of axes.

    Raises:
        InputError: the sheet cannot be read.
    """
    try:
        text = Path(eds).read_text(encoding="utf-8", errors="replace")
        if Path(eds).resolve() == objects.SIMULATED_EDS.resolve():
            text += "".join(_further_axis(text, axis) for axis in range(2, axes + 1))
        return import_eds(io.StringIO(text), node)
    except Exception as error:  # configparser and canopen raise many types on damaged data sheets
        raise InputError(f"is not a readable data sheet ({error})", where=eds, remedy=EDS_REMEDY) from None


def _further_axis(text: str, axis: int) -> str:
    """Sections of another axis: objects of the device profile, and process data that are off until they are set."""
    sections = []
    for section in re.split(r"^(?=\[)", text, flags=re.MULTILINE):
        name, _, body = section.partition("\n")
        match = _COPIED.match(name.strip())
        if match is None:
            continue
        index = int(match["index"], 16)
        shifted = objects.of_axis(index, axis)
        if index & 0xFE00 in _PDO:
            shifted = index + objects.PDOS_OF_AXIS * (axis - 1)
            body = re.sub(r"=\$NODEID.*", f"={objects.PDO_INVALID:#x}", body)
            body = re.sub(r"=0x([6-9]\w{3})(\w{4})$", lambda entry: _mapped(entry, axis), body, flags=re.MULTILINE)
        if shifted != index:
            sections.append(f"\n[{shifted:04X}{match['sub']}]\n{body}")
    return "".join(sections)


def _mapped(entry: re.Match[str], axis: int) -> str:
    return f"=0x{objects.of_axis(int(entry[1], 16), axis):04X}{entry[2]}"
