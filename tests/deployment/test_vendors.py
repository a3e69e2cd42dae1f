"""Drives of other vendors: units stated, told or taken for another motor's; guards that they lack."""

from __future__ import annotations

import configparser
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bench.simulated_bus import SimulationTable, simulated_drives
from rfdropo_bayes.deployment.bus import open_bus
from rfdropo_bayes.deployment.causes import Cause
from rfdropo_bayes.deployment.drives import Drives, Guards, Identity, drives_of
from rfdropo_bayes.deployment.objects import Object
from rfdropo_bayes.deployment.sensors import SimulatedMarkers
from rfdropo_bayes.deployment.session import deploy
from rfdropo_bayes.deployment.settings import Deployment, DrivesTable, HomingTable, SafetyTable, load_deployment
from rfdropo_bayes.deployment.vendors import STANDARD, WITHOUT, Units, reported_counts
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Motor, Robot

from .conftest import Rig

RPM_PER_S = 0x00C00300  # object 0x60AA of maxon's EPOS4
EPOS4_VELOCITY = 0x00B44700  # its 0x60A9: rpm
MRPM = 0xFDB44700
TORQUE = 12_000  # [uN m]: of the motors of motor_arm
# A loaded machine without real-time scheduling is no robot: these tests ask what happens, not how punctually.
PATIENT = SafetyTable(misses=50, stale_cycles=30, heartbeat_s=1.0, following_error_m=0.02)
Write = Callable[..., str]


@pytest.fixture
def sheet(tmp_path: Path) -> Write:
    """Writes the simulated drive's data sheet, less some objects, with others of 32 bits, and other entries."""

    def write(
        without: tuple[int, ...] = (),
        more: dict[int, int] | None = None,
        entries: dict[str, dict[str, str]] | None = None,
    ) -> str:
        parser = configparser.RawConfigParser()
        parser.optionxform = str  # type: ignore[assignment,method-assign]
        parser.read(objects.SIMULATED_EDS)
        names = {f"{index:04X}" for index in without}
        for section in parser.sections():
            if section[:4] in names and (len(section) == 4 or section[4:7] == "sub"):
                parser.remove_section(section)
            elif section in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
                for key, value in parser.items(section):
                    if key.isdigit() and f"{int(value, 16):04X}" in names:
                        parser.remove_option(section, key)
        for index, value in (more or {}).items():
            parser[f"{index:04X}"] = {
                "ParameterName": "added", "ObjectType": "0x7", "DataType": "0x0007", "AccessType": "rw",
                "DefaultValue": str(value), "PDOMapping": "0",
            }  # fmt: skip
        for section, values in (entries or {}).items():
            if not parser.has_section(section):
                parser.add_section(section)
            for key, text in values.items():
                parser.set(section, key, text)
        path = tmp_path / "vendor.eds"
        with path.open("w") as file:
            parser.write(file, space_around_delimiters=False)
        return str(path)

    return write


@pytest.fixture
def rigs(hub: str) -> Iterator[Callable[..., Rig]]:
    """Makes simulated drives; they are closed at the end."""
    made: list[Rig] = []

    def make(**table: object) -> Rig:
        made.append(Rig(hub, Robot.load("motor_arm"), **table))
        return made[-1]

    yield make
    for rig in made:
        rig.close()


def masters(rig: Rig, eds: str, units: Units = STANDARD, unguarded: tuple[int, ...] = ()) -> Drives:
    """The master's side."""
    offsets = [motor.offset_counts for motor in rig.robot.motors]
    made = drives_of(rig.network, rig.robot.motors, offsets, eds, 1.0, units, unguarded)
    return Drives(rig.network, made, Guards(master_timeout_s=5.0))


# Units


def test_a_rated_torque_in_micronewton_metres_is_named_and_the_unit_makes_it_right(rigs, sheet: Write) -> None:
    eds = sheet()
    rig = rigs(eds=eds, values={(0x6076, 0): TORQUE})
    with pytest.raises(InputError, match=r'1,000 times too large.*another unit.*torque_unit = "uN m"'):
        masters(rig, eds).all[0].check(Identity())
    drives = masters(rig, eds, Units(torque="uN m"))
    assert drives.all[0].check(Identity())["rated_torque"] == TORQUE
    drives.configure(0.01, lambda text: None)
    for drive, simulated in zip(drives.all, rig.simulated.drives, strict=True):
        assert drive.motor.tension_limit_n[1] == 25.0
        # 1.2 times 25 N at a drum of 9.3 mm behind a gear of 24, in per mille of 12 mN m
        assert simulated.value(Object.MAX_TORQUE) == round(1.2 * 25.0 * 0.0093 / 24.0 / 0.012 * 1e3)
    assert drives.exchange(1.0)
    for drive in drives.all:
        assert drive.tension == pytest.approx(2.0, abs=0.04)  # SpringCables at length zero


