"""The drives of a robot, seen from the master: set-up by SDO with read-back, one exchange of process data a cycle.

canopen carries the object dictionary and the SDOs. Process data, SYNC, heartbeats and emergencies are handled here, in
the thread of the control loop, because each needs a deadline, which canopen's own threads do not have.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import can
from canopen.objectdictionary import ODVariable
from canopen.pdo.base import PdoMap

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bus import LoggedNetwork
from rfdropo_bayes.deployment.cia402 import (
    CYCLIC_SYNCHRONOUS_POSITION,
    Controlword,
    DriveState,
    controlword_towards,
    state_of,
)
from rfdropo_bayes.deployment.nodes import Node
from rfdropo_bayes.deployment.objects import Identifiers, Nmt, NmtState, Object, identifiers, of_axis
from rfdropo_bayes.deployment.sheets import EDS_REMEDY
from rfdropo_bayes.deployment.vendors import (
    LEFT_OUT,
    STANDARD,
    STRICTER_BELOW,
    Units,
    acceleration_counts,
    check_guards,
    check_home_offset,
    check_polarity,
    check_rated_torque,
    check_travel,
    speed_counts,
)
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Motor


class Emergency(NamedTuple):
    """An emergency message: time of arrival [s, monotonic], channels of the node, code and error register."""

    time: float
    channels: tuple[str, ...]
    code: int
    register: int


class Reading(NamedTuple):
    """Content of a drive's last TPDO: statusword, position [counts], torque [per mille], arrival [s, monotonic]."""

    statusword: int
    position: int
    torque: int
    time: float


class Identity(NamedTuple):
    """Object 0x1018; None stands for any."""

    vendor: int | None = None
    product: int | None = None
    revision: int | None = None
    serial: int | None = None


