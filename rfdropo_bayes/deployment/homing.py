"""Homing by tension: each cable is pulled slowly until it carries its homing tension, which defines length zero."""

from __future__ import annotations

import datetime
import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import AwareDatetime, BaseModel, ConfigDict

from rfdropo_bayes.deployment.causes import Cause, Stop
from rfdropo_bayes.deployment.loop import ControlLoop, Phase
from rfdropo_bayes.deployment.settings import HomingTable
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Motor, Robot
from rfdropo_bayes.tables import parse_table

_SLACK = 0.7  # of the homing tension: a cable is let out to here before it is pulled, so that all approach from below
_MEDIAN = 5  # cycles: a torque is noisy, and one reading must not decide


VALID_H = 24.0  # age above which a result is refused
TORQUE_FACTOR = 2.0  # the torque limit as a multiple of the homing tension


class Home(BaseModel):
    """Result of homing one channel.

    Attributes:
        channel: channel of the robot.
        offset_counts: counts at length zero.
        tension_n: tension at length zero [N].
        travel_m: distance from the start of the search to length zero [m].
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    channel: str
    offset_counts: int
    tension_n: float
    travel_m: float


class HomingResult(BaseModel):
    """The result of a homing: robot, date (ISO 8601, UTC), and each channel's zero."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    robot: str
    date: AwareDatetime
    homes: tuple[Home, ...]

    def save(self, path: Path) -> None:
        """Write it as JSON.

        Raises:
            InputError: the file cannot be written.
        """
        try:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            Path(path).write_text(self.model_dump_json(indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot be written ({error})", where=str(path), remedy="correct [homing] file") from None


class Homing:
    """The phases of a homing, for `ControlLoop.run`; lengths count from each drive's start position.

    Args:
        table: caps and rate.
    """

    def __init__(self, table: HomingTable) -> None:
        self._table = table
        self.homes: tuple[Home, ...] = ()

    def __call__(self, loop: ControlLoop) -> None:
        """Home every cable, one after the other, as often as the table asks.

        Raises:
            Stop: if a cable does not reach its tension within the caps on travel and time.
        """
        loop.enable()
        homes: dict[int, Home] = {}
        for _ in range(self._table.rounds):
            for index, motor in enumerate(loop.motors):
                self._search(loop, index, _SLACK * motor.homing_tension_n, below=True)
                homes[index] = self._search(loop, index, motor.homing_tension_n, below=False)
        self.homes = tuple(homes[index] for index in sorted(homes))

    def _search(self, loop: ControlLoop, index: int, tension: float, below: bool) -> Home:
        """Let a cable out until it is below a tension, or pull it until it is above."""
        motor, drive, name = loop.motors[index], loop.drives.all[index], loop.drives.all[index].name
        longest = 2.0 * self._table.travel_m / self._table.rate_m_s
        end = time.monotonic() + longest
        recent: list[float] = []
        step = self._table.rate_m_s * loop.period * (-1.0 if below else 1.0)
        goal = loop.set_points.length.copy()
        while True:
            recent = [*recent, drive.tension][-_MEDIAN:]
            carried = float(np.median(recent))
            if len(recent) == _MEDIAN and (carried < tension if below else carried >= tension):
                break
            if below and goal[index] <= motor.length_limit_m[0] + 1e-9:
                break  # slack enough: it may hang loose further than the cap lets it out
            if time.monotonic() > end:
                raise Stop(Cause.HOMING_FAILED, f"{name} carries {carried:.2f} N after {longest:g} s")
            goal[index] += step
            if goal[index] > motor.length_limit_m[1]:
                way = 1e3 * self._table.travel_m
                asked = "is its cable off, or has it the opposite sign in the robot file?"
                raise Stop(Cause.HOMING_FAILED, f"{name} carries {carried:.2f} N after {way:.0f} mm: {asked}")
            loop.set_points.towards(loop.set_points.clamp(goal))
            loop.command = loop.set_points.length.copy()
            loop.cycle(Phase.HOMING, acted=True)
        assert drive.reading is not None
        position = drive.reading.position
        return Home(channel=motor.channel, offset_counts=position, tension_n=carried, travel_m=drive.length)


def load_homing(path: Path, robot: Robot) -> HomingResult:
    """Read the result of a homing.

    Raises:
        InputError: if the file is missing, too old, or of another robot or other channels.
    """
    where, again = f"homing {path}", "run `rfdropo deploy --mode home`"
    try:
        table = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError) as error:
        raise InputError(f"cannot be read ({error})", where=where, remedy=again) from None
    result = parse_table(HomingResult, table, where=where)
    if result.robot != robot.name or tuple(home.channel for home in result.homes) != robot.channel_names:
        raise InputError(f"belongs to robot {result.robot!r}, whose name or channels differ", where=where, remedy=again)
    age = datetime.datetime.now(datetime.UTC) - result.date
    if age > datetime.timedelta(hours=VALID_H):
        raise InputError(
            f"is {age.total_seconds() / 3600:.1f} h old; the limit is {VALID_H:g} h", where=where, remedy=again
        )
    return result


def homing_motors(motors: Sequence[Motor], table: HomingTable) -> list[Motor]:
    """The motors with the limits of a homing: travel instead of length, and a torque that the drive itself caps."""
    caps = {"length_limit_m": (-table.travel_m, table.travel_m)}
    return [
        motor.model_copy(
            update=caps | {"tension_limit_n": (0.0, TORQUE_FACTOR * motor.homing_tension_n), "offset_counts": 0}
        )
        for motor in motors
    ]


def homing_result(robot: Robot, homing: Homing) -> HomingResult:
    """The result with today's date."""
    return HomingResult(robot=robot.name, date=datetime.datetime.now(datetime.UTC), homes=homing.homes)
