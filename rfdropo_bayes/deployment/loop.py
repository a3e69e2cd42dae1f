"""The control loop: set-points out and status in at every cycle, and every phase of a session from enabling to rest.

Set-points: lengths within every motor's limits on length, rate and acceleration, for any commands. Detection of faults
that end a running session, in the drives, the bus and the clock.
"""

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
from rfdropo_bayes.deployment.cia402 import DriveState, Status, controlword_towards
from rfdropo_bayes.deployment.clock import CycleClock, Tick
from rfdropo_bayes.deployment.drives import Drive, Drives
from rfdropo_bayes.deployment.log import SessionLog
from rfdropo_bayes.deployment.objects import Nmt, NmtState, Object
from rfdropo_bayes.deployment.policy import CommandSource, PolicyScene
from rfdropo_bayes.deployment.sensors import MarkerView
from rfdropo_bayes.deployment.settings import SafetyTable
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Motor, Robot

MISSES_WITHIN_S = 1.0  # the time in which so many missed deadlines end a session


class Watch:
    """Checks every cycle and raises `Stop` on a fault.

    Args:
        drives: drives to check.
        safety: fault tolerances.
    """

    def __init__(self, drives: Drives, safety: SafetyTable) -> None:
        self._drives, self._safety = drives, safety
        self._misses: deque[float] = deque()
        self.missed = 0
        self.begin()

    def begin(self) -> None:
        """Start the watch; earlier events do not count."""
        self._short = [drive.short_frames for drive in self._drives.all]
        self._drives.emergencies.clear()
        self._started = time.monotonic()
        self._lagging: dict[Drive, float] = {}  # since when

    def check(self, tick: Tick, expected: DriveState | None, tension: bool = True) -> None:
        """Check a cycle after its exchange.

        Args:
            tick: the cycle.
            expected: state that every drive must be in; None while they are brought there.
            tension: whether a tension above the limit counts.

        Raises:
            Stop: with the first cause found; causes that name a drive come first.
        """
        now = time.monotonic()
        self._check_emergencies()
        for number, drive in enumerate(self._drives.all):
            if drive.short_frames > self._short[number]:
                raise Stop(Cause.SHORT_FRAME, f"{drive.name} sent a status frame of the wrong length")
            self._check_life(drive, now)
            self._check_state(drive, expected)
            if expected is DriveState.OPERATION_ENABLED:
                self._check_lag(drive, now)
            if tension and drive.reading is not None and drive.tension > drive.motor.tension_limit_n[1]:
                limit = drive.motor.tension_limit_n[1]
                raise Stop(Cause.TENSION, f"{drive.name} pulls {drive.tension:.1f} N, more than {limit:g} N")
        self._check_deadlines(tick)

    def _check_emergencies(self) -> None:
        while self._drives.emergencies:
            emergency = self._drives.emergencies.popleft()
            drive = "drive " + " or ".join(map(repr, emergency.channels))  # a node does not name the axis
            if emergency.code == 0x8611:
                raise Stop(Cause.FOLLOWING_ERROR, f"{drive} does not follow its set-points")
            if emergency.code:
                raise Stop(Cause.EMERGENCY_MESSAGE, f"{drive} reports 0x{emergency.code:04X}")

    def _check_life(self, drive: Drive, now: float) -> None:
        quiet = now - max(drive.node.heartbeat, self._started)
        if drive.node.nmt not in (None, NmtState.OPERATIONAL):
            raise Stop(Cause.NODE_STATE, f"{drive.name} left OPERATIONAL (its heartbeat reports {drive.node.nmt})")
        if quiet > self._safety.heartbeat_s:
            raise Stop(Cause.HEARTBEAT_LOST, f"{drive.name}: no heartbeat for {1e3 * quiet:.0f} ms")
        if drive.unanswered > self._safety.stale_cycles:
            raise Stop(Cause.STALE_STATUS, f"{drive.name}: no status for {drive.unanswered} cycles")

    def _check_state(self, drive: Drive, expected: DriveState | None) -> None:
        if drive.reading is None:
            return
        state = drive.state
        if state in (DriveState.FAULT, DriveState.FAULT_REACTION) and expected is not None:
            raise Stop(Cause.DRIVE_STATE, f"{drive.name} is in {state.words}")
        if expected is not None and state is not expected:
            words = "an unknown state" if state is None else state.words
            raise Stop(Cause.DRIVE_STATE, f"{drive.name} is in {words}, not in {expected.words}")
        if expected is DriveState.OPERATION_ENABLED and drive.reading.statusword & Status.FOLLOWING_ERROR:
            raise Stop(Cause.FOLLOWING_ERROR, f"{drive.name} lags behind its set-point")

    def _check_lag(self, drive: Drive, now: float) -> None:
        """A drive may repeat an old "operation enabled" forever; only its lack of motion reveals it."""
        if drive.reading is None:
            return
        lag = abs(drive.target - drive.reading.position) / drive.motor.counts_per_metre
        if lag <= self._safety.following_error_m:
            self._lagging.pop(drive, None)
        elif now - self._lagging.setdefault(drive, now) > self._safety.following_time_s:
            raise Stop(Cause.FOLLOWING_ERROR, f"{drive.name} is {1e3 * lag:.1f} mm behind its set-point")

    def _check_deadlines(self, tick: Tick) -> None:
        if tick.missed:
            self.missed += tick.missed
            self._misses.extend([tick.time] * tick.missed)
        while self._misses and self._misses[0] < tick.time - MISSES_WITHIN_S:
            self._misses.popleft()
        if len(self._misses) >= self._safety.misses:
            raise Stop(Cause.DEADLINES, f"{len(self._misses)} deadlines missed within {MISSES_WITHIN_S:g} s")