class Drive:
    """One axis of a node, which drives one motor.

    Args:
        node: node of the axis.
        motor: motor of the axis.
        offset: counts at length zero.
        identifiers: identifiers of the drive's frames.
        units: units of the objects that differ between vendors.
        unguarded: guards that the drive may lack, by object index.
    """

    def __init__(
        self,
        node: Node,
        motor: Motor,
        offset: float,
        identifiers: Identifiers,
        units: Units = STANDARD,
        unguarded: Collection[int] = (),
    ) -> None:
        self.node, self.motor, self.offset, self.identifiers = node, motor, offset, identifiers
        self.units, self.unguarded = units, unguarded
        self.controlword, self.target = int(Controlword.DISABLE_VOLTAGE), 0
        self.reading: Reading | None = None
        self.short_frames = 0
        self.unanswered = 0  # cycles since the last status

    @property
    def name(self) -> str:
        """For messages."""
        axis = f", axis {self.motor.axis}" if self.motor.axis > 1 else ""
        return f"drive {self.motor.channel!r} (node {self.motor.node}{axis})"

    @property
    def state(self) -> DriveState | None:
        """State that the last TPDO shows."""
        return None if self.reading is None else state_of(self.reading.statusword)

    @property
    def length(self) -> float:
        """Cable on the drum [m] at the last TPDO."""
        assert self.reading is not None
        return self.motor.length(self.reading.position, self.offset)

    @property
    def tension(self) -> float:
        """Tension [N] that the torque of the last TPDO holds."""
        assert self.reading is not None
        return self.motor.tension(self.reading.torque)

    # SDO; indices are of a first axis

    def index(self, index: int) -> int:
        """Index of an object on this axis."""
        return of_axis(index, self.motor.axis)

    def variable(self, index: int, subindex: int = 0) -> ODVariable | None:
        """The object in the data sheet; None if it has none."""
        return self.node.variable(self.index(index), subindex)

    def knows(self, index: int, subindex: int = 0) -> bool:
        """Whether the data sheet has the object."""
        return self.variable(index, subindex) is not None

    def read(self, index: int, subindex: int = 0) -> int:
        """Read an object.

        Raises:
            InputError: see `Node.read`.
        """
        return self.node.read(self.index(index), subindex, self.name)

    def write(self, index: int, value: int, subindex: int = 0, read_back: bool = True) -> None:
        """Write an object, and read it again.

        Raises:
            InputError: see `Node.write`.
        """
        self.node.write(self.index(index), value, subindex, self.name, read_back)

    # Set-up

    def check(self, identity: Identity, check_eds: bool = True) -> dict[str, int]:
        """Read the drive's identity and check its abilities; nothing is written.

        Args:
            identity: identity that the drive must report.
            check_eds: whether vendor and product of the data sheet must equal those of the drive.

        Returns:
            Its identity, statusword, position, supported modes and rated torque.

        Raises:
            InputError: on silence, a wrong identity or type, no cyclic synchronous position, another rated torque or
                unit, a guard that it lacks, or positions that it reverses or shifts.
        """
        self._check_layout()
        own = self.motor.axis > 1 and self.knows(Object.PROFILE)  # 0x1000 describes the first axis
        kind = self.read(Object.PROFILE if own else Object.DEVICE_TYPE)
        if kind & 0xFFFF != 402:
            raise InputError(
                f"is not a CiA 402 drive (device type 0x{kind:08X})", where=self.name, remedy="correct its node or axis"
            )
        answers = self._check_identity(identity, check_eds)
        if self.knows(Object.SUPPORTED_MODES):
            answers["modes"] = self.read(Object.SUPPORTED_MODES)
            if not answers["modes"] & objects.CSP_BIT:
                raise InputError("has no cyclic synchronous position mode", where=self.name, remedy="use another drive")
        check_guards(self.lacking(), self.unguarded, where=f"{self.name}, data sheet")
        self._check_positions()
        if self.knows(Object.RATED_TORQUE):
            answers["rated_torque"] = self.read(Object.RATED_TORQUE)
            where = f"{self.name}, object 0x6076"
            check_rated_torque(answers["rated_torque"], self.motor.rated_torque_n_m, self.units.torque, where)
        self._factors()
        answers["statusword"] = self.read(Object.STATUSWORD)
        answers["position"] = self.read(Object.POSITION)
        return answers

    def lacking(self) -> list[int]:
        """Objects that would be set or asked, and that its data sheet does not have, or lets nobody write."""
        missing = []
        for index, subindexes in _SET.items():
            variables = [self.variable(index, subindex) for subindex in subindexes]
            if not all(variable is not None and variable.writable for variable in variables):
                missing.append(int(index))
        return missing if self.knows(Object.RATED_TORQUE) else [*missing, int(Object.RATED_TORQUE)]

    def _factors(self) -> tuple[float, float]:
        """Counts per second in one unit of 0x6080, and counts per second squared in one unit of 0x6085.

        Raises:
            InputError: if the units are unknown or contradict the drive's own.
        """
        told = [self.read(i) if self.knows(i) else 0 for i in (Object.VELOCITY_UNIT, Object.ACCELERATION_UNIT)]
        turn = self.motor.counts_per_turn
        speed = acceleration = 1.0
        if self.knows(Object.MAX_MOTOR_SPEED):
            speed = speed_counts(self.units.speed, told[0], turn, self.name)
        if self.knows(Object.QUICK_STOP_DECELERATION):
            acceleration = acceleration_counts(self.units.acceleration, told[1], turn, self.name)
        return speed, acceleration

    def _check_positions(self) -> None:
        """Refuse a drive whose positions are reversed or shifted against the encoder."""
        if self.knows(Object.POLARITY):
            check_polarity(self.read(Object.POLARITY), self.name)
        if self.knows(Object.HOME_OFFSET):
            check_home_offset(self.read(Object.HOME_OFFSET), self.unguarded, self.name)

    def _ends(self) -> list[int]:
        """Least and greatest position of the travel [counts].

        Raises:
            InputError: the drive's position would wrap within the travel.
        """
        ends = sorted(self.motor.counts(length, self.offset) for length in self.motor.length_limit_m)
        told = all(self.knows(Object.POSITION_RANGE, subindex) for subindex in (1, 2))
        wrap = (self.read(Object.POSITION_RANGE, 1), self.read(Object.POSITION_RANGE, 2)) if told else (0, 0)
        check_travel(ends, wrap, self.name)
        return ends

    def _check_layout(self) -> None:
        """A data sheet in which the process data have other sizes is another drive's."""
        for index, subindex, bits in (*objects.SETPOINT_MAP, *objects.STATUS_MAP):
            variable = self.variable(index, subindex)
            if variable is None or len(variable) != bits:
                size = "lacks it" if variable is None else f"gives it {len(variable)} bits"
                raise InputError(
                    f"has {bits} bits by CiA 402; the data sheet {size}",
                    where=f"{self.name}, object 0x{self.index(index):04X}",
                    remedy=EDS_REMEDY,
                )

    def _check_identity(self, identity: Identity, check_eds: bool) -> dict[str, int]:
        sheet = self.node.remote.object_dictionary.device_information
        stated = {"vendor": sheet.vendor_number, "product": sheet.product_number} if check_eds else {}
        answers = {}
        for subindex, (key, expected) in enumerate(identity._asdict().items(), start=1):
            if not self.knows(Object.IDENTITY, subindex):
                if expected is not None:
                    raise InputError(
                        f"is not in the data sheet: its {key} cannot be asked",
                        where=f"{self.name}, object 0x1018:{subindex}",
                        remedy=f"{EDS_REMEDY}, or leave [drives] {key} out",
                    )
                continue
            answers[key] = self.read(Object.IDENTITY, subindex)
            where = f"{self.name}, object 0x1018:{subindex}"
            if expected is not None and answers[key] != expected:
                remedy = "this is another drive: correct the wiring, the node, or [drives]"
                raise InputError(f"{key} is 0x{answers[key]:X}, not 0x{expected:X}", where=where, remedy=remedy)
            if stated.get(key) not in (None, answers[key]):
                raise InputError(
                    f"{key} is 0x{answers[key]:X}, but 0x{stated[key]:X} in the data sheet",
                    where=where,
                    remedy=f"{EDS_REMEDY}, or set check_eds = false",
                )
        return answers

    def disable(self) -> bool:
        """Switch off the power of a drive before its configuration; True if it was powered.

        Commands go by SDO, as process data of an earlier master may still be configured.

        Raises:
            InputError: the drive is still powered after a second.
        """
        end = time.monotonic() + 1.0
        powered, previous = False, 0
        while (state := state_of(self.read(Object.STATUSWORD))) is not None:
            if not state.powered and state is not DriveState.SWITCHED_ON:
                return powered
            powered = True
            previous = controlword_towards(state, DriveState.SWITCH_ON_DISABLED, previous)
            self.write(Object.CONTROLWORD, previous, read_back=False)
            if time.monotonic() > end:
                break
        raise InputError(
            "the drive stays powered after a command to switch off",
            where=self.name,
            remedy="switch it off, and find out which other master commands it",
        )

    def configure(self, period: float, guards: Guards, say: Callable[[str], None]) -> None:
        """Set mode, limits and guards, and map the process data; the node must be PRE-OPERATIONAL.

        Args:
            period: time between set-points [s].
            guards: see there.
            say: takes a line for every object that is left out, or set to less than was asked.

        Raises:
            InputError: if the drive does not keep a written value, lacks a guard that it must have, or would wrap its
                position within the travel.
        """
        lacking = self.lacking()
        check_guards(lacking, self.unguarded, where=f"{self.name}, data sheet")
        for index in lacking:
            say(f"{self.name} is without 0x{index:04X}: {LEFT_OUT[index]}")
        for index, subindex, value in self._settings(period, guards):
            if index not in lacking:
                self.write(index, self._within(index, subindex, value, say), subindex)
        end = time.monotonic() + _MODE_TIME
        while (mode := self.read(Object.MODE_DISPLAY)) != CYCLIC_SYNCHRONOUS_POSITION and time.monotonic() < end:
            time.sleep(0.005)
        if mode != CYCLIC_SYNCHRONOUS_POSITION:
            raise InputError(
                f"stays in mode {mode}", where=f"{self.name}, object 0x6061", remedy="look into its manual"
            )
        set_point, command, status = self.process_data()
        self._map(self.node.remote.rpdo[set_point], self.identifiers.set_point, 1, objects.SETPOINT_MAP)
        self._map(self.node.remote.rpdo[command], self.identifiers.command, 255, objects.COMMAND_MAP)
        self._map(self.node.remote.tpdo[status], self.identifiers.status, 1, objects.STATUS_MAP)
        self.node.network.subscribe(self.identifiers.status, self._on_status)
        self.target = self.read(Object.POSITION)
        self.controlword = int(Controlword.DISABLE_VOLTAGE)

    def process_data(self) -> tuple[int, int, int]:
        """Numbers of its process data: RPDO of set-points, RPDO of the controlword alone, TPDO of its status.

        CiA 402 has 64 of each for an axis; a node without process data 65 is assumed to number the process data of all
        axes in turn.

        Raises:
            InputError: if the data sheet has too few.
        """
        axis, rpdo, tpdo = self.motor.axis, self.node.remote.rpdo, self.node.remote.tpdo
        first = objects.PDOS_OF_AXIS * (axis - 1) + 1
        wanted = (first, first + 1, first) if first in rpdo else (2 * axis - 1, 2 * axis, axis)
        for number, maps in zip(wanted, (rpdo, rpdo, tpdo), strict=True):
            if number not in maps:
                raise InputError(f"has no process data {number}", where=f"{self.name}, data sheet", remedy=EDS_REMEDY)
        return wanted

    def _within(self, index: int, subindex: int, value: int, say: Callable[[str], None]) -> int:
        """The value, or the drive's largest value if that is smaller."""
        variable = self.variable(index, subindex)
        largest = None if variable is None else variable.max
        if index not in STRICTER_BELOW or largest is None or value <= largest:
            return value
        say(f"{self.name} takes no more than {largest} for 0x{index:04X}, where {value} was meant")
        return int(largest)

    def _settings(self, period: float, guards: Guards) -> list[tuple[int, int, int]]:
        """Index, subindex and value of everything that is set, in the drive's own units."""
        motor = self.motor
        ends = self._ends()
        fastest = motor.rate_limit_m_s * motor.counts_per_metre
        speed, acceleration = self._factors()
        braking = motor.acceleration_limit_m_s2 * motor.counts_per_metre
        greatest = motor.per_mille(motor.tension_limit_n[1])
        return [
            (Object.MODE, 0, CYCLIC_SYNCHRONOUS_POSITION),
            (Object.INTERPOLATION_TIME, 2, -3),
            (Object.INTERPOLATION_TIME, 1, round(1e3 * period)),
            (Object.POSITION_LIMIT, 1, ends[0]),
            (Object.POSITION_LIMIT, 2, ends[1]),
            (Object.FOLLOWING_WINDOW, 0, round(guards.following_error_m * motor.counts_per_metre)),
            (Object.FOLLOWING_TIMEOUT, 0, round(1e3 * guards.following_time_s)),
            (Object.MAX_TORQUE, 0, max(1, round(1.2 * greatest))),
            # Half as much again: it must not cut into the set-points.
            (Object.MAX_MOTOR_SPEED, 0, max(1, round(1.5 * fastest / speed))),
            (Object.QUICK_STOP_DECELERATION, 0, max(1, round(braking / acceleration))),
            (Object.QUICK_STOP_OPTION, 0, 6),  # slow down on the quick stop ramp, and hold
            (Object.ABORT_CONNECTION, 0, 3),  # quick stop if the master is lost
            (Object.CONSUMER_HEARTBEAT, 1, guards.master_node << 16 | round(1e3 * guards.master_timeout_s)),
            (Object.PRODUCER_HEARTBEAT, 0, round(1e3 * guards.drive_heartbeat_s)),
        ]

    def _map(self, pdo: PdoMap, cob: int, kind: int, entries: Sequence[tuple[int, int, int]]) -> None:
        """Map one PDO in the order that the standard asks for (off, empty, fill, count, on), and read it back."""
        where = f"{self.name}, process data 0x{cob:03X}"
        wanted = [(self.index(index), subindex, bits) for index, subindex, bits in entries]
        with self.node.sdo("cannot be mapped", where):
            pdo.read()
            # Off under its own identifier first: only an invalid PDO may change it.
            pdo.com_record[1].raw = int(pdo.com_record[1].raw) | objects.PDO_INVALID
            pdo.clear()
            for index, subindex, bits in wanted:
                if pdo.add_variable(index, subindex, bits) is None:
                    raise InputError(f"lacks object 0x{index:04X}", where=where, remedy=EDS_REMEDY)
            pdo.cob_id, pdo.trans_type, pdo.enabled = cob, kind, True
            pdo.save()
            pdo.read()
        mapped = [(variable.index, variable.subindex, variable.length) for variable in pdo.map]
        if mapped != wanted or pdo.cob_id != cob or pdo.trans_type != kind or not pdo.enabled:
            entries_read = ", ".join(f"0x{index:04X}:{sub} {bits} bits" for index, sub, bits in mapped)
            raise InputError(
                f"the drive keeps another mapping ({entries_read}; 0x{pdo.cob_id:X}, type {pdo.trans_type})",
                where=where,
                remedy="read its manual: it may map only the objects in its EDS",
            )
        # canopen would take frames of ours that the bus echoes for the drive's, and overwrite its buffer.
        network = self.node.network
        if pdo.on_message in network.subscribers.get(cob, []):
            network.unsubscribe(cob, pdo.on_message)

    # Process data

    def _on_status(self, identifier: int, data: bytearray, timestamp: float) -> None:
        if len(data) != objects.STATUS.size:
            self.short_frames += 1
            return
        statusword, position, torque = objects.STATUS.unpack(data)
        self.reading = Reading(statusword, position, torque, time.monotonic())
        self.on_status(self)

    on_status: Callable[[Drive], None] = staticmethod(lambda drive: None)


