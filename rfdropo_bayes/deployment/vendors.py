"""Differences between vendors of CiA 402 drives: units of objects, and missing guards."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Literal, NamedTuple

from rfdropo_bayes.deployment.objects import Object
from rfdropo_bayes.errors import InputError

TorqueUnit = Literal["mN m", "uN m"]
SpeedUnit = Literal["rpm", "mrpm", "counts/s"]
AccelerationUnit = Literal["counts/s2", "rpm/s", "mrpm/s"]

_TORQUE: dict[TorqueUnit, float] = {"mN m": 1e-3, "uN m": 1e-6}  # [N m]
_TURNS = {"rpm": 1.0 / 60.0, "mrpm": 1e-3 / 60.0, "rpm/s": 1.0 / 60.0, "mrpm/s": 1e-3 / 60.0}  # [1/s], [1/s2]
_COUNTS = ("counts/s", "counts/s2")


class Units(NamedTuple):
    """Units of a drive's objects, as its owner states them; None leaves them to the drive, then to the standard."""

    torque: TorqueUnit = "mN m"  # unit of 0x6076, the rated torque
    speed: SpeedUnit | None = None  # unit of 0x6080, the greatest speed; rpm by the standard
    # unit of 0x6085, the deceleration of a quick stop; from 0x60AA by default, else counts/s2
    acceleration: AccelerationUnit | None = None


STANDARD = Units()


def counts_of(unit: SpeedUnit | AccelerationUnit, counts_per_turn: float) -> float:
    """Counts (per second, or per second squared) in one of a unit."""
    return 1.0 if unit in _COUNTS else counts_per_turn * _TURNS[unit]


_TOLD_TURNS = {
    (0xB4, 0x03): 1.0,  # revolutions per second
    (0xB4, 0x47): 1.0 / 60.0,  # per minute
    (0xB4, 0x57): 1.0,  # per second squared
    (0xC0, 0x03): 1.0 / 60.0,  # rpm per second
}
_TOLD_COUNTS = {(0xB5, 0x03), (0xB5, 0x57)}


def reported_counts(word: int, counts_per_turn: float) -> float | None:
    """Counts in one unit of an object 0x60A9 or 0x60AA; None for an unknown unit.

    The word is, from its highest byte: a power of ten, numerator, denominator, 0 (CiA 402-2; codes of CiA 303-2, as
    real data sheets have them: 0xB4 revolutions, 0xB5 counts, 0xC0 rpm, 0x03 s, 0x47 min, 0x57 s2).
    """
    power, unit = (word >> 24 ^ 0x80) - 0x80, (word >> 16 & 0xFF, word >> 8 & 0xFF)
    if unit in _TOLD_COUNTS:
        return 10.0**power
    return 10.0**power * counts_per_turn * _TOLD_TURNS[unit] if unit in _TOLD_TURNS else None


def speed_counts(stated: SpeedUnit | None, word: int, counts_per_turn: float, where: str) -> float:
    """Counts per second in one unit of 0x6080.

    Args:
        stated: unit stated by the owner of the drive.
        word: content of 0x60A9; 0 if empty.
        counts_per_turn: encoder counts per turn of the motor.
        where: location for messages.

    Raises:
        InputError: if nothing is stated and the drive's velocities are not in rpm: the standard has 0x6080 in rpm all
            the same, some drives have not.
    """
    rpm = counts_of("rpm", counts_per_turn)
    if stated is not None:
        return counts_of(stated, counts_per_turn)
    reported = reported_counts(word, counts_per_turn) if word else rpm
    if reported is None or not math.isclose(reported, rpm):
        raise InputError(
            f"its velocities are not in rpm (0x60A9 is 0x{word:08X}), and its greatest speed 0x6080 need not be",
            where=where,
            remedy='look into its manual, and state [drives] speed_unit, "rpm", "mrpm" or "counts/s"',
        )
    return rpm


