"""Drives of several motors: each axis has its own objects, process data and identifiers, and no other's set-points."""

from __future__ import annotations

import configparser
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.causes import Stop
from rfdropo_bayes.deployment.cia402 import DriveState, controlword_towards
from rfdropo_bayes.deployment.clock import Tick
from rfdropo_bayes.deployment.drives import Drives, Guards, Identity, Reading, drives_of
from rfdropo_bayes.deployment.objects import Object, first_axis, identifiers, of_axis
from rfdropo_bayes.deployment.settings import SafetyTable
from rfdropo_bayes.deployment.watch import Watch
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot

from .conftest import Rig

TWO_BY_TWO = ((1, 1), (1, 2), (2, 1), (2, 2))
UNEVEN = ((5, 4), (5, 1), (5, 3), (6, 1))  # the second axis drives nothing
GUARDS = Guards(master_timeout_s=5.0)


def on(places: tuple[tuple[int, int], ...]) -> Robot:
    """The arm with four motors, on these nodes and axes."""
    table = Robot.load("motor_arm").model_dump()
    motors = [motor | {"node": node, "axis": axis} for motor, (node, axis) in zip(table["motors"], places, strict=True)]
    return Robot.model_validate(table | {"motors": motors})


@pytest.fixture
def rigs(hub: str) -> Iterator[Callable[..., Rig]]:
    """Makes simulated drives."""
    made: list[Rig] = []

    def make(places: tuple[tuple[int, int], ...], **table: object) -> Rig:
        made.append(Rig(hub, on(places), **table))
        return made[-1]

    yield make
    for rig in made:
        rig.close()


def configured(rig: Rig) -> Drives:
    drives = rig.drives(GUARDS)
    for drive in drives.all:
        drive.check(Identity(product=0x52464401))
    drives.configure(0.01, lambda text: None)
    return drives


def enable(drives: Drives) -> None:
    while not all(drive.state is DriveState.OPERATION_ENABLED for drive in drives.all):
        for drive in drives.all:
            if drive.state is not None:
                towards = DriveState.OPERATION_ENABLED
                drive.controlword = controlword_towards(drive.state, towards, drive.controlword)
        assert drives.exchange(0.5)


@pytest.mark.parametrize("index", [0x1018, 0x1A00, 0x2F00, 0x6007, 0x6040, 0x67FF])
@pytest.mark.parametrize("axis", range(1, objects.AXES + 1))
def test_objects_of_the_profile_alone_have_another_index_on_another_axis(index: int, axis: int) -> None:
    shifted = of_axis(index, axis)
    assert shifted == (index + 0x800 * (axis - 1) if index >= 0x6000 else index)
    assert first_axis(shifted) == (axis if index >= 0x6000 else 1, index)


def test_no_two_axes_share_an_identifier_and_none_is_taken() -> None:
    """Of all nodes with two axes, and of four nodes with eight."""
    taken = {0x000, 0x080} | {base + node for base in (0x080, 0x580, 0x600, 0x700) for node in range(1, 128)}
    for places in (
        [(node, axis) for node in range(1, 128) for axis in (1, 2)],
        [(node, axis) for node in (1, 2, 3, 127) for axis in range(1, 9)],
    ):
        used = [identifier for frames in identifiers(places) for identifier in frames]
        assert len(set(used)) == len(used) == 3 * len(places)
        assert not taken & set(used)
        assert max(used) < 0x700
    with pytest.raises(InputError, match="third or further axes"):
        identifiers([(node, axis) for node in range(1, 12) for axis in range(1, 9)])


@pytest.mark.parametrize("places", [TWO_BY_TWO, UNEVEN])
def test_a_set_point_moves_one_axis_alone(rigs, places) -> None:
    """Even if at power-on an axis listens to the set-points of its neighbour, or of another node."""
    eavesdrop = {(Object.RPDO + objects.PDOS_OF_AXIS, 1): objects.RPDO1 + places[0][0]}
    rig = rigs(places, values=eavesdrop if places == TWO_BY_TWO else {})
    drives = configured(rig)
    enable(drives)
    for number, drive in enumerate(drives.all, start=1):
        drive.target = 100 * number
        for _ in range(2):  # the second status is behind the SYNC that brought the set-point
            assert drives.exchange(0.5)
        assert [axis.target for axis in rig.simulated.drives] == [other.target for other in drives.all]
    time.sleep(0.05)
    drives.exchange(0.5)
    assert [drive.reading.position for drive in drives.all if drive.reading] == [100, 200, 300, 400]
    assert drives.quick_stop() == []
    assert drives.exchange(0.5)
    assert {drive.state for drive in rig.simulated.drives} == {DriveState.QUICK_STOP_ACTIVE}


