"""The simulated drive by itself, against what CiA 301 and CiA 402 ask of one."""

from __future__ import annotations

import itertools
import struct

import pytest

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bench.simulated_node import SimulatedFault, SimulatedNode
from rfdropo_bayes.deployment.cia402 import Controlword, DriveState, Status, state_of
from rfdropo_bayes.deployment.objects import EmergencyCode, Nmt, NmtState, Object

NODE = 5


class Bench:
    """A drive without a bus: time passes when told, frames it sends are kept."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.node = SimulatedNode(NODE, lambda identifier, data: self.sent.append((identifier, bytes(data))))
        (self.drive,) = self.node.drives
        self.now = 0.0
        self.wait(0.05)

    def wait(self, seconds: float) -> None:
        for _ in range(max(1, round(seconds / 0.002))):
            self.now += 0.002
            self.node.tick(self.now)

    def take(self, identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        self.sent.clear()
        self.node.receive(identifier, data, self.now)
        return list(self.sent)

    def sdo(self, index: int, subindex: int = 0, value: int | None = None, size: int = 4) -> int:
        """Expedited transfer, packed by hand from CiA 301, 7.2.4.3; returns the value, or the negative abort code."""
        if value is None:
            request = struct.pack("<BHB4x", 0x40, index, subindex)
        else:
            raw = (value & (1 << 8 * size) - 1).to_bytes(size, "little").ljust(4, b"\0")
            request = struct.pack("<BHB4s", 0x23 | 4 - size << 2, index, subindex, raw)
        ((_identifier, answer),) = [row for row in self.take(0x600 + NODE, request) if row[0] == 0x580 + NODE]
        if answer[0] == 0x80:
            return -int.from_bytes(answer[4:], "little")
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little")

    def operational(self) -> None:
        self.sdo(Object.MODE, value=8, size=1)
        self.take(objects.NMT, bytes([Nmt.START, NODE]))

    def cycle(self, controlword: int, target: int) -> tuple[int, int, int]:
        self.take(objects.RPDO1 + NODE, objects.SETPOINT.pack(controlword, target))
        self.now += 0.01
        sent = self.take(objects.SYNC, b"")
        return objects.STATUS.unpack(dict(sent)[objects.TPDO1 + NODE])

    def enable(self, target: int = 0) -> None:
        self.operational()
        for word in (Controlword.SHUTDOWN, Controlword.SWITCH_ON, Controlword.ENABLE_OPERATION):
            self.cycle(word, target)

    @property
    def state(self) -> DriveState | None:
        return state_of(self.drive.statusword())


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_it_boots_and_says_so(bench: Bench) -> None:
    assert (objects.HEARTBEAT + NODE, bytes([NmtState.BOOT_UP])) in bench.sent
    assert bench.node.nmt is NmtState.PRE_OPERATIONAL


def test_identity_and_types_are_those_of_the_data_sheet(bench: Bench) -> None:
    assert bench.sdo(Object.DEVICE_TYPE) & 0xFFFF == 402
    assert bench.sdo(Object.IDENTITY, 2) == 0x52464401
    assert bench.sdo(Object.SUPPORTED_MODES) & objects.CSP_BIT


@pytest.mark.parametrize(
    ("index", "subindex", "value", "size", "abort"),
    [
        (0x5555, 0, None, 4, 0x06020000),  # no such object
        (Object.IDENTITY, 9, None, 4, 0x06090011),  # no such subindex
        (Object.STATUSWORD, 0, 1, 2, 0x06010002),  # read only
        (Object.PRODUCER_HEARTBEAT, 0, 1, 4, 0x06070010),  # wrong length
        (Object.DEVICE_TYPE, 3, None, 4, 0x06090011),  # a plain variable has subindex 0 alone
        (Object.ABORT_CONNECTION, 0, 9, 2, 0x06090031),  # too high
        (Object.QUICK_STOP_OPTION, 0, -1, 2, 0x06090032),  # too low
        (Object.MODE, 0, 1, 1, 0x06090030),  # a mode that it does not have
        (Object.TPDO, 2, 245, 1, 0x06090030),  # reserved transmission type
        (Object.TPDO, 1, 0xE0000185, 4, 0x06090030),  # 29-bit identifier
        (Object.ERROR_FIELD, 0, 1, 1, 0x06090030),  # only 0 clears it
        (Object.RPDO_MAP, 0, 0, 1, 0x08000022),  # mapped anew while the PDO is on
        (Object.RPDO, 1, 0x345, 4, 0x06090030),  # another identifier while the PDO is on
    ],
)
def test_wrong_transfers_are_aborted_with_the_standards_code(bench, index, subindex, value, size, abort) -> None:
    assert bench.sdo(index, subindex, value, size) == -abort


def test_mapping_goes_in_the_standards_order_only(bench: Bench) -> None:
    cob = bench.sdo(Object.RPDO, 1)
    assert bench.sdo(Object.RPDO, 1, cob | objects.PDO_INVALID) >= 0
    assert bench.sdo(Object.RPDO_MAP, 1, 0x60400010) == -0x08000022  # the count is not zero yet
    assert bench.sdo(Object.RPDO_MAP, 0, 0, 1) >= 0
    assert bench.sdo(Object.RPDO_MAP, 1, 0x60650020) == -0x06040041  # not mappable
    assert bench.sdo(Object.RPDO_MAP, 1, 0x60400020) == -0x06040041  # 16 bits, not 32
    assert bench.sdo(Object.RPDO_MAP, 1, 0x60400010) >= 0
    assert bench.sdo(Object.RPDO_MAP, 2, 0x607A0020) >= 0
    assert bench.sdo(Object.RPDO_MAP, 0, 2, 1) >= 0
    assert bench.sdo(Object.RPDO, 1, cob) >= 0


def test_no_pdo_before_operational_and_no_sdo_when_stopped(bench: Bench) -> None:
    assert bench.take(objects.SYNC, b"") == []
    bench.operational()
    assert [identifier for identifier, _ in bench.take(objects.SYNC, b"")] == [objects.TPDO1 + NODE]
    bench.take(objects.NMT, bytes([Nmt.STOP, 0]))
    assert bench.take(0x600 + NODE, struct.pack("<BHB4x", 0x40, 0x1000, 0)) == []
    assert bench.take(objects.SYNC, b"") == []


def test_commands_to_other_nodes_are_left_alone(bench: Bench) -> None:
    bench.take(objects.NMT, bytes([Nmt.START, NODE + 1]))
    assert bench.node.nmt is NmtState.PRE_OPERATIONAL


def test_set_points_are_applied_on_sync_alone(bench: Bench) -> None:
    bench.enable()
    bench.take(objects.RPDO1 + NODE, objects.SETPOINT.pack(Controlword.ENABLE_OPERATION, 500))
    bench.wait(0.05)
    assert bench.drive.position == 0.0
    bench.take(objects.SYNC, b"")
    bench.wait(0.1)
    assert bench.drive.position == pytest.approx(500, abs=1)


def test_the_command_alone_needs_no_sync(bench: Bench) -> None:
    bench.enable()
    bench.take(objects.RPDO2 + NODE, objects.COMMAND.pack(Controlword.QUICK_STOP))
    assert bench.state is DriveState.QUICK_STOP_ACTIVE


def test_position_follows_and_stops_at_the_drives_own_limits(bench: Bench) -> None:
    bench.sdo(Object.POSITION_LIMIT, 1, -300)
    bench.sdo(Object.POSITION_LIMIT, 2, 300)
    bench.enable()
    for _ in range(20):
        word, position, _ = bench.cycle(Controlword.ENABLE_OPERATION, 5000 if bench.now < 1 else 0)
    assert position == pytest.approx(300, abs=1)
    assert word & Status.LIMIT_ACTIVE


def test_speed_is_limited(bench: Bench) -> None:
    bench.sdo(Object.MAX_MOTOR_SPEED, 0, 60)  # one turn of 2048 counts a second
    bench.sdo(Object.FOLLOWING_WINDOW, 0, 10**6)
    bench.enable()
    positions = [bench.cycle(Controlword.ENABLE_OPERATION, 10**5)[1] for _ in range(20)]
    steps = [after - before for before, after in itertools.pairwise(positions)]
    assert max(steps) <= 2048 * 0.01 + 1


def test_an_unfollowed_set_point_faults(bench: Bench) -> None:
    bench.enable()
    bench.sdo(Object.SIMULATED_FAULT, 0, SimulatedFault.JAMMED, 1)
    bench.sdo(Object.FOLLOWING_WINDOW, 0, 100)
    bench.sdo(Object.FOLLOWING_TIMEOUT, 0, 30, 2)
    seen = []
    for _ in range(8):
        bench.take(objects.RPDO1 + NODE, objects.SETPOINT.pack(Controlword.ENABLE_OPERATION, 1000))
        bench.now += 0.01
        seen += bench.take(objects.SYNC, b"")
    codes = [objects.EMERGENCY.unpack(data)[0] for identifier, data in seen if identifier == objects.EMCY + NODE]
    assert codes == [EmergencyCode.FOLLOWING_ERROR]
    assert bench.state is DriveState.FAULT


def test_a_fault_needs_a_rising_edge_and_tells_its_end(bench: Bench) -> None:
    bench.enable()
    bench.sdo(Object.SIMULATED_FAULT, 0, SimulatedFault.OVER_CURRENT, 1)
    assert bench.state is DriveState.FAULT
    assert bench.sdo(Object.ERROR_CODE) == EmergencyCode.OVER_CURRENT
    bench.cycle(Controlword.ENABLE_OPERATION, 0)
    assert bench.state is DriveState.FAULT
    sent = bench.take(objects.RPDO2 + NODE, objects.COMMAND.pack(Controlword.FAULT_RESET))
    assert bench.state is DriveState.SWITCH_ON_DISABLED
    assert [objects.EMERGENCY.unpack(data)[0] for identifier, data in sent if identifier == objects.EMCY + NODE] == [0]


@pytest.mark.parametrize(
    ("option", "state"),
    [
        (0, DriveState.OPERATION_ENABLED),
        (1, DriveState.FAULT),
        (2, DriveState.SWITCH_ON_DISABLED),
        (3, DriveState.QUICK_STOP_ACTIVE),
    ],
)
def test_a_lost_master_is_answered_as_object_6007_says(bench: Bench, option: int, state: DriveState) -> None:
    bench.sdo(Object.ABORT_CONNECTION, 0, option, 2)
    bench.sdo(Object.QUICK_STOP_OPTION, 0, 6, 2)
    bench.sdo(Object.CONSUMER_HEARTBEAT, 1, 127 << 16 | 60)
    bench.enable()
    bench.wait(0.5)
    assert bench.state is DriveState.OPERATION_ENABLED  # guarded from the first heartbeat on
    for _ in range(5):
        bench.take(objects.HEARTBEAT + 127, bytes([5]))
        bench.wait(0.04)
    assert bench.state is DriveState.OPERATION_ENABLED
    bench.wait(0.03)
    assert bench.state is state
    codes = [objects.EMERGENCY.unpack(d)[0] for i, d in bench.sent if i == objects.EMCY + NODE]
    assert EmergencyCode.HEARTBEAT_LOST in codes


def test_a_lost_sync_is_noticed_after_one_and_a_half_cycles(bench: Bench) -> None:
    bench.sdo(Object.ABORT_CONNECTION, 0, 3, 2)
    bench.sdo(Object.QUICK_STOP_OPTION, 0, 6, 2)
    bench.sdo(Object.CYCLE_PERIOD, 0, 10_000)
    bench.enable()
    bench.wait(0.012)
    assert bench.state is DriveState.OPERATION_ENABLED
    bench.wait(0.006)
    assert bench.state is DriveState.QUICK_STOP_ACTIVE


def test_a_short_set_point_is_refused_and_told(bench: Bench) -> None:
    bench.enable()
    ((identifier, data),) = bench.take(objects.RPDO1 + NODE, b"\x0f\x00\x01")
    assert identifier == objects.EMCY + NODE
    assert objects.EMERGENCY.unpack(data)[0] == EmergencyCode.PDO_SHORT


def test_a_quick_stop_brakes_on_the_ramp(bench: Bench) -> None:
    """From 100 counts a cycle at 1e5 counts/s2: v^2 / 2a = 500 counts, and no further."""
    bench.sdo(Object.QUICK_STOP_DECELERATION, 0, 100_000)
    bench.sdo(Object.QUICK_STOP_OPTION, 0, 6, 2)
    bench.enable()
    for number in range(30):
        bench.cycle(Controlword.ENABLE_OPERATION, 100 * number)
    start, speed = bench.drive.position, bench.drive.velocity
    bench.take(objects.RPDO2 + NODE, objects.COMMAND.pack(Controlword.QUICK_STOP))
    bench.wait(0.5)
    assert bench.drive.velocity == 0.0
    assert bench.drive.position - start == pytest.approx(speed**2 / 2e5, rel=0.1)


def test_heartbeats_come_at_their_period(bench: Bench) -> None:
    bench.sdo(Object.PRODUCER_HEARTBEAT, 0, 20, 2)
    bench.sent.clear()
    bench.wait(1.0)
    beats = [data for identifier, data in bench.sent if identifier == objects.HEARTBEAT + NODE]
    assert len(beats) == pytest.approx(50, abs=2)
    assert set(beats) == {bytes([NmtState.PRE_OPERATIONAL])}


SDO = 0x600 + NODE


def abort_of(frames: list[tuple[int, bytes]]) -> int:
    """Code of the one abort among the answers."""
    ((_, answer),) = [row for row in frames if row[0] == 0x580 + NODE]
    assert answer[0] == 0x80
    return int.from_bytes(answer[4:], "little")


@pytest.mark.parametrize("frame", ["60", "70", "00", "0D", "E0", "C0", "A0"])
def test_what_nothing_has_begun_is_aborted_and_the_server_lives_on(bench: Bench, frame: str) -> None:
    """Segments without a beginning, block transfers, and a command that CiA 301 does not know."""
    assert abort_of(bench.take(SDO, bytes.fromhex(frame).ljust(8, b"\0"))) == 0x05040001
    assert bench.take(SDO, b"\x40\x00\x10") == []  # no SDO has three bytes
    assert bench.sdo(Object.DEVICE_TYPE) & 0xFFFF == 402


def test_a_segmented_upload_keeps_to_its_toggle_bit(bench: Bench) -> None:
    bench.take(SDO, bytes.fromhex("4008100000000000"))  # device name: longer than four bytes
    bench.take(SDO, bytes.fromhex("6000000000000000"))
    assert abort_of(bench.take(SDO, bytes.fromhex("6000000000000000"))) == 0x05030000
    assert abort_of(bench.take(SDO, bytes.fromhex("7000000000000000"))) == 0x05040001  # it has ended


def test_a_segmented_download_has_the_length_that_it_announced(bench: Bench) -> None:
    begin, last = bytes.fromhex("2117100002000000"), bytes.fromhex("0B64000000000000")
    bench.take(SDO, begin)
    bench.take(SDO, last)  # 100 ms in two bytes
    assert bench.sdo(Object.PRODUCER_HEARTBEAT) == 100
    bench.take(SDO, begin)
    assert abort_of(bench.take(SDO, bytes.fromhex("0964000000000000"))) == 0x06070010  # three bytes
    assert abort_of(bench.take(SDO, bytes.fromhex("2141600002000000"))) == 0x06010002  # read only: at the first frame


def test_an_expedited_download_may_leave_its_length_open(bench: Bench) -> None:
    bench.take(SDO, bytes.fromhex("2217100032000000"))
    assert bench.sdo(Object.PRODUCER_HEARTBEAT) == 50


@pytest.mark.parametrize(
    ("maps", "comm", "entry", "abort"),
    [
        (Object.RPDO_MAP, Object.RPDO, 0x60410010, 0x06040041),  # nobody may write the statusword
        (Object.RPDO_MAP, Object.RPDO, 0x60400020, 0x06040041),  # 32 bits of 16
        (Object.TPDO_MAP, Object.TPDO, 0x55550010, 0x06020000),
    ],
)
def test_what_cannot_be_mapped_is_refused(bench: Bench, maps: int, comm: int, entry: int, abort: int) -> None:
    bench.sdo(comm, 1, bench.sdo(comm, 1) | objects.PDO_INVALID)
    bench.sdo(maps, 0, 0, 1)
    assert bench.sdo(maps, 1, entry) == -abort
    bench.sdo(maps, 1, 0)
    assert bench.sdo(maps, 0, 1, 1) == -0x06040041  # an empty entry is none
    assert bench.sdo(maps, 0, 9, 1) == -0x06090031


def transmissions(bench: Bench, kind: int, event_timer: int = 0, inhibit: int = 0) -> None:
    """TPDO 1 of another kind; its content is the statusword alone."""
    bench.sdo(Object.TPDO, 1, bench.sdo(Object.TPDO, 1) | objects.PDO_INVALID)
    bench.sdo(Object.TPDO, 2, kind, 1)
    bench.sdo(Object.TPDO, 3, inhibit, 2)
    bench.sdo(Object.TPDO, 5, event_timer, 2)
    bench.sdo(Object.TPDO_MAP, 0, 0, 1)
    bench.sdo(Object.TPDO_MAP, 1, 0x60410010)
    bench.sdo(Object.TPDO_MAP, 0, 1, 1)
    bench.sdo(Object.TPDO, 1, bench.sdo(Object.TPDO, 1) & ~objects.PDO_INVALID)
    bench.operational()


def statuses(bench: Bench) -> int:
    return sum(identifier == objects.TPDO1 + NODE for identifier, _ in bench.sent)


@pytest.mark.parametrize(("kind", "answers"), [(0, 1), (1, 6), (3, 2)])
def test_a_synchronous_status_comes_with_every_nth_sync_or_with_the_next_after_a_change(
    bench: Bench, kind: int, answers: int
) -> None:
    transmissions(bench, kind)
    assert sum(len(bench.take(objects.SYNC, b"")) for _ in range(6)) == answers


def test_an_event_driven_status_comes_with_a_change_and_with_its_timer(bench: Bench) -> None:
    transmissions(bench, 255)
    bench.sent.clear()
    bench.wait(0.1)
    assert statuses(bench) == 1
    bench.sdo(Object.CONTROLWORD, value=Controlword.SHUTDOWN, size=2)
    bench.wait(0.1)
    assert statuses(bench) == 1
    bench.take(objects.NMT, bytes([Nmt.PRE_OPERATIONAL, NODE]))
    transmissions(bench, 254, event_timer=20)
    bench.sent.clear()
    bench.wait(0.1)
    assert 4 <= statuses(bench) <= 6
    bench.take(objects.NMT, bytes([Nmt.PRE_OPERATIONAL, NODE]))
    transmissions(bench, 254, event_timer=2, inhibit=500)  # 50 ms
    bench.sent.clear()
    bench.wait(0.1)
    assert 2 <= statuses(bench) <= 3


@pytest.mark.parametrize(
    ("behaviour", "state"), [(0, NmtState.PRE_OPERATIONAL), (1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)]
)
def test_a_lost_heartbeat_does_what_the_error_behaviour_says(bench: Bench, behaviour: int, state: NmtState) -> None:
    bench.sdo(Object.ERROR_BEHAVIOUR, 1, behaviour, 1)
    bench.sdo(Object.CONSUMER_HEARTBEAT, 1, 127 << 16 | 20)
    bench.enable()
    bench.take(objects.HEARTBEAT + 127, b"\x05")
    bench.wait(0.1)
    assert bench.node.nmt is state
    if state is not NmtState.STOPPED:
        assert bench.sdo(Object.ERROR_FIELD, 1) == EmergencyCode.HEARTBEAT_LOST
        assert bench.sdo(Object.ERROR_FIELD, 0, 0, 1) == 0
        assert bench.sdo(Object.ERROR_FIELD, 1) == 0


@pytest.mark.parametrize(("option", "state"), [(2, DriveState.SWITCH_ON_DISABLED), (6, DriveState.QUICK_STOP_ACTIVE)])
def test_a_quick_stop_ends_as_its_option_says(bench: Bench, option: int, state: DriveState) -> None:
    bench.sdo(Object.QUICK_STOP_OPTION, 0, option, 2)
    bench.enable()
    bench.cycle(Controlword.QUICK_STOP, 0)
    bench.wait(0.1)
    assert bench.state is state