@pytest.mark.parametrize(
    ("found", "unit", "message"),
    [
        (12_000, "mN m", '1,000 times too large.*state .drives. torque_unit = "uN m"'),
        (12, "uN m", '1,000 times too small.*state .drives. torque_unit = "mN m"'),
        (12_000_000, "mN m", "1,000,000 times too large.*write rated_torque_n_m in N m"),
        (12_000_000, "uN m", "1,000 times too large.*write rated_torque_n_m in N m"),
        (500, "mN m", "this is another motor"),
        (15_000, "mN m", "this is another motor"),
        (0, "uN m", "set the motor of the drive"),
    ],
)
def test_a_wrong_rated_torque_is_another_unit_or_another_motor(rigs, found: int, unit: str, message: str) -> None:
    rig = rigs(values={(0x6076, 0): found})
    with pytest.raises(InputError, match=message) as raised:
        masters(rig, str(objects.SIMULATED_EDS), Units(torque=unit)).all[0].check(Identity())
    assert ("another unit, not another motor" in str(raised.value)) == ("times too" in message)
    assert "0x6076" in str(raised.value)


def test_a_robot_file_with_a_torque_in_millinewton_metres_is_refused() -> None:
    """The torque limit would be next to nothing, and every tension a thousand times too large."""
    motor = Robot.load("motor_arm").motors[0]
    with pytest.raises(ValueError, match=r"0.81 per mille of the rated torque: write rated_torque_n_m in N m"):
        Motor.model_validate(motor.model_dump() | {"rated_torque_n_m": 12.0})


@pytest.mark.parametrize(
    ("told", "stated", "turns"),
    [
        ({}, None, None),
        ({0x60AA: 0}, None, None),
        ({0x60AA: 0x00B55700}, None, None),
        ({0x60AA: RPM_PER_S}, None, 1 / 60),
        ({0x60AA: RPM_PER_S, 0x60A9: EPOS4_VELOCITY}, "rpm/s", 1 / 60),
        ({}, "rpm/s", 1 / 60),
        ({0x60AA: 0xFDC00300}, None, 1e-3 / 60),
        ({0x60AA: 0xFAB45700}, None, 1e-6),
    ],
)
def test_a_quick_stop_brakes_as_the_motor_may_in_the_drives_own_unit(
    rigs, sheet: Write, told: dict, stated: str | None, turns: float | None
) -> None:
    """Turns per second squared in one of the unit; none for counts."""
    eds = sheet(more=told)
    rig = rigs(eds=eds)
    masters(rig, eds, Units(acceleration=stated)).configure(0.01, lambda text: None)
    for motor, simulated in zip(rig.robot.motors, rig.simulated.drives, strict=True):
        braking = motor.acceleration_limit_m_s2 / (2 * math.pi * motor.drum_radius_m) * motor.gear  # [turns/s2]
        unit = 1.0 / motor.counts_per_turn if turns is None else turns
        assert simulated.value(Object.QUICK_STOP_DECELERATION) == pytest.approx(braking / unit, abs=0.51)


@pytest.mark.parametrize(("unit", "turns"), [(None, 1 / 60), ("rpm", 1 / 60), ("mrpm", 1e-3 / 60), ("counts/s", None)])
def test_the_greatest_speed_is_written_in_the_stated_unit(rigs, unit: str | None, turns: float | None) -> None:
    rig = rigs()
    drive = masters(rig, str(objects.SIMULATED_EDS), Units(speed=unit)).all[0]
    written = {(i, s): value for i, s, value in drive._settings(0.01, Guards())}[Object.MAX_MOTOR_SPEED, 0]
    motor = drive.motor
    fastest = 1.5 * motor.rate_limit_m_s / (2 * math.pi * motor.drum_radius_m) * motor.gear  # [turns/s]
    assert written == pytest.approx(fastest / (1.0 / motor.counts_per_turn if turns is None else turns), abs=0.51)


@pytest.mark.parametrize(
    ("told", "units", "message"),
    [
        ({0x60AA: RPM_PER_S}, Units(acceleration="counts/s2"), "0x60AA is 0x00C00300. than counts/s2"),
        ({0x60AA: 0x00414300}, Units(), "unknown unit of accelerations .0x60AA is 0x00414300"),
        ({0x60A9: MRPM}, Units(), "not in rpm .0x60A9 is 0xFDB44700.*speed_unit"),
    ],
)
def test_units_that_are_not_certain_are_refused(rigs, sheet: Write, told: dict, units: Units, message: str) -> None:
    eds = sheet(more=told)
    with pytest.raises(InputError, match=message):
        masters(rigs(eds=eds), eds, units).all[0].check(Identity())


