"""The deployment file: bus, drives, policy, sensor, safety, homing of one robot, as validated tables."""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from rfdropo_bayes.deployment.bus import BusTable
from rfdropo_bayes.deployment.drives import Guards, Identity
from rfdropo_bayes.deployment.objects import SIMULATED_EDS
from rfdropo_bayes.deployment.sensors import SensorTable
from rfdropo_bayes.deployment.vendors import WITHOUT, AccelerationUnit, SpeedUnit, TorqueUnit, Units
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.tables import nearest, parse_assignment, parse_table, read_toml, set_entry


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DrivesTable(_Table):
    """Identity and units of the drives, and the guards that they may lack.

    Attributes:
        eds: their electronic data sheet; the simulated drive's sheet by default.
        vendor, product, revision: required values in object 0x1018; unchecked if left out.
        serial: channel -> serial number.
        check_eds: whether vendor and product in the data sheet must equal the drive's own; some makers leave them out
            of step.
        answer_s: a drive has this long to answer an SDO request; more for drives that write to slow memory.
        torque_unit: unit of the rated torque, object 0x6076; "uN m" for maxon's EPOS4.
        speed_unit: unit of the greatest motor speed, object 0x6080; rpm by default, as in the standard.
        acceleration_unit: unit of the quick stop's deceleration, object 0x6085; by default from object 0x60AA, else
            counts/s2.
        unguarded: guards that the drives may lack, by object index; `check` lists missing guards and their
            consequences.
    """

    eds: str = str(SIMULATED_EDS)
    vendor: int | None = None
    product: int | None = None
    revision: int | None = None
    serial: dict[str, int] = {}
    check_eds: bool = True
    answer_s: float = Field(default=0.3, gt=0.0)
    torque_unit: TorqueUnit = "mN m"
    speed_unit: SpeedUnit | None = None
    acceleration_unit: AccelerationUnit | None = None
    unguarded: tuple[int, ...] = ()

    @field_validator("unguarded")
    @classmethod
    def _guards(cls, indexes: tuple[int, ...]) -> tuple[int, ...]:
        for index in indexes:
            if index not in WITHOUT:
                known = ", ".join(f"0x{guard:04X}" for guard in sorted(WITHOUT))
                raise ValueError(f"0x{index:04X} is not an optional guard of a drive; optional guards are {known}")
        return indexes

    @property
    def units(self) -> Units:
        return Units(self.torque_unit, self.speed_unit, self.acceleration_unit)

    def check_serial(self, channels: Sequence[str]) -> None:
        """Raise an InputError that names the first of ``serial`` that is not a channel of the robot."""
        for channel in self.serial:
            if channel not in channels:
                remedy = nearest(channel, channels)
                raise InputError(f"no channel {channel!r}", where="[drives] serial", remedy=remedy)

    def identity(self, channel: str) -> Identity:
        """Identity that the drive of a channel must report."""
        return Identity(self.vendor, self.product, self.revision, self.serial.get(channel))


class PolicyTable(_Table):
    """The table [policy] of a deployment file.

    Attributes:
        file: the ONNX file.
        sha256: required hash of the policy; summary.json has the hash of the policy that ran.
        markers: names of observed markers; all markers of the robot by default.
    """

    file: str
    sha256: str | None = None
    markers: tuple[str, ...] | None = None


class SafetyTable(_Table):
    """Fault tolerances, and the start and end of a session.

    Attributes:
        misses: the session ends after this number of deadlines missed by more than a cycle within a second.
        stale_cycles: largest number of cycles without a drive's status.
        heartbeat_s: drives stop without the master's heartbeat for this time, and the master without a drive's.
        following_error_m, following_time_s: length and time of a lag behind set-points at which a drive reports a
        fault.
        settle_s: rest in the start pose before the policy begins.
        after: "hold" leaves the drives braked and holding; "release" switches them off, which slackens the cables, if
            the session ended as planned.
        button_file: a file that shows a button; it contains 0 while the button is pressed.
    """

    misses: int = Field(default=3, ge=1)
    stale_cycles: int = Field(default=3, ge=1)
    heartbeat_s: float = Field(default=0.06, ge=0.02)
    following_error_m: float = Field(default=0.005, gt=0.0)
    following_time_s: float = Field(default=0.05, gt=0.0)
    settle_s: float = Field(default=1.0, ge=0.0)
    after: Literal["hold", "release"] = "hold"
    button_file: str | None = None

    def guards(self, nodes: Collection[int]) -> Guards:
        """For the drives of these ``nodes``: the master takes the highest free number."""
        return Guards(
            master_node=max(set(range(1, 128)) - set(nodes)),
            master_timeout_s=self.heartbeat_s,
            drive_heartbeat_s=0.25 * self.heartbeat_s,
            following_error_m=self.following_error_m,
            following_time_s=self.following_time_s,
        )


