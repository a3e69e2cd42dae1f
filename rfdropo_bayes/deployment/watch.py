"""Detection of faults that end a running session, in the drives, the bus and the clock."""

from __future__ import annotations

import time
from collections import deque

from rfdropo_bayes.deployment.causes import Cause, Stop
from rfdropo_bayes.deployment.cia402 import DriveState, Status
from rfdropo_bayes.deployment.clock import Tick
from rfdropo_bayes.deployment.drives import Drive, Drives
from rfdropo_bayes.deployment.objects import NmtState, Object
from rfdropo_bayes.deployment.settings import SafetyTable

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
