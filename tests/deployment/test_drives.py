"""The master's side against simulated drives in this process: set-up with read-back, exchange, stop, refusals."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.causes import Stop
from rfdropo_bayes.deployment.cia402 import Controlword, DriveState, controlword_towards
from rfdropo_bayes.deployment.clock import Tick
from rfdropo_bayes.deployment.drives import Drives, Guards, Identity, Reading
from rfdropo_bayes.deployment.objects import Object
from rfdropo_bayes.deployment.settings import SafetyTable
from rfdropo_bayes.deployment.watch import Watch
from rfdropo_bayes.errors import InputError

LONG = 0.5  # [s]: a loaded machine answers in time, too


def enable(drives: Drives) -> None:
    for _ in range(20):
        for drive in drives.all:
            if drive.state is not None:
                drive.controlword = controlword_towards(drive.state, DriveState.OPERATION_ENABLED, drive.controlword)
        assert drives.exchange(LONG)
        if all(drive.state is DriveState.OPERATION_ENABLED for drive in drives.all):
            return
    raise AssertionError([drive.state for drive in drives.all])


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


def test_drives_say_who_they_are(rig) -> None:
    for drive in rig.drives().all:
        found = drive.check(Identity(product=0x52464401))
        assert found["modes"] & objects.CSP_BIT
        assert found["rated_torque"] == 12


def test_set_up_writes_mode_limits_guards_and_mapping(rig) -> None:
    drives = rig.drives(Guards(master_node=126, master_timeout_s=0.5))
    drives.configure(0.01, lambda text: None)
    for drive, simulated in zip(drives.all, rig.simulated.drives, strict=True):
        motor = drive.motor
        ends = sorted(motor.counts(length, 0) for length in motor.length_limit_m)
        assert [simulated.value(Object.POSITION_LIMIT, k) for k in (1, 2)] == ends
        assert simulated.value(Object.MODE) == 8
        assert simulated.value(Object.INTERPOLATION_TIME, 1) == 10
        assert simulated.value(Object.CONSUMER_HEARTBEAT, 1) == 126 << 16 | 500
        assert simulated.value(Object.ABORT_CONNECTION) == 3
        assert simulated.value(Object.QUICK_STOP_OPTION) == 6
        assert simulated.value(Object.RPDO_MAP, 2) == 0x607A0020
        assert simulated.value(Object.TPDO_MAP, 3) == 0x60770010
        assert simulated.value(Object.TPDO + 1, 1) & objects.PDO_INVALID


def test_set_points_move_the_drives_and_status_comes_back(rig) -> None:
    drives = rig.drives(Guards(master_timeout_s=5.0))
    drives.configure(0.01, lambda text: None)
    enable(drives)
    for drive in drives.all:
        drive.target = drive.motor.counts(0.003, drive.offset)
    for _ in range(10):
        assert drives.exchange(LONG)
        time.sleep(0.01)
    for drive in drives.all:
        assert drive.length == pytest.approx(0.003, abs=1e-5)
        assert drive.tension == pytest.approx(2.0 + 400 * 0.003, abs=0.04)  # SpringCables, to a per mille of torque


def test_a_drive_found_enabled_is_switched_off_before_anything_else(rig) -> None:
    first = rig.drives(Guards(master_timeout_s=5.0))
    first.configure(0.01, lambda text: None)
    enable(first)
    notes: list[str] = []
    second = rig.drives(Guards(master_timeout_s=5.0))
    second.configure(0.01, notes.append)
    assert len(notes) == 4
    assert "found powered" in notes[0]
    assert all(drive.state is DriveState.SWITCH_ON_DISABLED for drive in rig.simulated.drives)
    enable(second)
    assert all(abs(length) < 1e-6 for length in rig.simulated.lengths())  # nothing jumped


def test_a_quick_stop_wins_over_a_cycle_that_is_being_sent(rig) -> None:
    """From another thread, a thousand times a second, against cycles that enable: never is a drive enabled again."""
    drives = rig.drives(Guards(master_timeout_s=5.0))
    drives.configure(0.01, lambda text: None)
    enable(drives)
    done = threading.Event()

    def cycles() -> None:
        while not done.is_set():
            for drive in drives.all:
                drive.controlword = int(Controlword.ENABLE_OPERATION)
            drives.exchange(LONG)

    thread = threading.Thread(target=cycles)
    thread.start()
    time.sleep(0.05)
    assert drives.quick_stop() == []
    until(lambda: all(drive.state is DriveState.QUICK_STOP_ACTIVE for drive in rig.simulated.drives))
    time.sleep(0.1)
    done.set()
    thread.join()
    assert all(drive.state is DriveState.QUICK_STOP_ACTIVE for drive in rig.simulated.drives)


def test_two_threads_may_read_one_drive(rig) -> None:
    drive = rig.drives().all[0]
    wrong: list[object] = []

    def read(index: int, expected: int) -> None:
        for _ in range(100):
            value = drive.read(index)
            if value != expected:
                wrong.append(value)

    threads = [
        threading.Thread(target=read, args=(Object.DEVICE_TYPE, 0x00020192)),
        threading.Thread(target=read, args=(Object.SUPPORTED_MODES, 0x80)),
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


@pytest.mark.parametrize("key", ["vendor", "product", "revision", "serial"])
def test_another_identity_is_refused(rig, key: str) -> None:
    with pytest.raises(InputError, match=rf"{key} is 0x.*, not 0x63.*0x1018|0x1018.*{key} is 0x.*, not 0x63"):
        rig.drives().all[1].check(Identity(**{key: 99}))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("ProductNumber=0x52464401", "ProductNumber=0x52464402", "0x52464402 in the data sheet"),
        ("value\nObjectType=0x7\nDataType=0x0004", "value\nObjectType=0x7\nDataType=0x0003", "32 bits by CiA 402"),
        ("[6041]", "[6F41]", "the data sheet lacks it"),
    ],
)
def test_a_data_sheet_of_another_drive_is_refused(rig, tmp_path: Path, old: str, new: str, message: str) -> None:
    text = objects.SIMULATED_EDS.read_text()
    assert old in text
    sheet = tmp_path / "other.eds"
    sheet.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        rig.drives(eds=str(sheet)).all[0].check(Identity())


def test_a_data_sheet_out_of_step_is_used_if_asked(rig, tmp_path: Path) -> None:
    text = objects.SIMULATED_EDS.read_text()
    sheet = tmp_path / "other.eds"
    sheet.write_text(text.replace("ProductNumber=0x52464401", "ProductNumber=0x52464402"))
    found = rig.drives(eds=str(sheet)).all[0].check(Identity(), check_eds=False)
    assert found["product"] == 0x52464401


def test_no_data_sheet_and_no_answer_are_told_apart(rig, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a readable data sheet"):
        rig.drives(eds=str(tmp_path / "none.eds"))
    rig.simulated.nodes[3].crashed = True
    with pytest.raises(InputError, match=r"'down' \(node 3\), object 0x1000:0: cannot be read"):
        rig.drives().all[2].check(Identity())


@pytest.mark.parametrize(("answer", "heard"), [(0.05, False), (2.0, True)])
def test_a_slow_drive_is_waited_for_as_long_as_said(rig, monkeypatch, answer: float, heard: bool) -> None:
    slow = rig.simulated.nodes[1]
    receive = slow.receive
    monkeypatch.setattr(slow, "receive", lambda *frame: (time.sleep(0.2), receive(*frame)))
    drive = rig.drives(answer=answer).all[0]
    if heard:
        assert drive.read(Object.DEVICE_TYPE) & 0xFFFF == 402
    else:
        with pytest.raises(InputError, match="No SDO response"):
            drive.read(Object.DEVICE_TYPE)


def test_a_torque_that_would_falsify_tensions_is_refused(rig) -> None:
    rig.simulated.nodes[1].local.data_store[Object.RATED_TORQUE][0] = (500).to_bytes(4, "little")
    with pytest.raises(InputError, match="rated torque is 500"):
        rig.drives().all[0].check(Identity())


def test_a_drive_that_keeps_another_value_is_refused(rig) -> None:
    simulated = rig.simulated.nodes[1]
    read = simulated._read
    simulated.local._read_callbacks[:] = [
        lambda index, subindex, od: 77 if index == Object.POSITION_LIMIT else read(index, subindex, od)
    ]
    with pytest.raises(InputError, match="keeps 77 where"):
        rig.drives().configure(0.01, lambda text: None)


def test_emergencies_and_heartbeats_are_taken_in(rig) -> None:
    drives = rig.drives(Guards(drive_heartbeat_s=0.02, master_timeout_s=5.0))
    drives.configure(0.01, lambda text: None)
    until(lambda: all(drive.node.nmt == 5 for drive in drives.all))
    drives.all[1].write(Object.SIMULATED_FAULT, 4, read_back=False)
    until(lambda: len(drives.emergencies) > 0)
    assert drives.emergencies[0].channels == ("left",)
    assert drives.emergencies[0].code == 0x2310


def test_an_emergency_after_any_number_of_harmless_messages_ends_the_session(rig) -> None:
    """Drives that report an error as gone, again and again, fill what is kept of them."""
    drives = rig.drives(Guards(master_timeout_s=5.0))
    drives.configure(0.01, lambda text: None)  # a node that still boots has left OPERATIONAL
    watch = Watch(drives, SafetyTable())
    left = objects.EMCY + drives.all[1].motor.node
    heard = drives.network.subscribers[left][-1]
    for _ in range(3 * (drives.emergencies.maxlen or 0)):
        heard(left, bytearray(8), 0.0)
    tick = Tick(1, 0.0, 0.0, 0)
    for drive in drives.all:
        drive.reading = Reading(0x40, 0, 0, 0.0)
    watch.check(tick, None)
    heard(left, bytearray(objects.EMERGENCY.pack(0x2310, 1, b"")), 0.0)
    with pytest.raises(Stop, match="drive 'left' reports 0x2310"):
        watch.check(tick, None)


def test_a_drive_whose_first_status_is_late_is_waited_for(rig) -> None:
    """A loaded machine has no answer yet in the first cycle; nobody may read a tension of it."""
    drives = rig.drives(Guards(master_timeout_s=5.0))
    drives.configure(0.01, lambda text: None)
    Watch(drives, SafetyTable()).check(Tick(1, 0.0, 0.0, 0), None)
