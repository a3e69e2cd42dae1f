"""Time that a run has waited for processors used by other programs."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

THREADS = Path("/proc/self/task")
NANOSECOND = 1e-9

Times = Mapping[str, tuple[float, float]]


def thread_times() -> dict[str, tuple[float, float]]:
    """Seconds that each thread of this process has run, and seconds that it was ready but waiting.

    Empty if the system does not count them, as only Linux does.
    """
    found = {}
    with suppress(OSError):
        for thread in THREADS.iterdir():
            with suppress(OSError, ValueError):  # a thread that has ended meanwhile
                ran, waited, _ = map(int, (thread / "schedstat").read_text().split())
                found[thread.name] = (NANOSECOND * ran, NANOSECOND * waited)
    return found


def delay(elapsed: float, before: Times, after: Times, processors: int) -> float:
    """Seconds by which the work of all threads took longer than with the processors for itself alone.

    Simultaneously ready threads share the processors. Time without a ready thread, as while another process simulates,
    is no delay.

    Args:
        elapsed: seconds between the two measurements.
        before, after: times of the threads, see `thread_times`; ended threads are unknown.
        processors: number of processors.
    """
    ran, ready = 0.0, 0.0
    for name, (running, waiting) in after.items():
        earlier = before.get(name, (0.0, 0.0))
        ran += running - earlier[0]
        ready += running - earlier[0] + waiting - earlier[1]
    side_by_side = min(max(ready / elapsed, 1.0), processors) if elapsed > 0.0 else 1.0
    return max(min(elapsed, ready) - ran / side_by_side, 0.0)