def test_every_axis_gets_its_own_limits_and_mapping(rigs) -> None:
    rig = rigs(UNEVEN)
    drives = configured(rig)
    node = rig.simulated.nodes[5]
    for drive in drives.all[:3]:
        shift = 0x800 * (drive.motor.axis - 1)
        ends = sorted(drive.motor.counts(length, 0) for length in drive.motor.length_limit_m)
        assert [node.value(Object.POSITION_LIMIT + shift, k) for k in (1, 2)] == ends
        assert node.value(Object.QUICK_STOP_OPTION + shift) == 6
        set_point, command, status = (number - 1 for number in drive.process_data())
        assert node.value(Object.RPDO_MAP + set_point, 2) == (Object.TARGET_POSITION + shift) << 16 | 32
        assert node.value(Object.RPDO_MAP + command, 1) == (Object.CONTROLWORD + shift) << 16 | 16
        assert node.value(Object.TPDO_MAP + status, 2) == (Object.POSITION + shift) << 16 | 32
    heard = [node.value(Object.RPDO + number, 1) for number in node._rpdos]
    listening = [cob for cob in heard if not cob & objects.PDO_INVALID]
    assert len(set(listening)) == len(listening) == 6  # two for each motor; the second axis hears nothing


def test_an_emergency_names_the_drives_of_its_node(rigs) -> None:
    """It does not say which axis it means."""
    drives = rigs(TWO_BY_TWO).drives(GUARDS)
    drives.configure(0.01, lambda text: None)
    watch = Watch(drives, SafetyTable())
    for drive in drives.all:
        drive.reading = Reading(0x40, 0, 0, 0.0)
    heard = drives.network.subscribers[objects.EMCY + 2][-1]
    heard(objects.EMCY + 2, bytearray(objects.EMERGENCY.pack(0x2310, 1, b"")), 0.0)
    with pytest.raises(Stop, match="drive 'down' or 'right' reports 0x2310"):
        watch.check(Tick(1, 0.0, 0.0, 0), None)


def test_a_drive_without_the_axis_is_refused(rigs, tmp_path: Path) -> None:
    rig = rigs(TWO_BY_TWO)
    sheet = tmp_path / "one_axis.eds"
    sheet.write_text(objects.SIMULATED_EDS.read_text())
    drives = drives_of(rig.network, rig.robot.motors, [0.0] * 4, str(sheet), 1.0)
    drives[0].check(Identity())
    with pytest.raises(InputError, match=r"'left' \(node 1, axis 2\), object 0x6840.*the data sheet lacks it"):
        drives[1].check(Identity())


def test_an_axis_of_another_profile_is_refused(rigs) -> None:
    """Inputs and outputs (CiA 401) in the place of the second axis."""
    drives = rigs(TWO_BY_TWO, values={(of_axis(Object.PROFILE, 2), 0): 401}).drives(GUARDS)
    drives.all[0].check(Identity())
    with pytest.raises(InputError, match="is not a CiA 402 drive"):
        drives.all[1].check(Identity())


def test_process_data_that_are_numbered_in_turn_are_found(rigs, tmp_path: Path) -> None:
    """Some makers number the process data of all axes in turn: 3 and 4 are the second axis's."""
    sheet = configparser.RawConfigParser()
    sheet.optionxform = str  # type: ignore[assignment, method-assign]
    sheet.read(objects.SIMULATED_EDS)
    for section in list(sheet.sections()):
        if section[:4] in ("1400", "1401", "1600", "1601", "1800", "1A00"):
            further = 1 if section[:2] in ("18", "1A") else 2
            sheet[f"{int(section[:4], 16) + further:04X}{section[4:]}"] = dict(sheet[section])
    path = tmp_path / "in_turn.eds"
    with path.open("w") as file:
        sheet.write(file, space_around_delimiters=False)
    rig = rigs(TWO_BY_TWO)
    found = [drive.process_data() for drive in drives_of(rig.network, rig.robot.motors, [0.0] * 4, str(path))]
    assert found == [(1, 2, 1), (3, 4, 2)] * 2


def test_two_motors_on_one_axis_are_refused() -> None:
    with pytest.raises(ValueError, match="share a node and an axis: up and down are on axis 2 of node 3"):
        on(((3, 2), (3, 1), (3, 2), (4, 1)))
