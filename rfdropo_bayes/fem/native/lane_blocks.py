"""Blocks of lanes spread over threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import count as counting


@cache
def _workers(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads that wait for lane blocks; a forked ``process`` starts its own."""
    return ThreadPoolExecutor(threads, f"lanes_{process}")


def in_blocks(block: Callable[[int], None], count: int, lanes: int, threads: int) -> None:
    """Call for the first rollout of every lane block, in this thread or in several."""
    threads = min(threads, -(-count // lanes))
    following = counting(0, lanes)

    def work() -> None:
        while (first := next(following)) < count:
            block(first)

    waiting = [_workers(threads - 1, os.getpid()).submit(work) for _ in range(threads - 1)]
    work()
    for other in waiting:
        other.result()