def drives_of(
    network: LoggedNetwork,
    motors: Sequence[Motor],
    offsets: Sequence[float],
    eds: str,
    answer: float = 0.3,
    units: Units = STANDARD,
    unguarded: Collection[int] = (),
) -> list[Drive]:
    """The drives of motors, several of which may be axes of one node.

    Args:
        network: network of the drives.
        motors: one motor per drive.
        offsets: counts of each motor at length zero.
        eds: path of the drives' electronic data sheet.
        answer: time limit of a node's answer to an SDO request [s].
        units, unguarded: see `Drive`.
    """
    axes = {motor.node: max(other.axis for other in motors if other.node == motor.node) for motor in motors}
    nodes = {number: Node(network, number, eds, highest, answer) for number, highest in axes.items()}
    own = identifiers([motor.place for motor in motors])
    return [
        Drive(nodes[motor.node], motor, offset, frames, units, unguarded)
        for motor, offset, frames in zip(motors, offsets, own, strict=True)
    ]


class Guards(NamedTuple):
    """Guards between master and drives."""

    master_node: int = 127  # node number under which the master sends heartbeats
    master_timeout_s: float = 0.06  # drives quick-stop if no heartbeat came for this long
    drive_heartbeat_s: float = 0.015  # time between heartbeats of a drive
    # following_error_m, following_time_s: a drive faults if it lags behind its set-point by this length for this time
    following_error_m: float = 0.005
    following_time_s: float = 0.05


