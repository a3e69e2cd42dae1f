"""The control loop: set-points out and status in at every cycle, and every phase of a session from enabling to rest."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from enum import IntEnum
from itertools import count
from typing import NamedTuple

import can
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.deployment.causes import Cause, Reaction, Stop
from rfdropo_bayes.deployment.cia402 import DriveState, controlword_towards
from rfdropo_bayes.deployment.clock import CycleClock, Tick
from rfdropo_bayes.deployment.drives import Drive, Drives
from rfdropo_bayes.deployment.log import SessionLog
from rfdropo_bayes.deployment.objects import Nmt
from rfdropo_bayes.deployment.policy import CommandSource, PolicyScene
from rfdropo_bayes.deployment.sensors import MarkerView
from rfdropo_bayes.deployment.setpoints import SetPoints
from rfdropo_bayes.deployment.settings import SafetyTable
from rfdropo_bayes.deployment.watch import AfterStop, Watch
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot

_AWAY = 1e-4  # [m]: a braked drive farther than this from its command holds another command
_ANSWER = 0.6  # of a period: how long a cycle waits for the drives; the rest is for policy, log and sleep
SLOW = 0.2  # share of each motor's own limit: the rate of the ramp to the start pose
HOLD_S = 0.3  # for which the drives are watched after a stop
ENABLE_S = 2.0  # within this time the drives must be enabled


class Phase(IntEnum):
    """Purpose of a cycle, as written to the log."""

    ENABLING = 1
    HOMING = 2
    STARTING = 3
    SETTLING = 4
    RUNNING = 5
    STOPPING = 6
    HOLDING = 7
    BRAKED = 8
    SHADOW = 9


class Snapshot(NamedTuple):
    """Content of the display: phase, time left [s], last lateness [s], misses, act time [s] and the drives."""

    phase: Phase | None
    left: float
    lateness: float
    missed: int
    act_time: float
    set_point: Float[np.ndarray, " channel"]
    drives: Sequence[Drive]


class ControlLoop:
    """One session on configured drives. The loop runs in its own thread; `run` returns the reason for its end.

    Args:
        robot: robot to drive.
        drives: configured and operational.
        markers: view of the marker sensor.
        log: receives every cycle.
        safety: limits of the session.
        period: length of a cycle [s].
        say: receives lines for the log.
    """

    def __init__(
        self,
        robot: Robot,
        drives: Drives,
        markers: MarkerView,
        log: SessionLog,
        safety: SafetyTable,
        period: float,
        say: Callable[[str], None],
    ) -> None:
        self.robot, self.drives, self.markers, self.log = robot, drives, markers, log
        self.safety, self.period, self._say = safety, period, say
        channels = len(robot.motors)
        self.motors = [drive.motor for drive in drives.all]
        radius = np.array([motor.drum_radius_m for motor in self.motors])
        self.scale = radius if robot.command_unit == "rad" else np.ones(channels)  # command unit -> m
        self._least = np.array([motor.tension_limit_n[0] for motor in self.motors])
        self.set_points = SetPoints(self.motors, period, np.zeros(channels))
        self.command = np.zeros(channels)  # in force [m]
        self._raw, self._asked = np.zeros(channels), np.zeros(channels)
        self.watch = Watch(drives, safety)
        self._clock: CycleClock
        self._wanted = DriveState.SWITCH_ON_DISABLED
        self._expected: DriveState | None = None
        self._pulling = False  # whether a tension above its limit is known, and comes to rest
        self.pulse: float | None = None
        self.demanded: Stop | None = None  # by another thread
        self.lateness: list[float] = []
        self.act_times: list[float] = []
        self.snapshot = Snapshot(None, 0.0, 0.0, 0, 0.0, np.zeros(channels), drives.all)
        self._left = 0.0
        self.stop_time: float | None = None

    # One cycle

    def cycle(self, phase: Phase, acted: bool = False, meanwhile: Callable[[], None] | None = None) -> Tick:
        """Wait for the cycle, send set-points, read status and markers, check both, and log.

        Args:
            phase: phase for the log.
            acted: whether a command comes into force.
            meanwhile: called while the drives answer.

        Raises:
            Stop: if this cycle must be the last of its phase.
        """
        tick = self._clock.wait()
        self.pulse = time.monotonic()
        if self.demanded is not None and phase is not Phase.BRAKED:
            raise self.demanded
        for drive, length in zip(self.drives.all, self.set_points.length, strict=True):
            state = drive.state
            if state is not None:
                drive.controlword = controlword_towards(state, self._wanted, drive.controlword)
            if state is DriveState.OPERATION_ENABLED:
                drive.target = drive.motor.counts(length, drive.offset)
            elif drive.reading is not None:
                drive.target = drive.reading.position  # a drive must find its own position as target when it is enabled
        try:
            self.drives.exchange(_ANSWER * self.period, meanwhile)
        except can.CanError as error:
            raise Stop(Cause.SEND_ERROR, str(error)) from None
        try:
            self.markers.update(self.pulse)
            if phase is not Phase.BRAKED:
                if self.demanded is not None:  # consequences of a stop by another thread are not its cause
                    raise self.demanded
                self.watch.check(tick, self._expected, tension=not self._pulling)
        finally:
            self._write(tick, phase, acted)
        return tick

    def _write(self, tick: Tick, phase: Phase, acted: bool) -> None:
        self.lateness.append(tick.lateness)
        if all(drive.reading is not None for drive in self.drives.all):
            record, all_drives = self.log.record, self.drives.all
            record["time"], record["lateness"], record["missed"] = tick.time, tick.lateness, min(tick.missed, 65535)
            record["phase"], record["acted"] = phase, acted
            record["raw"], record["asked"] = self._raw, self._asked
            record["command"] = self.command / self.scale
            record["set_point"] = self.set_points.length
            record["length"] = self.lengths()
            record["tension"] = self.tensions()
            record["fresh"] = [drive.reading is not None and drive.reading.time >= tick.time for drive in all_drives]
            record["statusword"] = [drive.reading.statusword for drive in all_drives if drive.reading]
            record["controlword"] = [drive.controlword for drive in all_drives]
            record["position"], record["seen"] = self.markers.position, self.markers.fresh
            record["object_pose"], record["object_seen"] = self.markers.object_pose, self.markers.object_fresh
            record["seen_at"] = self.markers.instant
            self.log.write()
        act_time = self.act_times[-1] if self.act_times else 0.0
        self.snapshot = Snapshot(
            phase, self._left, tick.lateness, self.watch.missed, act_time, self.set_points.length, self.drives.all
        )

    def lengths(self) -> Float[np.ndarray, " channel"]:
        """Measured cable on each drum [m]."""
        return np.array([drive.length for drive in self.drives.all])

    def tensions(self) -> Float[np.ndarray, " channel"]:
        """Measured tensions [N]."""
        return np.array([drive.tension for drive in self.drives.all])

    # Phases

    def run(self, phases: Callable[[ControlLoop], None]) -> Stop:
        """Go through the phases, and come to rest after any error.

        Returns:
            Why it ended.
        """
        self.watch.begin()
        self._clock = CycleClock(self.period)
        try:
            phases(self)
            stop = Stop(Cause.FINISHED)
        except Exception as error:  # the drives must come to rest before anything else
            stop = _as_stop(error)
        return self._come_to_rest(stop)

    def find(self) -> None:
        """Read the first status of every drive; set-points begin at the drives' positions.

        Raises:
            Stop: a drive sends no status within a second.
        """
        end = time.monotonic() + 1.0
        while silent := [drive.name for drive in self.drives.all if drive.reading is None]:
            self.cycle(Phase.ENABLING)
            if time.monotonic() > end:
                raise Stop(Cause.STALE_STATUS, f"{silent[0]} sends no status")
        self.set_points.length = self.lengths()
        self.command = self.set_points.length.copy()

    def enable(self) -> None:
        """Bring every drive to OPERATION ENABLED, with its present position as target.

        Raises:
            Stop: if a drive is not enabled in time, or stands outside its limits.
        """
        self.find()
        for drive, low, high in zip(self.drives.all, self.set_points.low, self.set_points.high, strict=True):
            if not low - 1e-4 <= drive.length <= high + 1e-4:
                raise Stop(
                    Cause.NOT_ENABLED,
                    f"{drive.name} stands at {1e3 * drive.length:.1f} mm, outside its limits: home it",
                )
        self._wanted = DriveState.OPERATION_ENABLED
        end = time.monotonic() + ENABLE_S
        while waiting := [drive for drive in self.drives.all if drive.state is not DriveState.OPERATION_ENABLED]:
            if time.monotonic() > end:
                state = waiting[0].state
                raise Stop(
                    Cause.NOT_ENABLED, f"{waiting[0].name} stays in {state.words if state else 'no known state'}"
                )
            self.cycle(Phase.ENABLING)
        self._expected = DriveState.OPERATION_ENABLED

    def go_to(self, length: Float[np.ndarray, " channel"], phase: Phase, settle: float) -> None:
        """Move slowly to these lengths [m], and rest there."""
        limit = SLOW * np.array([motor.rate_limit_m_s for motor in self.motors])
        goal = self.set_points.clamp(length)
        self.command = goal.copy()
        acted = True
        while np.any(np.abs(self.set_points.length - goal) > 1e-7) or not self.set_points.at_rest:
            self.set_points.towards(goal, rate_limit=limit)
            self.cycle(phase, acted)
            acted = False
        for _ in range(round(settle / self.period)):
            self.cycle(Phase.SETTLING, acted)
            acted = False

    def follow(self, source: CommandSource, duration: float, phase: Phase = Phase.RUNNING) -> None:
        """Let the source command for ``duration`` seconds, then finish the last ramp.

        Every change of a command is carried out linearly over the robot's ``ramp_s``, within all limits, as in the
        simulator. The log is therefore calibrated without changes.

        Raises:
            Stop: if a command cannot be followed, or a marker or object that the source needs is lost.
        """
        cycles = round(1.0 / (source.rate_hz * self.period))
        steps = max(1, round(self.robot.command.ramp_s / self.period))
        changes: deque[tuple[int, np.ndarray]] = deque(maxlen=1 + steps // cycles)
        last = round(duration / self.period)
        source.rehearse()
        for number in count():
            self._left = max(0.0, duration - number * self.period)
            self._check_sight(source)
            acting = number < last and number % cycles == 0
            if acting:
                previous = self.command.copy()
                acting = self._act(source, cycles * self.period)
                if acting:
                    changes.append((number, self.command - previous))
                else:
                    last = number
            if number >= last + steps - cycles:
                return
            shares = [(max(0.0, 1.0 - (number + 1 - given) / steps), change) for given, change in changes]
            ramp = self.command - sum((share * change for share, change in shares), np.zeros(len(self.command)))
            self.set_points.towards(self._without_slack(self.command), self._without_slack(ramp))
            self.cycle(phase, acting, source.rehearse if (number + 1) % cycles == 0 else None)

    def _check_sight(self, source: CommandSource) -> None:
        """Raise a Stop if a marker or the object that a source needs is lost, or was never seen."""
        if source.sees_markers and (name := self.markers.lost(time.monotonic())):
            raise Stop(Cause.MARKERS_LOST, f"marker {name!r} is lost")
        if source.sees_object and self.markers.object_lost(time.monotonic()):
            raise Stop(Cause.MARKERS_LOST, "the object is lost")

    def _act(self, source: CommandSource, period: float) -> bool:
        self.markers.act()
        unit, pose = self.command / self.scale, self.markers.object_pose
        scene = PolicyScene(self.markers.position, self.markers.moved, unit, self.lengths(), self.tensions(), pose)
        began = time.monotonic()
        act = source.act(scene)
        self.act_times.append(time.monotonic() - began)
        if act is None:
            return False
        if not np.all(np.isfinite(act.command)):
            raise Stop(Cause.ACTION_NOT_FINITE, f"the command is {act.command.tolist()}")
        self._raw, self._asked = act.raw, act.command
        reach = self.set_points.rate_limit * period
        asked = np.clip(act.command * self.scale, self.command - reach, self.command + reach)
        self.command = self.set_points.clamp(asked)
        return True

    def _without_slack(self, length: Float[np.ndarray, " channel"]) -> Float[np.ndarray, " channel"]:
        """Cables below their least tension are not let out further."""
        slack = self.tensions() < self._least
        return np.where(slack, np.maximum(length, self.set_points.length), length)

    # Rest

    def _come_to_rest(self, stop: Stop) -> Stop:
        """Ramp or brake, then hold; a second cause on the way brakes."""
        self._say(str(stop))
        began = time.monotonic()
        if self._expected is None:  # nothing was enabled, so that nothing needs a ramp
            return self._brake(began, stop)
        if stop.cause.reaction is Reaction.RAMP:
            self._pulling = stop.cause is Cause.TENSION
            try:
                acted = True
                while not self.set_points.at_rest:
                    self.set_points.halt()
                    self.command = self.set_points.length.copy()
                    self.cycle(Phase.STOPPING, acted)
                    acted = False
                self.stop_time = time.monotonic() - began
                for _ in range(round(HOLD_S / self.period)):
                    self.cycle(Phase.HOLDING)
                if stop.cause is Cause.FINISHED and self.safety.after == "release":
                    self._release()
                    return stop
            except Exception as error:
                second = _as_stop(error)
                self._say(f"while stopping: {second}")
                stop = stop if stop.cause is not Cause.FINISHED else second
        return self._brake(began, stop)

    def _release(self) -> None:
        """Switch the drives off, one state down at a time."""
        self._wanted, self._expected = DriveState.SWITCH_ON_DISABLED, None
        end = time.monotonic() + ENABLE_S
        while any(drive.state is not DriveState.SWITCH_ON_DISABLED for drive in self.drives.all):
            self.cycle(Phase.HOLDING)
            if time.monotonic() > end:
                raise Stop(Cause.DRIVE_STATE, "a drive does not switch off")

    def _brake(self, began: float, stop: Stop) -> Stop:
        """Quick stop; the drives must then report standstill and keep holding.

        Returns:
            The stop, with the drives that did not hold; these are the cause of a session that had ended as planned.
        """
        self._wanted = DriveState.QUICK_STOP_ACTIVE
        after = AfterStop(self.drives)
        for failure in self.drives.quick_stop():
            self._say(f"quick stop not sent: {failure}")
        end = time.monotonic() + HOLD_S
        failed = False
        while time.monotonic() < end:
            try:
                self.cycle(Phase.BRAKED, self._hold_where_it_is())
            except Exception as error:
                if not failed:
                    self._say(f"while braking: {_as_stop(error)}; the drives' own guards stop them")
                failed = True
            for line in after.look():
                self._say(line)
            if self.stop_time is None and all(_stands(drive) for drive in self.drives.all):
                self.stop_time = time.monotonic() - began
        if moving := [drive for drive in self.drives.all if not _stands(drive)]:
            for drive in moving:
                self._say(f"{drive.name} has not shown that it stands")
            try:  # the last word that the bus has; nodes that are lost quick-stop by object 0x6007
                self.drives.manage(Nmt.STOP)
            except can.CanError:
                self._say("the bus is lost: the drives' heartbeat guards stop them")
        self.pulse = None
        if not after.events:
            return stop
        cause = Cause.DRIVE_STATE if stop.cause is Cause.FINISHED else stop.cause
        return Stop(cause, "; ".join(filter(None, [stop.detail, *after.events])))

    def _hold_where_it_is(self) -> bool:
        """Set the command to the drives' positions once they no longer follow it; returns whether it changed."""
        if any(drive.reading is None for drive in self.drives.all):
            return False
        length = self.lengths()
        if self._expected is None or np.all(np.abs(length - self.command) < _AWAY):
            return False
        self.command = length
        return True


def _as_stop(error: Exception) -> Stop:
    """The stop for an exception in any part of a session."""
    if isinstance(error, Stop):
        return error
    return Stop(
        Cause.PROGRAM_ERROR, str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    )


def _stands(drive: Drive) -> bool:
    return drive.state in (
        DriveState.QUICK_STOP_ACTIVE,
        DriveState.SWITCH_ON_DISABLED,
        DriveState.FAULT,
        DriveState.READY_TO_SWITCH_ON,
    )
