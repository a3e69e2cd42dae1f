"""The clock of the control loop: absolute deadlines, real-time scheduling if permitted, and its lateness."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import math
import os
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

PRIORITY = 50  # SCHED_FIFO: above every ordinary process, below the kernel's own interrupt threads
PLANT_PRIORITY = 30  # of a simulated robot: after everything that has a deadline
_LOCK_ALL = 7  # MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT
_SWITCH = 5e-4  # [s]: time after which another thread gives the interpreter back; 5 ms by default


class Tick(NamedTuple):
    """A control cycle: number, time [s, monotonic], delay of the loop [s], and number of skipped cycles."""

    number: int
    time: float
    lateness: float
    missed: int


class CycleClock:
    """Cycles start at ``start + number x period``. A late cycle does not shift its successors; missed cycles are
    skipped.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self._start = time.monotonic()
        self._number = 0

    def wait(self) -> Tick:
        """Sleep until the next cycle.

        A loop that wakes more than a whole period late has missed cycles. Missed cycles are counted, not repeated.
        """
        self._number += 1
        due = self._start + self._number * self.period
        delay = due - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
        lateness = time.monotonic() - due
        missed = max(0, math.floor(lateness / self.period))
        self._number += missed
        return Tick(self._number, due + missed * self.period, lateness, missed)


@contextlib.contextmanager
def real_time(priority: int = PRIORITY, threads: Iterable[int] = (0,)) -> Iterator[bool]:
    """Give threads real-time priority (SCHED_FIFO) for a while; yields False if the system refuses.

    The block must sleep between its cycles. It must not wait for the end of a process: Linux then clears that process
    out of /proc, in a loop without sleep, until threads of it have done their share. If these threads have a lower
    priority on the same processor, they never run, and the loop never ends. For the same reason the block restores the
    normal priority: a thread must not end with a raised priority.

    Args:
        priority: SCHED_FIFO priority; a higher number runs first.
        threads: system numbers of the threads; 0 is the calling thread.
    """
    before = []
    for thread in threads:
        with contextlib.suppress(OSError, AttributeError):  # not permitted, not known to the system, or ended
            was = os.sched_getscheduler(thread), os.sched_getparam(thread)
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
            before.append((thread, was))
    try:
        yield bool(before)
    finally:
        for thread, (policy, parameters) in before:
            with contextlib.suppress(ProcessLookupError):  # the thread has ended
                os.sched_setscheduler(thread, policy, parameters)


def lock_memory(locked: bool) -> bool:
    """Keep the pages that this process has touched in memory, or let them go; False if the system refuses.

    A page that the system has taken back is read from the disk again, which takes milliseconds.
    """
    try:
        system = ctypes.CDLL(None)
        return (system.mlockall(_LOCK_ALL) if locked else system.munlockall()) == 0
    except (OSError, AttributeError):
        return False


@contextlib.contextmanager
def steady_interpreter() -> Iterator[None]:
    """No pauses of the garbage collector or for lost pages, and short turns for the other threads."""
    switch, collecting = sys.getswitchinterval(), gc.isenabled()
    gc.collect()
    gc.disable()
    sys.setswitchinterval(_SWITCH)
    lock_memory(True)
    try:
        yield
    finally:
        lock_memory(False)
        sys.setswitchinterval(switch)
        if collecting:
            gc.enable()


class Jitter(NamedTuple):
    """Lateness of the cycles of an idle loop."""

    fifo: bool  # whether the system permitted real-time scheduling
    lateness: Float[np.ndarray, " cycles"]  # lateness of each cycle [s]
    missed: int  # skipped cycles


def measure_jitter(period: float, seconds: float) -> Jitter:
    """Run an idle loop, in its own thread so that the calling thread keeps its priority."""
    jitters: list[Jitter] = []

    def loop() -> None:
        with real_time() as granted:
            clock = CycleClock(period)
            ticks = [clock.wait() for _ in range(max(2, round(seconds / period)))]
        jitters.append(Jitter(granted, np.array([tick.lateness for tick in ticks]), sum(tick.missed for tick in ticks)))

    with steady_interpreter():
        thread = threading.Thread(target=loop, name="idle loop")
        thread.start()
        thread.join()
    return jitters[0]