class HomingTable(_Table):
    """Search for length zero.

    Attributes:
        file: file of the result; none if the robot file has the motors' offsets.
        rate_m_s: cable speed of the search.
        travel_m: longest travel of each cable.
        rounds: number of passes over all cables: pulling a cable changes the others.
    """

    file: str | None = None
    rate_m_s: float = Field(default=0.002, gt=0.0)
    travel_m: float = Field(default=0.03, gt=0.0)
    rounds: int = Field(default=2, ge=1)


class SimulationSettings(_Table):
    """Simulation that replaces the hardware with `--mode dry-run`.

    Attributes:
        plant: "springs", or MODULE:CALLABLE.
        settings: settings of the plant, or a .toml file of settings.
        own_process: whether the plant runs in its own process.
    """

    plant: str = "springs"
    settings: dict[str, float | str | int | bool] = {}
    own_process: bool = False


class Deployment(_Table):
    """A deployment file.

    Attributes:
        robot: name or file of a robot with motors.
        rate_hz: rate of the set-point loop.
        duration_s: duration of the policy.
        goal: x, y and z of the policy's goal [m].
        bus, drives, policy, sensor, safety, homing, simulation: see the tables.
    """

    robot: str
    rate_hz: float = Field(default=100.0, ge=10.0, le=200.0)
    duration_s: float = Field(default=10.0, gt=0.0)
    goal: dict[str, float] = {}
    bus: BusTable = BusTable()
    drives: DrivesTable = DrivesTable()
    policy: PolicyTable | None = None
    sensor: SensorTable = SensorTable()
    safety: SafetyTable = SafetyTable()
    homing: HomingTable = HomingTable()
    simulation: SimulationSettings = SimulationSettings()

    @model_validator(mode="after")
    def _consistent(self) -> Deployment:
        period = 1e3 / self.rate_hz
        if abs(period - round(period)) > 1e-6:
            raise ValueError(f"rate_hz = {self.rate_hz:g}: the period is not a whole number of milliseconds")
        if period >= 1e3 * self.safety.heartbeat_s:
            raise ValueError(
                f"rate_hz = {self.rate_hz:g}: the drives hear from the loop every {period:g} ms, and stop after "
                f"{1e3 * self.safety.heartbeat_s:g} ms of silence: raise rate_hz or safety.heartbeat_s"
            )
        return self


def load_deployment(path: Path | str, overrides: Sequence[str] = ()) -> Deployment:
    """Read a deployment file; paths in it are relative to it.

    Args:
        path: the file.
        overrides: assignments such as ``"goal.x=0.02"`` that replace entries of the file.

    Raises:
        InputError: the file cannot be read, or a value is invalid.
    """
    path = Path(path)
    try:
        table = read_toml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"cannot be read ({error})", where=str(path), remedy="give a readable TOML file") from None
    for assignment in overrides:
        set_entry(table, *parse_assignment(assignment))
    settings = parse_table(Deployment, table, where=str(path))
    return settings.model_copy(update=_resolved(settings, path.resolve().parent))


def _resolved(settings: Deployment, base: Path) -> dict[str, object]:
    resolved: dict[str, object] = {}
    if settings.robot.endswith(".toml"):
        resolved["robot"] = str(base / settings.robot)
    if settings.policy is not None:
        resolved["policy"] = settings.policy.model_copy(update={"file": str(base / settings.policy.file)})
    resolved["drives"] = settings.drives.model_copy(update={"eds": str(base / settings.drives.eds)})
    plant = settings.simulation.settings
    files = {key: str(base / str(name)) for key, name in plant.items() if str(name).endswith(".toml")}
    resolved["simulation"] = settings.simulation.model_copy(update={"settings": plant | files})
    if settings.homing.file is not None:
        resolved["homing"] = settings.homing.model_copy(update={"file": str(base / settings.homing.file)})
    return resolved
