"""How long a run has waited for processors that other programs held."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

THREADS = Path("/proc/self/task")
NANOSECOND = 1e-9

Times = Mapping[str, tuple[float, float]]


def thread_times() -> dict[str, tuple[float, float]]:
    """For each thread of this process, the seconds that it has run, and those that it was ready to run and did not.

    Empty where the system does not count them; Linux does.
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

    Threads that are ready side by side would share the processors. Time in which no thread is ready, as where another
    process simulates, is no delay.

    Args:
        elapsed: seconds between the two looks.
        before, after: times of the threads, see `thread_times`; of a thread that has ended nothing is known.
        processors: of the machine.
    """
    ran, ready = 0.0, 0.0
    for name, (running, waiting) in after.items():
        earlier = before.get(name, (0.0, 0.0))
        ran += running - earlier[0]
        ready += running - earlier[0] + waiting - earlier[1]
    side_by_side = min(max(ready / elapsed, 1.0), processors) if elapsed > 0.0 else 1.0
    return max(min(elapsed, ready) - ran / side_by_side, 0.0)