class Drives:
    """All drives of a robot.

    Args:
        network: network of the drives.
        drives: drives in the order of the robot's channels.
        guards: see there.
    """

    def __init__(self, network: LoggedNetwork, drives: Sequence[Drive], guards: Guards) -> None:
        self.network, self.guards = network, guards
        self.all = tuple(drives)
        self.emergencies: deque[Emergency] = deque(maxlen=1000)
        self._nodes = {drive.motor.node: drive.node for drive in self.all}
        self._awaited: set[Drive] = set()
        self._complete = threading.Event()
        self._sending = threading.Lock()
        self._stopped = threading.Event()
        self._next_heartbeat = 0.0
        for drive in self.all:
            drive.on_status = self._arrived
        for number in self._nodes:
            network.subscribe(objects.EMCY + number, self._on_emergency)

    def manage(self, command: Nmt) -> None:
        """Send a command of network management to every node of ours, and to no other."""
        for number in self._nodes:
            self.network.send_message(objects.NMT, bytes([command, number]))

    def configure(self, period: float, say: Callable[[str], None]) -> None:
        """Bring every drive to rest, then configure it, then start its process data.

        Raises:
            InputError: see `Drive.configure`; or if a drive does not become OPERATIONAL within a second.
        """
        for drive in self.all:
            if drive.disable():
                say(f"{drive.name} was found powered, and has been switched off")
        self.manage(Nmt.PRE_OPERATIONAL)
        for drive in self.all:
            drive.configure(period, self.guards, say)
        for number, node in self._nodes.items():
            mine = [drive for drive in self.all if drive.motor.node == number]
            numbers = [drive.process_data() for drive in mine]
            received = {number for set_point, command, _ in numbers for number in (set_point, command)}
            node.switch_off_process_data(received, {status for _, _, status in numbers}, mine[0].name)
        self.manage(Nmt.START)
        end = time.monotonic() + 1.0
        while waiting := [drive for drive in self.all if drive.node.nmt != NmtState.OPERATIONAL]:
            if time.monotonic() > end:
                raise InputError(
                    f"does not become OPERATIONAL (its heartbeat reports {waiting[0].node.nmt})",
                    where=waiting[0].name,
                    remedy="power it off and on",
                )
            time.sleep(0.005)

    def exchange(self, timeout: float, meanwhile: Callable[[], None] | None = None) -> bool:
        """One cycle: set-points, SYNC, heartbeat; then wait for the answers.

        Args:
            timeout: longest wait [s].
            meanwhile: function called before the wait.

        Returns:
            Whether every drive has answered in time.

        Raises:
            CanError: if the bus does not take a frame.
        """
        with self._sending:
            stopped = self._stopped.is_set()
            for drive in self.all:
                if stopped:
                    drive.controlword = int(Controlword.QUICK_STOP)
                data = objects.SETPOINT.pack(drive.controlword, drive.target)
                self.network.send_message(drive.identifiers.set_point, data)
            self._awaited = set(self.all)
            self._complete.clear()
            self.network.send_message(objects.SYNC, b"")
        self.send_heartbeat()
        if meanwhile is not None:
            meanwhile()
        complete = self._complete.wait(timeout)
        for drive in self.all:
            drive.unanswered = drive.unanswered + 1 if drive in self._awaited else 0
        return complete

    def send_heartbeat(self) -> None:
        """Send the master's heartbeat if it is due: four times within the drives' timeout."""
        now = time.monotonic()
        if now >= self._next_heartbeat:
            self._next_heartbeat = now + 0.25 * self.guards.master_timeout_s - 1e-3
            self.network.send_message(objects.HEARTBEAT + self.guards.master_node, bytes([NmtState.OPERATIONAL]))

    def quick_stop(self) -> list[str]:
        """Stop every drive at once, from any thread, whatever the control loop does; it stays stopped.

        The controlword goes out in its own PDO that needs no SYNC. If a frame cannot be sent, the others still
        are, and the drive's own guard stops it.

        Returns:
            One line for each frame that could not be sent.
        """
        self._stopped.set()
        # Behind a cycle that is being sent: its set-points still say "enable", and would undo the stop.
        locked = self._sending.acquire(timeout=0.02)
        failures = []
        try:
            for drive in self.all:
                drive.controlword = int(Controlword.QUICK_STOP)
                try:
                    self.network.send_message(drive.identifiers.command, objects.COMMAND.pack(Controlword.QUICK_STOP))
                except can.CanError as error:
                    failures.append(f"{drive.name}: {error}")
        finally:
            if locked:
                self._sending.release()
        return failures

    @property
    def stopped(self) -> bool:
        """Whether `quick_stop` was called."""
        return self._stopped.is_set()

    def _arrived(self, drive: Drive) -> None:
        self._awaited.discard(drive)
        if not self._awaited:
            self._complete.set()

    def _on_emergency(self, identifier: int, data: bytearray, timestamp: float) -> None:
        if len(data) != 8:
            data = bytearray(data[:8].ljust(8, b"\0"))
        code, register, _ = objects.EMERGENCY.unpack(data)
        channels = tuple(drive.motor.channel for drive in self.all if drive.motor.node == identifier - objects.EMCY)
        self.emergencies.append(Emergency(time.monotonic(), channels, code, register))


_SET: dict[Object, tuple[int, ...]] = {
    Object.MODE: (0,),
    Object.INTERPOLATION_TIME: (1, 2),
    Object.POSITION_LIMIT: (1, 2),
    Object.FOLLOWING_WINDOW: (0,),
    Object.FOLLOWING_TIMEOUT: (0,),
    Object.MAX_TORQUE: (0,),
    Object.MAX_MOTOR_SPEED: (0,),
    Object.QUICK_STOP_DECELERATION: (0,),
    Object.QUICK_STOP_OPTION: (0,),
    Object.ABORT_CONNECTION: (0,),
    Object.CONSUMER_HEARTBEAT: (1,),
    Object.PRODUCER_HEARTBEAT: (0,),
}
"""Objects that `Drive.configure` writes, with their subindexes."""

_MODE_TIME = 0.2  # [s]: a drive may take some cycles to change its mode
