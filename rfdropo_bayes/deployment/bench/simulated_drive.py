"""A CiA 402 drive in software: object dictionary, process data applied on SYNC, guards, motion, faults on request.

The object dictionary and the SDO server are canopen's (`sdo_server`); everything that they lack (PDOs linked to the
dictionary, NMT, SYNC, heartbeats both ways, emergencies) is here. One thread feeds it: `receive` for every frame,
`tick` between.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from enum import IntEnum
from typing import Any

import canopen
from canopen.sdo import SdoAbortedError

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bench.sdo_server import StrictNode
from rfdropo_bayes.deployment.cia402 import (
    CYCLIC_SYNCHRONOUS_POSITION,
    TRANSITIONS,
    Controlword,
    DriveState,
    Status,
    obey,
)
from rfdropo_bayes.deployment.objects import EmergencyCode, Nmt, NmtState, Object
from rfdropo_bayes.deployment.vendors import told_counts


class SimulatedFault(IntEnum):
    """What can be asked of object 0x2F00; 0 mends everything but a crash."""

    NONE = 0
    NO_TPDO = 1
    NO_HEARTBEAT = 2
    SHORT_TPDO = 3
    OVER_CURRENT = 4
    JAMMED = 5
    CRASH = 6
    FROZEN_STATUS = 7
    REBOOT = 8


_ABORT_PDO_ACTIVE = 0x08000022
_ABORT_NOT_MAPPABLE = 0x06040041
_ABORT_PDO_LENGTH = 0x06040042
_ABORT_RANGE = 0x06090030
_ABORT_HIGH = 0x06090031
_ABORT_LOW = 0x06090032
_EXTENDED = 1 << 29  # of an identifier: 29 bits, which this drive does not speak
_LAG = 0.004  # [s]: time constant of a tuned position loop of 40 Hz
_BOOT = 0.02  # [s]

Send = Callable[[int, bytes], None]


class SimulatedDrive:
    """One drive.

    Args:
        node: its number.
        send: called with identifier and data of every frame it sends.
        position: counts at power-on.
        eds: electronic data sheet; another one stands for a drive of another kind.
        values: values of the dictionary other than the data sheet's, {(index, subindex): value}.
    """

    def __init__(
        self,
        node: int,
        send: Send,
        position: float = 0.0,
        eds: str = str(objects.SIMULATED_EDS),
        values: dict[tuple[int, int], int] | None = None,
    ) -> None:
        self.node, self._send = node, send
        self._values = dict(values or {})
        self._eds = eds
        self.position, self.velocity = float(position), 0.0
        self.torque = 0.0  # [per mille], set from outside
        self.crashed = False
        self._power_on(0.0)

    # Communication

    def _power_on(self, now: float) -> None:
        self.local = StrictNode(self.node, self._eds)
        self.local.sdo.network = _Sender(self._send)  # type: ignore[assignment]
        self.local._write_callbacks.clear()  # LocalNode's own heartbeat runs in a thread that one send error ends
        self.local.add_write_callback(self._check_write)
        self.local.add_read_callback(self._read)
        for (index, subindex), value in self._values.items():
            self.local.data_store.setdefault(index, {})[subindex] = self._variable(index, subindex).encode_raw(value)
        self.nmt, self.boot_at = NmtState.BOOT_UP, now + _BOOT
        self.state, self.controlword, self.error_code, self.error_field = DriveState.SWITCH_ON_DISABLED, 0, 0, 0
        self.target = self.demand = round(self.position)
        self.fault = SimulatedFault.NONE
        self._settings: dict[tuple[int, int], int] = {}
        self._pending: dict[int, bytes] = {}
        self._heard: float | None = None  # consumer heartbeat: guarded from the first one on
        self._last_sync = math.inf  # guarded from the first one on
        self._next_heartbeat = now
        self._error_since: float | None = None
        self._last_status = b""
        self._sent: dict[int, tuple[float, bytes]] = {}  # of each TPDO: when, and what
        self._beats = 0
        self._time = now

    def receive(self, identifier: int, data: bytes, now: float) -> None:
        """Take a frame of the bus."""
        if self.crashed or self.nmt is NmtState.BOOT_UP:
            return
        if identifier == objects.NMT:
            self._manage(data, now)
        elif identifier == objects.SYNC:
            self._on_sync(now)
        elif identifier == 0x600 + self.node and self.nmt is not NmtState.STOPPED:
            self.local.sdo.on_request(identifier, bytearray(data), now)
            self._settings.clear()
            self._after_write(now)
        elif identifier > objects.HEARTBEAT and identifier == objects.HEARTBEAT + (self._guard() >> 16 & 0x7F):
            self._heard = now
        elif self.nmt is NmtState.OPERATIONAL:
            for number in (0, 1):
                if identifier == self._cob(Object.RPDO + number):
                    self._on_rpdo(number, data, now)

    def tick(self, now: float) -> None:
        """Let time pass: motion, guards, heartbeat."""
        if self.crashed:
            return
        self._move(now)
        if self.nmt is NmtState.BOOT_UP:
            if now >= self.boot_at:
                self.nmt = NmtState.PRE_OPERATIONAL
                self._send(objects.HEARTBEAT + self.node, bytes([NmtState.BOOT_UP]))
            return
        self._check_guards(now)
        if self.nmt is NmtState.OPERATIONAL:
            self._on_event(now)
        period = 1e-3 * self.value(Object.PRODUCER_HEARTBEAT)
        if period and now >= self._next_heartbeat and self.fault is not SimulatedFault.NO_HEARTBEAT:
            self._next_heartbeat = max(self._next_heartbeat + period, now)
            self._send(objects.HEARTBEAT + self.node, bytes([self.nmt]))

    def value(self, index: int, subindex: int = 0) -> int:
        """A setting in the object dictionary; kept until the next SDO, since a lookup takes ten microseconds."""
        key = (int(index), subindex)
        if key not in self._settings:
            if key in _ABSENT and self.local.object_dictionary.get_variable(*key) is None:
                self._settings[key] = _ABSENT[key]
            else:
                self._settings[key] = int(self._variable(*key).decode_raw(self.local.get_data(*key)))
        return self._settings[key]

    def _variable(self, index: int, subindex: int) -> canopen.objectdictionary.ODVariable:
        variable = self.local.object_dictionary.get_variable(index, subindex)
        if variable is None:
            raise KeyError(f"0x{index:04X}:{subindex} is not in the data sheet")
        return variable

    def _manage(self, data: bytes, now: float) -> None:
        if len(data) < 2 or data[1] not in (0, self.node):
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
            self._emergency(EmergencyCode.PDO_SHORT, bytes([len(data), needed]), 0x10)
            return
        if self.value(Object.RPDO + number, 2) <= 240:
            self._pending[number] = bytes(data)
        else:
            self._apply(number, data, now)

    def _apply(self, number: int, data: bytes, now: float) -> None:
        place, words = 0, None
        for index, subindex, bits in self._mapped(Object.RPDO_MAP + number):
            part = bytes(data[place : place + bits // 8])
            place += bits // 8
            if index == Object.CONTROLWORD:
                words = int.from_bytes(part, "little")
            elif index == Object.TARGET_POSITION:
                self.target = int.from_bytes(part, "little", signed=True)
            elif index:
                self.local.data_store.setdefault(index, {})[subindex] = part
                self._settings.clear()
        if words is not None:  # after the target that came with it
            self._control(words, now)

    def _on_sync(self, now: float) -> None:
        self._last_sync = now
        if self.nmt is not NmtState.OPERATIONAL:
            return
        self._move(now)
        for number, data in sorted(self._pending.items()):
            self._apply(number, data, now)
        self._pending.clear()
        self._beats += 1
        for number in (0, 1):
            cob, kind = self._cob(Object.TPDO + number), self.value(Object.TPDO + number, 2)
            if cob is None or kind > 240:
                continue
            data = self._collect(number)
            if self._beats % kind == 0 if kind else self._sent.get(number, (0.0, b""))[1] != data:
                self._transmit(number, cob, data, now)

    def _on_event(self, now: float) -> None:
        """Send TPDOs of types 254 and 255 whose content has changed, or whose timer has run out."""
        for number in (0, 1):
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
        if self.fault is SimulatedFault.FROZEN_STATUS and self._last_status:
            data = self._last_status
        self._last_status = data
        self._send(cob, data[:-1] if self.fault is SimulatedFault.SHORT_TPDO else data)

    def _emergency(self, code: int, detail: bytes = b"", register: int = 0x01) -> None:
        self.error_code = self.error_field = int(code)
        self._send(objects.EMCY + self.node, objects.EMERGENCY.pack(code, register, detail.ljust(5, b"\0")))

    # Object dictionary

    def _read(self, index: int, subindex: int, od: Any) -> int | None:
        if (index, subindex) == (Object.ERROR_FIELD, 0):
            return int(self.error_field != 0)
        return _LIVE[index](self) if index in _LIVE else None

    def _check_write(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        value = int.from_bytes(data, "little")
        if index == Object.ERROR_FIELD:
            if value:
                raise SdoAbortedError(_ABORT_RANGE)
            self.error_field = 0
        if index == Object.MODE and value not in (0, CYCLIC_SYNCHRONOUS_POSITION):
            raise SdoAbortedError(_ABORT_RANGE)
        if Object.RPDO <= index < Object.RPDO + 2 or Object.TPDO <= index < Object.TPDO + 2:
            active = not self.value(index, 1) & objects.PDO_INVALID
            if subindex == 1 and active and not value & objects.PDO_INVALID and value != self.value(index, 1):
                raise SdoAbortedError(_ABORT_RANGE)  # an identifier changes only while the PDO is off
            if (subindex == 1 and value & _EXTENDED) or (subindex == 2 and 240 < value < 254):
                raise SdoAbortedError(_ABORT_RANGE)
        for maps, comm in ((Object.RPDO_MAP, Object.RPDO), (Object.TPDO_MAP, Object.TPDO)):
            if maps <= index < maps + 2:
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
        """Act on what an SDO has written: words that the master may send without PDOs, and requests for faults."""
        store = self.local.data_store
        if Object.CONTROLWORD in store:
            self._control(int.from_bytes(store.pop(Object.CONTROLWORD)[0], "little"), now)
        if Object.TARGET_POSITION in store:
            self.target = struct.unpack("<i", store.pop(Object.TARGET_POSITION)[0])[0]
        if Object.SIMULATED_FAULT in store:
            self._request(store.pop(Object.SIMULATED_FAULT)[0][0], now)

    def _request(self, fault: int, now: float) -> None:
        self.fault = SimulatedFault(fault) if fault in set(SimulatedFault) else SimulatedFault.NONE
        if self.fault is SimulatedFault.CRASH:
            self.crashed = True
        elif self.fault is SimulatedFault.OVER_CURRENT:
            self._fail(EmergencyCode.OVER_CURRENT)
        elif self.fault is SimulatedFault.REBOOT:
            self._power_on(now)

    # Power

    def statusword(self) -> int:
        """State, limits and whether set-points are followed."""
        word = self.state.value[1] | Status.REMOTE
        if self.state not in (
            DriveState.SWITCH_ON_DISABLED,
            DriveState.READY_TO_SWITCH_ON,
            DriveState.FAULT,
            DriveState.NOT_READY,
        ):
            word |= Status.VOLTAGE_ENABLED
        if self.state is DriveState.OPERATION_ENABLED and self.value(Object.MODE) == CYCLIC_SYNCHRONOUS_POSITION:
            word |= Status.FOLLOWS_COMMAND
        if self._error_since is not None:
            word |= Status.FOLLOWING_ERROR
        if self.demand != self.target and self.state is DriveState.OPERATION_ENABLED:
            word |= Status.LIMIT_ACTIVE
        return int(word)

    def _control(self, controlword: int, now: float) -> None:
        number = obey(self.state, controlword, self.controlword)
        self.controlword = controlword
        if number is None:
            return
        if number == 15:
            self.error_code, self._error_since = 0, None
            self.fault = SimulatedFault.NONE
            self._send(objects.EMCY + self.node, objects.EMERGENCY.pack(0, 0, bytes(5)))
        self.state = TRANSITIONS[number].end
        if self.state is DriveState.QUICK_STOP_ACTIVE and self.value(Object.QUICK_STOP_OPTION) == 0:
            self.state = DriveState.SWITCH_ON_DISABLED  # "disable drive function": the motor coasts

    def _fail(self, code: int) -> None:
        """Transitions 13 and 14: the reaction of this drive takes no time, since gear and drum hold themselves."""
        self.state, self.velocity = DriveState.FAULT, 0.0
        self._emergency(code, register=0x21)

    def _connection_lost(self, code: int, now: float) -> None:
        """What object 0x6007 says: 0 nothing, 1 fault, 2 disable voltage, 3 quick stop."""
        if code:
            self._emergency(code, register=0x11)
            behaviour = self.value(Object.ERROR_BEHAVIOUR, 1) if self.nmt is NmtState.OPERATIONAL else 1
            if behaviour != 1:
                self._enter(NmtState.STOPPED if behaviour == 2 else NmtState.PRE_OPERATIONAL)
        if not self.state.powered:
            return
        option = self.value(Object.ABORT_CONNECTION)
        if option == 1:
            self._fail(code or EmergencyCode.GENERIC)
        elif option == 2:
            self._control(Controlword.DISABLE_VOLTAGE, now)
        elif option == 3:
            self._control(Controlword.QUICK_STOP, now)

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

    # Motion

    def _move(self, now: float) -> None:
        duration, self._time = now - self._time, now
        if duration <= 0.0:
            return
        if self.state is DriveState.OPERATION_ENABLED and self.value(Object.MODE) == CYCLIC_SYNCHRONOUS_POSITION:
            self._follow(duration, now)
        else:
            self._slow_down(duration)
            self._error_since = None
            if not self.state.powered:
                self.target = self.demand = round(self.position)

    def _follow(self, duration: float, now: float) -> None:
        step = self._step(duration)
        self.position += step
        self.velocity = step / duration
        if abs(self.demand - self.position) > self.value(Object.FOLLOWING_WINDOW):
            self._error_since = now if self._error_since is None else self._error_since
            if now - self._error_since >= 1e-3 * self.value(Object.FOLLOWING_TIMEOUT):
                self._fail(EmergencyCode.FOLLOWING_ERROR)
        else:
            self._error_since = None

    def _step(self, duration: float) -> float:
        """Counts that a following drive covers in this time, towards the target within the drive's limits."""
        low, high = self.value(Object.POSITION_LIMIT, 1), self.value(Object.POSITION_LIMIT, 2)
        self.demand = min(max(self.target, low), high)
        if self.fault is SimulatedFault.JAMMED:
            return 0.0
        wanted = (self.demand - self.position) * -math.expm1(-duration / _LAG)
        largest = self.value(Object.MAX_MOTOR_SPEED) / 60.0 * self.counts_per_turn * duration
        return min(max(wanted, -largest), largest)

    def ahead(self, duration: float) -> float:
        """Counts where it will stand after this time, if no set-point comes before."""
        following = self.state is DriveState.OPERATION_ENABLED
        return self.position + (self._step(duration) if following else 0.0)

    @property
    def interpolation_time(self) -> float:
        """Time from one SYNC to the next, by object 0x60C2 [s]."""
        exponent = self.value(Object.INTERPOLATION_TIME, 2)
        return float(self.value(Object.INTERPOLATION_TIME, 1) * 10.0**exponent)

    counts_per_turn = 2048.0
    """Of the encoder, per turn of the motor; the speed limit 0x6080 is in turns."""

    def _slow_down(self, duration: float) -> None:
        unit = told_counts(self.value(Object.ACCELERATION_UNIT), self.counts_per_turn) or 1.0
        change = self.value(Object.QUICK_STOP_DECELERATION) * unit * duration
        before = self.velocity
        self.velocity = math.copysign(max(0.0, abs(before) - change), before)
        self.position += 0.5 * (before + self.velocity) * duration if self.velocity else 0.0
        self.demand = round(self.position)
        stops = self.state is DriveState.QUICK_STOP_ACTIVE and self.velocity == 0.0
        if stops and self.value(Object.QUICK_STOP_OPTION) < 5:  # options 1 to 4 end in SWITCH ON DISABLED
            self.state = DriveState.SWITCH_ON_DISABLED


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
"""What a drive does whose data sheet lacks an object: no guard, or its maker's own value."""

_LIVE: dict[int, Callable[[SimulatedDrive], int]] = {
    Object.STATUSWORD: SimulatedDrive.statusword,
    Object.POSITION: lambda drive: round(drive.position),
    Object.POSITION_DEMAND: lambda drive: round(drive.demand),
    Object.VELOCITY: lambda drive: round(drive.velocity),
    Object.TORQUE: lambda drive: max(-32768, min(32767, round(drive.torque))),
    Object.TARGET_POSITION: lambda drive: drive.target,
    Object.CONTROLWORD: lambda drive: drive.controlword,
    Object.ERROR_CODE: lambda drive: drive.error_code,
    Object.ERROR_FIELD: lambda drive: drive.error_field,
    Object.ERROR_REGISTER: lambda drive: int(drive.state is DriveState.FAULT),
    Object.FOLLOWING_ERROR: lambda drive: round(drive.target - drive.position),
    Object.MODE_DISPLAY: lambda drive: drive.value(Object.MODE),
}
"""Objects whose value is the drive's own state."""


class _Sender:
    """The part of a `canopen.Network` that an SDO server needs."""

    def __init__(self, send: Send) -> None:
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._send(can_id, bytes(data))