def acceleration_counts(stated: AccelerationUnit | None, word: int, counts_per_turn: float, where: str) -> float:
    """Counts per second squared in one unit of 0x6085.

    Args:
        stated: unit stated by the owner of the drive.
        word: content of 0x60AA; 0 if empty.
        counts_per_turn: encoder counts per turn of the motor.
        where: location for messages.

    Raises:
        InputError: if the drive has another unit than the stated unit, or an unknown unit without a stated unit.
    """
    reported = reported_counts(word, counts_per_turn) if word else None
    if stated is None and not word:
        return counts_of("counts/s2", counts_per_turn)
    if stated is None:
        if reported is None:
            raise InputError(
                f"has an unknown unit of accelerations (0x60AA is 0x{word:08X})",
                where=where,
                remedy='look into its manual, and state [drives] acceleration_unit, "counts/s2" or "rpm/s"',
            )
        return reported
    counts = counts_of(stated, counts_per_turn)
    if reported is not None and not math.isclose(reported, counts):
        raise InputError(
            f"has another unit of accelerations (0x60AA is 0x{word:08X}) than {stated}",
            where=where,
            remedy="leave [drives] acceleration_unit out, or correct it",
        )
    return counts


def check_rated_torque(reported: int, torque_n_m: float, unit: TorqueUnit, where: str) -> None:
    """Compare a drive's rated torque with the rated torque of the robot file; a wrong unit is distinguished from a
    wrong motor.

    Args:
        reported: content of 0x6076.
        torque_n_m: rated torque in the robot file [N m].
        unit: unit of ``reported``.
        where: location for messages.

    Raises:
        InputError: the values differ by more than two per cent; the message names the unit in which they agree.
    """
    expected = torque_n_m / _TORQUE[unit]
    if _agree(reported, expected):
        return
    what = f"its rated torque is {reported} {unit}, but {expected:.9g} {unit} in the robot file"
    if reported == 0:
        raise InputError(what, where=where, remedy="set the motor of the drive with the vendor's own program")
    power = 3 * round(math.log10(reported / expected) / 3.0)
    if power == 0 or not _agree(reported, expected * 10.0**power):
        raise InputError(
            what,
            where=where,
            remedy="this is another motor, or rated_torque_n_m is wrong: tensions are computed from it",
        )
    times = f"{10 ** abs(power):,} times {'too large' if power > 0 else 'too small'}"
    fitting = [name for name, size in _TORQUE.items() if _agree(reported, torque_n_m / size)]
    remedy = (
        f'state [drives] torque_unit = "{fitting[0]}" if rated_torque_n_m = {torque_n_m:.9g} N m is right for the motor'
        if fitting
        else f"write rated_torque_n_m in N m (it is {torque_n_m:.9g}), and the drive's unit in [drives] torque_unit"
    )
    raise InputError(f"{what}: {times}, which is another unit, not another motor", where=where, remedy=remedy)


def _agree(value: float, expected: float) -> bool:
    return abs(value - expected) <= 0.02 * expected + 1.0  # drives round to whole units


POSITION_REVERSED = 1 << 7  # bit of object 0x607E
COUNTER = -(2**31), 2**31 - 1  # least and greatest position of 32 bits


def check_polarity(word: int, where: str) -> None:
    """Refuse a drive that reverses positions: some drives reverse only their targets, and torques may stay as they are.

    Args:
        word: content of 0x607E.
        where: location for messages.

    Raises:
        InputError: if the position bit is set.
    """
    if word & POSITION_REVERSED:
        raise InputError(
            f"reverses positions (0x607E is 0x{word:02X}), and may not reverse measured positions and "
            "torques with them",
            where=where,
            remedy="set 0x607E to 0 with the vendor's own program, and the other sign in the robot file's [[motors]]",
        )


def check_home_offset(offset: int, unguarded: Collection[int], where: str) -> None:
    """Refuse a drive that shifts its travel limits, unless its owner accepts that.

    Args:
        offset: content of 0x607C [counts].
        unguarded: objects that the owner has accepted as missing.
        where: location for messages.

    Raises:
        InputError: the drive has an offset, which the standard subtracts from the limits of 0x607D.
    """
    if offset and Object.POSITION_LIMIT not in unguarded:
        raise InputError(
            f"has a home offset (0x607C is {offset}), by which it shifts the ends of the travel that it is given",
            where=where,
            remedy="set 0x607C to 0 with the vendor's own program, or state [drives] unguarded = [0x607D] if something "
            "else guards the ends",
        )