def test_told_units() -> None:
    assert reported_counts(RPM_PER_S, 3200.0) == pytest.approx(3200 / 60)
    assert reported_counts(MRPM, 3200.0) == pytest.approx(3.2 / 60)
    assert reported_counts(0x00B50300, 3200.0) == 1.0
    assert reported_counts(0x00010300, 3200.0) is None  # metres per second


def test_a_value_that_a_drive_cannot_hold_is_refused(rigs) -> None:
    rig = rigs()
    drive = masters(rig, str(objects.SIMULATED_EDS)).all[0]
    with pytest.raises(InputError, match="70000 does not fit into 16 bits"):
        drive.write(Object.MAX_TORQUE, 70_000)


# Positions


def test_a_drive_that_reverses_positions_is_refused(rigs, sheet: Write) -> None:
    """A drive that reverses its targets alone would set out for the other side of zero as soon as it is enabled."""
    eds = sheet(more={0x607E: 0x80})
    with pytest.raises(InputError, match=r"0x607E is 0x80.*the other sign in the robot file"):
        masters(rigs(eds=eds), eds).all[0].check(Identity())


def test_the_polarity_of_speeds_is_no_concern_of_ours(rigs, sheet: Write) -> None:
    eds = sheet(more={0x607E: 0x40})
    masters(rigs(eds=eds), eds).all[0].check(Identity())


def test_a_home_offset_that_shifts_the_ends_of_the_travel_is_refused_unless_they_are_given_up(rigs, sheet) -> None:
    eds = sheet(more={0x607C: 5000})
    rig = rigs(eds=eds)
    with pytest.raises(InputError, match=r"0x607C is 5000.*unguarded = \[0x607D\]"):
        masters(rig, eds).all[0].check(Identity())
    masters(rig, eds, unguarded=(0x607D,)).all[0].check(Identity())


def wrapping(sheet: Write, low: int, high: int) -> str:
    """A data sheet of a drive that wraps its position between two ends."""
    plain = {"DataType": "0x0004", "AccessType": "rw", "ObjectType": "0x7", "PDOMapping": "0"}
    return sheet(
        entries={
            "607B": {"ParameterName": "range", "ObjectType": "0x8", "SubNumber": "3"},
            "607Bsub0": plain | {"ParameterName": "n", "DataType": "0x0005", "AccessType": "ro", "DefaultValue": "2"},
            "607Bsub1": plain | {"ParameterName": "low", "DefaultValue": str(low)},
            "607Bsub2": plain | {"ParameterName": "high", "DefaultValue": str(high)},
        }
    )


@pytest.mark.parametrize(
    ("low", "high", "refused"), [(0, 4095, True), (0, 0, False), (-(2**31), 2**31 - 1, False), (-(10**6), 10**6, False)]
)
def test_a_travel_in_which_the_drive_wraps_its_position_is_refused(rigs, sheet: Write, low, high, refused) -> None:
    eds = wrapping(sheet, low, high)
    drives = masters(rigs(eds=eds), eds)
    if not refused:
        return drives.configure(0.01, lambda text: None)
    with pytest.raises(InputError, match=r"0x607B at 0 and 4095; set both ends of 0x607B to 0"):
        drives.configure(0.01, lambda text: None)


def test_a_counter_that_would_overflow_in_the_travel_is_refused_with_what_to_do(rigs) -> None:
    """An absolute encoder stands anywhere: the motor's limits and units may well be right."""
    drives = masters(rigs(), str(objects.SIMULATED_EDS))
    drives.all[0].offset = 2.0**31 - 100.0
    with pytest.raises(InputError, match=r"32-bit positions end at .*; set its present position to zero .* then home"):
        drives.configure(0.01, lambda text: None)


# Guards


@pytest.mark.parametrize("index", sorted(WITHOUT))
def test_a_drive_without_a_guard_is_refused_unless_it_is_named(rigs, sheet: Write, index: int) -> None:
    eds = sheet(without=(index,))
    rig = rigs() if index == Object.RATED_TORQUE else rigs(eds=eds)
    with pytest.raises(InputError, match=rf"lacks 0x{index:04X}: .*unguarded = \[0x{index:04X}\]") as raised:
        masters(rig, eds).all[0].check(Identity())
    assert WITHOUT[index] in str(raised.value)
    with pytest.raises(InputError, match=f"lacks 0x{index:04X}"):
        masters(rig, eds).configure(0.01, lambda text: None)  # not without a check either
    drives = masters(rig, eds, unguarded=(index,))
    notes: list[str] = []
    drives.all[0].check(Identity())
    drives.configure(0.01, notes.append)
    assert sum(f"is without 0x{index:04X}: {WITHOUT[index]}" in note for note in notes) == len(drives.all)


def test_all_missing_guards_are_named_at_once(rigs, sheet: Write) -> None:
    eds = sheet(without=(0x1016, 0x6007, 0x6072))
    with pytest.raises(InputError, match=r"0x1016: .*; 0x6007: .*; 0x6072: .*\[0x1016, 0x6007, 0x6072\]"):
        masters(rigs(eds=eds), eds).all[0].check(Identity())


