"""The power section of a CiA 402 drive in software: states, set-points, motion, following error of one axis.

The communication on the bus belongs to `SimulatedNode`, which may have several axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from rfdropo_bayes.deployment.cia402 import (
    CYCLIC_SYNCHRONOUS_POSITION,
    TRANSITIONS,
    Controlword,
    DriveState,
    Status,
    obey,
)
from rfdropo_bayes.deployment.objects import EmergencyCode, Object, of_axis
from rfdropo_bayes.deployment.vendors import reported_counts

_HELD = 0.05  # [s]: time for which a faulty drive holds after a quick stop
_LAG = 0.004  # [s]: time constant of a tuned position loop of 40 Hz


class Dictionary(Protocol):
    """Access of an axis to the object dictionary of its node."""

    def value(self, index: int, subindex: int = 0) -> int:
        """A setting in the object dictionary."""
        ...

    def emergency(self, code: int, detail: bytes = b"", register: int = 0x01) -> None:
        """Send an emergency message."""
        ...


class SimulatedDrive:
    """One axis.

    Args:
        node: node of the axis.
        axis: its number, from 1.
        position: counts at power-on.
    """

    def __init__(self, node: Dictionary, axis: int, position: float) -> None:
        self._node, self.axis = node, axis
        self.position = float(position)
        self.torque = 0.0  # [per mille], set from outside

    def power_on(self, now: float) -> None:
        """Begin at rest, at the present position."""
        self.state, self.controlword, self.error_code = DriveState.SWITCH_ON_DISABLED, 0, 0
        self.velocity = 0.0
        self.target = self.demand = round(self.position)
        self.jammed = False
        self.after_stop: DriveState | None = None  # state that a faulty drive takes some time after a quick stop
        self._stood_for = 0.0  # [s] in quick stop
        self._error_since: float | None = None
        self._time = now

    def value(self, index: int, subindex: int = 0) -> int:
        """A setting, by its index on a first axis."""
        return self._node.value(of_axis(index, self.axis), subindex)

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

    def control(self, controlword: int) -> None:
        """Obey a controlword."""
        number = obey(self.state, controlword, self.controlword)
        self.controlword = controlword
        if number is None or self._stood_for > _HELD:
            return
        if number == 15:
            self.error_code, self._error_since = 0, None
            self.jammed = False
            self._node.emergency(EmergencyCode.NONE, register=0)
        self.state = TRANSITIONS[number].end
        if self.state is DriveState.QUICK_STOP_ACTIVE and self.value(Object.QUICK_STOP_OPTION) == 0:
            self.state = DriveState.SWITCH_ON_DISABLED  # "disable drive function": the motor coasts

    def fail(self, code: int) -> None:
        """Transitions 13 and 14: this drive reacts at once, since gear and drum are self-locking."""
        self.state, self.velocity = DriveState.FAULT, 0.0
        self.error_code = int(code)
        self._node.emergency(code, register=0x21)

    def connection_lost(self, code: int) -> None:
        """Apply the reaction of object 0x6007: 0 nothing, 1 fault, 2 disable voltage, 3 quick stop."""
        self.error_code = int(code) or self.error_code
        if not self.state.powered:
            return
        option = self.value(Object.ABORT_CONNECTION)
        if option == 1:
            self.fail(code or EmergencyCode.GENERIC)
        elif option == 2:
            self.control(Controlword.DISABLE_VOLTAGE)
        elif option == 3:
            self.control(Controlword.QUICK_STOP)

    # Motion

    def move(self, now: float) -> None:
        """Let time pass."""
        duration, self._time = now - self._time, now
        if duration <= 0.0:
            return
        if self.state is DriveState.OPERATION_ENABLED and self.value(Object.MODE) == CYCLIC_SYNCHRONOUS_POSITION:
            self._follow(duration, now)
        else:
            self._slow_down(duration)
            self._error_since = None
            if self.state is DriveState.QUICK_STOP_ACTIVE and self.after_stop is not None:
                self._stood_for += duration
                if self._stood_for > _HELD:  # and obeys no more
                    self.state = self.after_stop
            if not self.state.powered:
                self.target = self.demand = round(self.position)

    def _follow(self, duration: float, now: float) -> None:
        step = self._step(duration)
        self.position += step
        self.velocity = step / duration
        if abs(self.demand - self.position) > self.value(Object.FOLLOWING_WINDOW):
            self._error_since = now if self._error_since is None else self._error_since
            if now - self._error_since >= 1e-3 * self.value(Object.FOLLOWING_TIMEOUT):
                self.fail(EmergencyCode.FOLLOWING_ERROR)
        else:
            self._error_since = None

    def _step(self, duration: float) -> float:
        """Counts that a following drive covers in this time, towards the target within the drive's limits."""
        low, high = self.value(Object.POSITION_LIMIT, 1), self.value(Object.POSITION_LIMIT, 2)
        self.demand = min(max(self.target, low), high)
        if self.jammed:
            return 0.0
        wanted = (self.demand - self.position) * -math.expm1(-duration / _LAG)
        largest = self.value(Object.MAX_MOTOR_SPEED) / 60.0 * self.counts_per_turn * duration
        return min(max(wanted, -largest), largest)

    def ahead(self, duration: float) -> float:
        """Position [counts] after ``duration`` if no set-point arrives before."""
        following = self.state is DriveState.OPERATION_ENABLED
        return self.position + (self._step(duration) if following else 0.0)

    @property
    def interpolation_time(self) -> float:
        """Time from one SYNC to the next, by object 0x60C2 [s]."""
        exponent = self.value(Object.INTERPOLATION_TIME, 2)
        return float(self.value(Object.INTERPOLATION_TIME, 1) * 10.0**exponent)

    counts_per_turn = 2048.0
    """Encoder counts per turn of the motor; the speed limit 0x6080 is in turns."""

    def _slow_down(self, duration: float) -> None:
        unit = reported_counts(self.value(Object.ACCELERATION_UNIT), self.counts_per_turn) or 1.0
        change = self.value(Object.QUICK_STOP_DECELERATION) * unit * duration
        before = self.velocity
        self.velocity = math.copysign(max(0.0, abs(before) - change), before)
        self.position += 0.5 * (before + self.velocity) * duration if self.velocity else 0.0
        self.demand = round(self.position)
        stops = self.state is DriveState.QUICK_STOP_ACTIVE and self.velocity == 0.0
        if stops and self.value(Object.QUICK_STOP_OPTION) < 5:  # options 1 to 4 end in SWITCH ON DISABLED
            self.state = DriveState.SWITCH_ON_DISABLED


LIVE: dict[int, Callable[[SimulatedDrive], int]] = {
    Object.STATUSWORD: SimulatedDrive.statusword,
    Object.POSITION: lambda drive: round(drive.position),
    Object.POSITION_DEMAND: lambda drive: round(drive.demand),
    Object.VELOCITY: lambda drive: round(drive.velocity),
    Object.TORQUE: lambda drive: max(-32768, min(32767, round(drive.torque))),
    Object.TARGET_POSITION: lambda drive: drive.target,
    Object.CONTROLWORD: lambda drive: drive.controlword,
    Object.ERROR_CODE: lambda drive: drive.error_code,
    Object.FOLLOWING_ERROR: lambda drive: round(drive.target - drive.position),
    Object.MODE_DISPLAY: lambda drive: drive.value(Object.MODE),
}
"""Objects whose value is the drive's own state, by their index on a first axis."""