def check_travel(ends: Sequence[int], wrap: tuple[int, int], where: str) -> None:
    """Refuse a travel [counts] in which the drive's position would wrap.

    Args:
        ends: least and greatest position.
        wrap: content of 0x607B; 0, 0 if empty.
        where: location for messages.

    Raises:
        InputError: if an end is beyond the counter, or beyond the position at which the drive wraps it.
    """
    low, high = COUNTER if wrap[0] >= wrap[1] else wrap
    if ends[0] <= low or ends[1] >= high:
        whose = "32-bit positions end" if (low, high) == COUNTER else "it wraps positions by its object 0x607B"
        raise InputError(
            f"its travel goes from {ends[0]} to {ends[1]} counts, and {whose} at {low} and {high}",
            where=where,
            remedy="set its present position to zero (homing method 37, or the vendor's own program), then home"
            if (low, high) == COUNTER
            else "set both ends of 0x607B to 0 with the vendor's own program",
        )


WITHOUT: dict[int, str] = {
    Object.CONSUMER_HEARTBEAT: "it does not notice that the computer has died",
    Object.ABORT_CONNECTION: "it does not stop after the computer has died",
    Object.QUICK_STOP_OPTION: "its quick stop may release the cables",
    Object.QUICK_STOP_DECELERATION: "its quick stop brakes at an unknown rate",
    Object.POSITION_LIMIT: "it follows set-points beyond the ends of the travel",
    Object.FOLLOWING_WINDOW: "it does not notice that it lags behind its set-points",
    Object.FOLLOWING_TIMEOUT: "it tolerates a lag behind its set-points for an unknown time",
    Object.MAX_TORQUE: "it does not limit its torque, on which homing relies",
    Object.MAX_MOTOR_SPEED: "it does not limit its speed",
    Object.RATED_TORQUE: "a torque in another unit, or another motor, goes unnoticed",
}
"""Guards that a drive may lack if its owner accepts the stated consequence."""

LEFT_OUT: dict[int, str] = WITHOUT | {
    Object.PRODUCER_HEARTBEAT: "the computer does not notice that it has died",
    Object.INTERPOLATION_TIME: "it does not know how far apart set-points are",
    Object.MODE: "its mode cannot be set",
}
"""Consequence of each missing object that is set or read."""

STRICTER_BELOW = {Object.FOLLOWING_WINDOW, Object.FOLLOWING_TIMEOUT, Object.MAX_TORQUE, Object.MAX_MOTOR_SPEED}
"""Guards that a smaller value makes stricter: a drive that rejects a large value gets its largest."""


def check_guards(lacking: Collection[int], unguarded: Collection[int], where: str) -> None:
    """Refuse a drive without a guard, unless its owner accepts that.

    Args:
        lacking: objects that cannot be set or read.
        unguarded: objects that the owner has accepted as missing.
        where: location for messages.

    Raises:
        InputError: guards are missing; the message lists each with its consequence.
    """
    if Object.PRODUCER_HEARTBEAT in lacking:
        raise InputError(
            f"lacks 0x1017: {LEFT_OUT[Object.PRODUCER_HEARTBEAT]}", where=where, remedy="use a drive that has it"
        )
    missed = sorted(index for index in WITHOUT if index in lacking and index not in unguarded)
    if missed:
        listed = "; ".join(f"0x{index:04X}: {WITHOUT[index]}" for index in missed)
        named = ", ".join(f"0x{index:04X}" for index in sorted({*missed, *unguarded}))
        raise InputError(
            f"lacks {listed}",
            where=where,
            remedy=f"use a drive that has it, or state [drives] unguarded = [{named}] if something else guards",
        )