def test_a_guard_that_nobody_may_write_is_none(rigs, sheet: Write) -> None:
    eds = sheet(entries={"6007": {"AccessType": "ro"}})
    with pytest.raises(InputError, match="lacks 0x6007"):
        masters(rigs(eds=eds), eds).all[0].check(Identity())


def test_a_drive_without_heartbeats_of_its_own_cannot_be_used(rigs, sheet: Write) -> None:
    eds = sheet(without=(0x1017,))
    with pytest.raises(InputError, match="lacks 0x1017: the computer does not notice"):
        masters(rigs(eds=eds), eds).all[0].check(Identity())
    with pytest.raises(ValueError, match="0x1017 is not an optional guard of a drive"):
        DrivesTable(unguarded=(0x1017,))


def test_an_identity_that_cannot_be_asked_is_refused(rigs, sheet: Write) -> None:
    eds = sheet()
    Path(eds).write_text(Path(eds).read_text().replace("[1018sub4]", "[1018sub9]"))
    drive = masters(rigs(), eds).all[0]
    drive.check(Identity())
    with pytest.raises(InputError, match="its serial cannot be asked"):
        drive.check(Identity(serial=5))


def test_a_drive_that_takes_less_gets_the_strictest_that_it_takes(rigs, sheet: Write) -> None:
    """EPOS4 faults at once where it lags too far: its 0x6066 takes 0 alone."""
    eds = sheet(entries={"6066": {"LowLimit": "0", "HighLimit": "0", "DefaultValue": "0"}})
    rig, notes = rigs(eds=eds), []
    masters(rig, eds).configure(0.01, notes.append)
    assert rig.simulated.drives[0].value(Object.FOLLOWING_TIMEOUT) == 0
    assert "takes no more than 0 for 0x6066, where 50 was meant" in notes[0]


# A whole session: an EPOS4 in what matters here


def epos4(sheet: Write) -> str:
    """A data sheet with what sets an EPOS4 apart."""
    info = {"VendorNumber": "0xFB", "ProductNumber": "0x61500000"}
    return sheet(
        without=(0x6072, 0x1006),
        more={0x60A9: EPOS4_VELOCITY, 0x60AA: RPM_PER_S},
        entries={
            "6066": {"LowLimit": "0", "HighLimit": "0", "DefaultValue": "0"},
            "DeviceInfo": info,
            "1018sub1": {"DefaultValue": info["VendorNumber"]},
            "1018sub2": {"DefaultValue": info["ProductNumber"]},
        },
    )


@pytest.mark.slow
def test_the_example_of_the_documentation_drives_an_epos4(sheet: Write, tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "deployment.md").read_text()
    block = page.split("[drives]\n", 1)[1].split("    [policy]", 1)[0]
    eds = epos4(sheet)
    (tmp_path / "drive.eds").write_text(Path(eds).read_text())
    (tmp_path / "arm.toml").write_text('robot = "motor_arm"\n[drives]\n' + block)
    drives = load_deployment(tmp_path / "arm.toml").drives.model_copy(update={"answer_s": 2.0})
    sensor = SimulatedMarkers(len(Robot.load("motor_arm").marker_names))
    hub = Deployment(robot="motor_arm").bus.model_copy(update={"interface": "hub", "channel": "127.0.0.1:0"})
    with simulated_drives(SimulationTable("motor_arm", hub, values={(0x6076, 0): TORQUE}, eds=eds)) as found:
        homing = HomingTable(rate_m_s=0.02, rounds=1)
        settings = Deployment(robot="motor_arm", bus=found, drives=drives, safety=PATIENT, homing=homing)
        outcome = deploy(settings, "check", tmp_path / "check", sensor=sensor, bus=open_bus(found))
        assert outcome.cause is Cause.FINISHED
        assert outcome.without["up"] == [f"0x6072: {WITHOUT[0x6072]}"]
        assert json.loads((tmp_path / "check" / "summary.json").read_text())["without"] == outcome.without
        outcome = deploy(settings, "home", tmp_path / "home", sensor=sensor, bus=open_bus(found))
        assert outcome.cause is Cause.FINISHED, outcome.detail
        journal = (tmp_path / "home" / "log.jsonl").read_text()
        assert f"drive 'up' (node 1) is without 0x6072: {WITHOUT[0x6072]}" in journal
        assert "takes no more than 0 for 0x6066" in journal
        careless = settings.model_copy(update={"drives": drives.model_copy(update={"unguarded": ()})})
        with pytest.raises(InputError, match="lacks 0x6072"):
            deploy(careless, "check", tmp_path / "careless", sensor=sensor, bus=open_bus(found))
