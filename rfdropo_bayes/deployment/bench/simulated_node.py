"""A CANopen node in software: object dictionary, process data applied on SYNC, guards, faults on request.

The object dictionary and the SDO server are canopen's (`sdo_server`); everything that they lack (PDOs linked to the
dictionary, NMT, SYNC, heartbeats both ways, emergencies) is here. `SimulatedDrive` has the power and motion of an axis.
One thread feeds it: `receive` for every frame, `tick` between.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import Any

import canopen
from canopen.sdo import SdoAbortedError

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bench.sdo_server import StrictNode
from rfdropo_bayes.deployment.bench.simulated_drive import LIVE, SimulatedDrive
from rfdropo_bayes.deployment.cia402 import CYCLIC_SYNCHRONOUS_POSITION, DriveState
from rfdropo_bayes.deployment.objects import EmergencyCode, Nmt, NmtState, Object, first_axis, of_axis
from rfdropo_bayes.deployment.sheets import data_sheet


class SimulatedFault(IntEnum):
    """Faults requested through object 0x2F00; 0 clears every fault except a crash."""

    NONE = 0
    NO_TPDO = 1
    NO_HEARTBEAT = 2
    SHORT_TPDO = 3
    OVER_CURRENT = 4
    JAMMED = 5
    CRASH = 6
    FROZEN_STATUS = 7
    REBOOT = 8
    ENABLES_ITSELF = 9  # some time after a quick stop
    LETS_GO = 10


_AFTER_STOP = {
    SimulatedFault.ENABLES_ITSELF: DriveState.OPERATION_ENABLED,
    SimulatedFault.LETS_GO: DriveState.SWITCH_ON_DISABLED,
}
_ABORT_PDO_ACTIVE = 0x08000022
_ABORT_NOT_MAPPABLE = 0x06040041
_ABORT_PDO_LENGTH = 0x06040042
_ABORT_RANGE = 0x06090030
_ABORT_HIGH = 0x06090031
_ABORT_LOW = 0x06090032
_EXTENDED = 1 << 29  # of an identifier: 29 bits, which this node does not speak
_BOOT = 0.02  # [s]
_PDOS = 512  # of each direction, at most

Send = Callable[[int, bytes], None]


class SimulatedNode:
    """One node.

    Args:
        number: number of the node.
        send: called with identifier and data of every frame it sends.
        positions: counts of each axis at power-on.
        eds: electronic data sheet; another sheet simulates a drive of another kind.
        values: values of the dictionary other than the data sheet's, {(index, subindex): value}.
    """

    def __init__(
        self,
        number: int,
        send: Send,
        positions: Sequence[float] = (0.0,),
        eds: str = str(objects.SIMULATED_EDS),
        values: Mapping[tuple[int, int], int] | None = None,
    ) -> None:
        self.number, self._send = number, send
        self._values = dict(values or {})
        self._eds = eds
        self.drives = tuple(SimulatedDrive(self, axis, position) for axis, position in enumerate(positions, start=1))
        self.crashed = False
        self._power_on(0.0)

    # Communication

    def _power_on(self, now: float) -> None:
        self.local = StrictNode(self.number, data_sheet(self._eds, self.number, len(self.drives)))
        self.local.sdo.network = _Sender(self._send)  # type: ignore[assignment]
        # LocalNode's own heartbeat runs in a thread that ends at the first send error
        self.local._write_callbacks.clear()
        self.local.add_write_callback(self._check_write)
        self.local.add_read_callback(self._read)
        for (index, subindex), value in self._values.items():
            self.local.data_store.setdefault(index, {})[subindex] = self._variable(index, subindex).encode_raw(value)
        known = self.local.object_dictionary
        self._rpdos = [number for number in range(_PDOS) if Object.RPDO + number in known]
        self._tpdos = [number for number in range(_PDOS) if Object.TPDO + number in known]
        self.nmt, self.boot_at = NmtState.BOOT_UP, now + _BOOT
        self.error_field = 0
        self.fault = SimulatedFault.NONE
        self._settings: dict[tuple[int, int], int] = {}
        self._pending: dict[int, bytes] = {}
        self._heard: float | None = None  # consumer heartbeat: guarded from the first
        self._last_sync = math.inf  # guarded from the first
        self._next_heartbeat = now
        self._last_status: dict[int, bytes] = {}  # of each TPDO, as sent
        self._sent: dict[int, tuple[float, bytes]] = {}  # of each TPDO: time and content
        self._beats = 0
        for drive in self.drives:
            drive.power_on(now)

    def receive(self, identifier: int, data: bytes, now: float) -> None:
        """Take a frame of the bus."""
        if self.crashed or self.nmt is NmtState.BOOT_UP:
            return
        if identifier == objects.NMT:
            self._manage(data, now)
        elif identifier == objects.SYNC:
            self._on_sync(now)
        elif identifier == 0x600 + self.number and self.nmt is not NmtState.STOPPED:
            self.local.sdo.on_request(identifier, bytearray(data), now)
            self._settings.clear()
            self._after_write(now)
        elif identifier > objects.HEARTBEAT and identifier == objects.HEARTBEAT + (self._guard() >> 16 & 0x7F):
            self._heard = now
        elif self.nmt is NmtState.OPERATIONAL:
            for number in self._rpdos:
                if identifier == self._cob(Object.RPDO + number):
                    self._on_rpdo(number, data, now)

    def tick(self, now: float) -> None:
        """Let time pass: motion, guards, heartbeat."""
        if self.crashed:
            return
        for drive in self.drives:
            drive.move(now)
        if self.nmt is NmtState.BOOT_UP:
            if now >= self.boot_at:
                self.nmt = NmtState.PRE_OPERATIONAL
                self._send(objects.HEARTBEAT + self.number, bytes([NmtState.BOOT_UP]))
            return
        self._check_guards(now)
        if self.nmt is NmtState.OPERATIONAL:
            self._on_event(now)
        period = 1e-3 * self.value(Object.PRODUCER_HEARTBEAT)
        if period and now >= self._next_heartbeat and self.fault is not SimulatedFault.NO_HEARTBEAT:
            self._next_heartbeat = max(self._next_heartbeat + period, now)
            self._send(objects.HEARTBEAT + self.number, bytes([self.nmt]))

    def value(self, index: int, subindex: int = 0) -> int:
        """A setting in the object dictionary; kept until the next SDO, since a lookup takes ten microseconds."""
        key = (int(index), subindex)
        if key not in self._settings:
            absent = (first_axis(index)[1], subindex)
            if absent in _ABSENT and self.local.object_dictionary.get_variable(*key) is None:
                self._settings[key] = _ABSENT[absent]
            else:
                self._settings[key] = int(self._variable(*key).decode_raw(self.local.get_data(*key)))
        return self._settings[key]

    def _variable(self, index: int, subindex: int) -> canopen.objectdictionary.ODVariable:
        variable = self.local.object_dictionary.get_variable(index, subindex)
        if variable is None:
            raise KeyError(f"0x{index:04X}:{subindex} is not in the data sheet")
        return variable

    def _manage(self, data: bytes, now: float) -> None:
        if len(data) < 2 or data[1] not in (0, self.number):
            return
        if data[0] in (Nmt.RESET_NODE, Nmt.RESET_COMMUNICATION):
            self._power_on(now)
            return
        states: dict[int, NmtState] = {
            Nmt.START: NmtState.OPERATIONAL,
            Nmt.STOP: NmtState.STOPPED,
            Nmt.PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
        }
        new = states.get(data[0])
        if new is None:
            return
        if new is NmtState.STOPPED and self.nmt is not NmtState.STOPPED:
            self._connection_lost(EmergencyCode.NONE, now)
        self._enter(new)

    def _enter(self, state: NmtState) -> None:
        self.nmt, self._last_sync, self._beats = state, math.inf, 0
        self._sent.clear()

    def _cob(self, index: int) -> int | None:
        cob = self.value(index, 1)
        return None if cob & objects.PDO_INVALID else cob & 0x1FFFFFFF

    def _guard(self) -> int:
        return self.value(Object.CONSUMER_HEARTBEAT, 1)

    def _mapped(self, index: int) -> list[tuple[int, int, int]]:
        entries = [self.value(index, number) for number in range(1, self.value(index, 0) + 1)]
        return [(entry >> 16, entry >> 8 & 0xFF, entry & 0xFF) for entry in entries]

    def _on_rpdo(self, number: int, data: bytes, now: float) -> None:
        needed = sum(bits for _, _, bits in self._mapped(Object.RPDO_MAP + number)) // 8
        if len(data) < needed:
            self.emergency(EmergencyCode.PDO_SHORT, bytes([len(data), needed]), 0x10)
            return
        if self.value(Object.RPDO + number, 2) <= 240:
            self._pending[number] = bytes(data)
        else:
            self._apply(number, data, now)

    def _apply(self, number: int, data: bytes, now: float) -> None:
        place, words = 0, {}
        for index, subindex, bits in self._mapped(Object.RPDO_MAP + number):
            part = bytes(data[place : place + bits // 8])
            place += bits // 8
            axis, first = first_axis(index)
            if first == Object.CONTROLWORD:
                words[axis] = int.from_bytes(part, "little")
            elif first == Object.TARGET_POSITION:
                self.drives[axis - 1].target = int.from_bytes(part, "little", signed=True)
            elif index:
                self.local.data_store.setdefault(index, {})[subindex] = part
                self._settings.clear()
        for axis, word in words.items():  # after the targets that came with them
            self.drives[axis - 1].control(word)

    def _on_sync(self, now: float) -> None:
        self._last_sync = now
        if self.nmt is not NmtState.OPERATIONAL:
            return
        for drive in self.drives:
            drive.move(now)
        for number, data in sorted(self._pending.items()):
            self._apply(number, data, now)
        self._pending.clear()
        self._beats += 1
        for number in self._tpdos:
            cob, kind = self._cob(Object.TPDO + number), self.value(Object.TPDO + number, 2)
            if cob is None or kind > 240:
                continue
            data = self._collect(number)
            if self._beats % kind == 0 if kind else self._sent.get(number, (0.0, b""))[1] != data:
                self._transmit(number, cob, data, now)

    def _on_event(self, now: float) -> None:
        """Send TPDOs of types 254 and 255 whose content has changed, or whose timer has run out."""
        for number in self._tpdos:
            cob = self._cob(Object.TPDO + number)
            if cob is None or self.value(Object.TPDO + number, 2) < 254:
                continue
            data = self._collect(number)
            when, before = self._sent.get(number, (-math.inf, b""))
            inhibited = now - when < 1e-4 * self.value(Object.TPDO + number, 3)
            timer = 1e-3 * self.value(Object.TPDO + number, 5)
            if not inhibited and (data != before or (timer and now - when >= timer)):
                self._transmit(number, cob, data, now)

    def _collect(self, number: int) -> bytes:
        mapped = self._mapped(Object.TPDO_MAP + number)
        return b"".join(self.local.get_data(index, subindex)[: bits // 8] for index, subindex, bits in mapped)

    def _transmit(self, number: int, cob: int, data: bytes, now: float) -> None:
        self._sent[number] = now, data
        if self.fault is SimulatedFault.NO_TPDO:
            return
        if self.fault is SimulatedFault.FROZEN_STATUS:
            data = self._last_status.get(number, data)
        self._last_status[number] = data
        self._send(cob, data[:-1] if self.fault is SimulatedFault.SHORT_TPDO else data)

    def emergency(self, code: int, detail: bytes = b"", register: int = 0x01) -> None:
        """Send an emergency message; code 0 means that the error has gone."""
        self.error_field = int(code) or self.error_field
        self._send(objects.EMCY + self.number, objects.EMERGENCY.pack(code, register, detail.ljust(5, b"\0")))

    # Object dictionary

    def _read(self, index: int, subindex: int, od: Any) -> int | None:
        axis, first = first_axis(index)
        if first in LIVE and axis <= len(self.drives):
            return LIVE[first](self.drives[axis - 1])
        if index == Object.ERROR_FIELD:
            return int(self.error_field != 0) if subindex == 0 else self.error_field
        if index == Object.ERROR_REGISTER:
            return int(any(drive.state is DriveState.FAULT for drive in self.drives))
        return None

    def _check_write(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        value = int.from_bytes(data, "little")
        if index == Object.ERROR_FIELD:
            if value:
                raise SdoAbortedError(_ABORT_RANGE)
            self.error_field = 0
        if first_axis(index)[1] == Object.MODE and value not in (0, CYCLIC_SYNCHRONOUS_POSITION):
            raise SdoAbortedError(_ABORT_RANGE)
        if Object.RPDO <= index < Object.RPDO + _PDOS or Object.TPDO <= index < Object.TPDO + _PDOS:
            active = not self.value(index, 1) & objects.PDO_INVALID
            if subindex == 1 and active and not value & objects.PDO_INVALID and value != self.value(index, 1):
                raise SdoAbortedError(_ABORT_RANGE)  # an identifier changes only while the PDO is off
            if (subindex == 1 and value & _EXTENDED) or (subindex == 2 and 240 < value < 254):
                raise SdoAbortedError(_ABORT_RANGE)
        for maps, comm in ((Object.RPDO_MAP, Object.RPDO), (Object.TPDO_MAP, Object.TPDO)):
            if maps <= index < maps + _PDOS:
                self._check_mapping(index, subindex, value, comm + index - maps)
        if od.max is not None and od.decode_raw(bytes(data)) > od.max:
            raise SdoAbortedError(_ABORT_HIGH)
        if od.min is not None and od.decode_raw(bytes(data)) < od.min:
            raise SdoAbortedError(_ABORT_LOW)

    def _check_mapping(self, index: int, subindex: int, value: int, comm: int) -> None:
        if not self.value(comm, 1) & objects.PDO_INVALID or (subindex and self.value(index, 0)):
            raise SdoAbortedError(_ABORT_PDO_ACTIVE)
        if subindex:
            variable = self.local.variable(value >> 16, value >> 8 & 0xFF) if value else None
            received = comm < Object.TPDO
            if variable is not None and not (
                variable.pdo_mappable
                and len(variable) == value & 0xFF
                and (variable.writable if received else variable.readable)
            ):
                raise SdoAbortedError(_ABORT_NOT_MAPPABLE)
            return
        if value > 8:
            raise SdoAbortedError(_ABORT_HIGH)
        bits = [self.value(index, number) & 0xFF for number in range(1, value + 1)]
        if not all(bits):
            raise SdoAbortedError(_ABORT_NOT_MAPPABLE)
        if sum(bits) > 64:
            raise SdoAbortedError(_ABORT_PDO_LENGTH)

    def _after_write(self, now: float) -> None:
        """Act on objects written by SDO: control words sent without PDOs, and requests for faults."""
        store = self.local.data_store
        for drive in self.drives:
            word, target = (of_axis(index, drive.axis) for index in (Object.CONTROLWORD, Object.TARGET_POSITION))
            if word in store:
                drive.control(int.from_bytes(store.pop(word)[0], "little"))
            if target in store:
                drive.target = struct.unpack("<i", store.pop(target)[0])[0]
        if Object.SIMULATED_FAULT in store:
            self._request(store.pop(Object.SIMULATED_FAULT)[0][0], now)

    def _request(self, fault: int, now: float) -> None:
        self.fault = SimulatedFault(fault) if fault in set(SimulatedFault) else SimulatedFault.NONE
        for drive in self.drives:
            drive.jammed = self.fault is SimulatedFault.JAMMED
            drive.after_stop = _AFTER_STOP.get(self.fault)
        if self.fault is SimulatedFault.CRASH:
            self.crashed = True
        elif self.fault is SimulatedFault.OVER_CURRENT:
            for drive in self.drives:
                drive.fail(EmergencyCode.OVER_CURRENT)
        elif self.fault is SimulatedFault.REBOOT:
            self._power_on(now)

    # Guards

    def _connection_lost(self, code: int, now: float) -> None:
        """Apply the reactions of object 0x1029 to the node, and of 0x6007 to each axis."""
        if code:
            self.emergency(code, register=0x11)
            behaviour = self.value(Object.ERROR_BEHAVIOUR, 1) if self.nmt is NmtState.OPERATIONAL else 1
            if behaviour != 1:
                self._enter(NmtState.STOPPED if behaviour == 2 else NmtState.PRE_OPERATIONAL)
        for drive in self.drives:
            drive.connection_lost(code)

    def _check_guards(self, now: float) -> None:
        patience = 1e-3 * (self._guard() & 0xFFFF)
        if patience and self._heard is not None and now - self._heard > patience:
            self._heard = None
            self._connection_lost(EmergencyCode.HEARTBEAT_LOST, now)
        period = 1e-6 * self.value(Object.CYCLE_PERIOD)
        guarded = self.nmt is NmtState.OPERATIONAL and period
        if guarded and now - self._last_sync > 1.5 * period:
            self._last_sync = math.inf
            self._connection_lost(EmergencyCode.SYNC_LOST, now)


_ABSENT: dict[tuple[int, int], int] = {
    (Object.CYCLE_PERIOD, 0): 0,
    (Object.CONSUMER_HEARTBEAT, 1): 0,
    (Object.PRODUCER_HEARTBEAT, 0): 0,
    (Object.ERROR_BEHAVIOUR, 1): 0,
    (Object.ABORT_CONNECTION, 0): 0,
    (Object.QUICK_STOP_OPTION, 0): 2,
    (Object.QUICK_STOP_DECELERATION, 0): 1_000_000,
    (Object.POSITION_LIMIT, 1): -(2**31),
    (Object.POSITION_LIMIT, 2): 2**31 - 1,
    (Object.FOLLOWING_WINDOW, 0): 2**32 - 1,
    (Object.FOLLOWING_TIMEOUT, 0): 0,
    (Object.MAX_MOTOR_SPEED, 0): 10_000,
    (Object.INTERPOLATION_TIME, 1): 0,
    (Object.INTERPOLATION_TIME, 2): 0,
    (Object.ACCELERATION_UNIT, 0): 0,
}
"""Default of each object that a data sheet lacks: no guard, or the maker's own value."""


class _Sender:
    """The part of a `canopen.Network` that an SDO server needs."""

    def __init__(self, send: Send) -> None:
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._send(can_id, bytes(data))