class AfterStop:
    """Looks at drives after a quick stop, which they should hold: some enable themselves again, others let go.

    Args:
        drives: drives that are stopped.
    """

    def __init__(self, drives: Drives) -> None:
        self._to_hold = [drive for drive in drives.all if drive.state in _HOLDING]
        self._stopped: set[Drive] = set()
        self.events: list[str] = []

    def look(self) -> list[str]:
        """Events since the last call; each drive is reported once."""
        new = [line for drive in self._to_hold if (line := self._seen(drive))]
        self._to_hold = [drive for drive in self._to_hold if not any(line.startswith(drive.name) for line in new)]
        self.events += new
        return new

    def _seen(self, drive: Drive) -> str:
        state = drive.state
        if state is DriveState.QUICK_STOP_ACTIVE:
            self._stopped.add(drive)
        if state is DriveState.OPERATION_ENABLED and drive in self._stopped:
            return f"{drive.name} enabled itself again after the quick stop"
        if state not in _HOLDING and Object.QUICK_STOP_OPTION not in drive.unguarded:  # else its owner bears that
            words = "an unknown state" if state is None else state.words
            return f"{drive.name} let its cable go after the quick stop: it is in {words}"
        return ""


_HOLDING = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)


class SetPoints:
    """Set-points of all motors, one step per cycle.

    A step never exceeds the limits on rate and acceleration, and always leaves the distance needed to stop at the goal.
    A goal within the limits on length is therefore never overshot.

    Args:
        motors: give the limits.
        period: length of the cycle [s].
        length: initial length, at rest [m].
    """

    def __init__(self, motors: Sequence[Motor], period: float, length: Float[np.ndarray, " motor"]) -> None:
        self.period = period
        self.low = np.array([motor.length_limit_m[0] for motor in motors])
        self.high = np.array([motor.length_limit_m[1] for motor in motors])
        self.rate_limit = np.array([motor.rate_limit_m_s for motor in motors])
        self.acceleration_limit = np.array([motor.acceleration_limit_m_s2 for motor in motors])
        self.length = np.array(length, dtype=float)
        self.rate = np.zeros(len(motors))

    def clamp(self, length: Float[np.ndarray, " motor"]) -> Float[np.ndarray, " motor"]:
        """The nearest lengths within the limits; a motor that stands outside them may stay or come back."""
        return np.clip(length, np.minimum(self.low, self.length), np.maximum(self.high, self.length))

    def towards(
        self,
        goal: Float[np.ndarray, " motor"],
        ramp: Float[np.ndarray, " motor"] | None = None,
        rate_limit: Float[np.ndarray, " motor"] | float = np.inf,
    ) -> Float[np.ndarray, " motor"]:
        """The next set-points [m].

        Args:
            goal: end of the motion [m].
            ramp: planned set-point at the next cycle [m]; the goal itself by default.
            rate_limit: rate limit below the motors' own [m/s].
        """
        ramp = goal if ramp is None else ramp  # ramps that overlap may pass the goal, and come back
        fastest = np.minimum(self.rate_limit, rate_limit)
        above = np.maximum(0.0, np.maximum(goal, ramp) - self.length)
        below = np.maximum(0.0, self.length - np.minimum(goal, ramp))
        upper = np.minimum(fastest, self._stopping_rate(above))
        lower = -np.minimum(fastest, self._stopping_rate(below))
        return self._step(np.clip((ramp - self.length) / self.period, lower, upper))

    def _stopping_rate(self, distance: Float[np.ndarray, " motor"]) -> Float[np.ndarray, " motor"]:
        """Largest rate from which steps of the acceleration limit still end within a distance, this step included.

        In units of a dt the rate is k + f, with 0 <= f < 1, and the way of all its steps a dt^2 (k + 1) (k / 2 + f).
        """
        steps = 2.0 * distance / (self.acceleration_limit * self.period**2)
        whole = np.floor(0.5 * (np.sqrt(1.0 + 4.0 * steps) - 1.0))
        return 0.5 * self.acceleration_limit * self.period * (whole + steps / (whole + 1.0))

    def halt(self) -> Float[np.ndarray, " motor"]:
        """The next set-points on the shortest way to rest."""
        return self._step(np.zeros_like(self.rate))

    @property
    def at_rest(self) -> bool:
        """Whether nothing moves."""
        return bool(np.all(self.rate == 0.0))

    def _step(self, wanted: Float[np.ndarray, " motor"]) -> Float[np.ndarray, " motor"]:
        change = self.acceleration_limit * self.period
        self.rate = np.clip(wanted, self.rate - change, self.rate + change)
        self.length = self.length + self.period * self.rate
        return self.length


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
