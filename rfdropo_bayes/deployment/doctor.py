"""Checks whether this machine can run a session: versions, scheduling, jitter of the clock, bus, drives."""

from __future__ import annotations

import contextlib
import os
import platform
import time
from importlib import metadata
from typing import Any

import can
import numpy as np

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bus import BusTable, LoggedNetwork, open_bus
from rfdropo_bayes.deployment.clock import measure_jitter
from rfdropo_bayes.errors import InputError

PACKAGES = ("canopen", "python-can", "onnxruntime", "natnet", "numpy")
IDLE_RUNS, IDLE_SECONDS = 5, 2.0
_IDENTITY = ((1, "vendor"), (2, "product"), (3, "revision"), (4, "serial"))


def examine(bus: BusTable | None, rate_hz: float = 100.0) -> dict[str, Any]:
    """Measure and ask; nothing is written to any drive.

    Args:
        bus: bus to search for drives; None skips the search.
        rate_hz: rate of the loop whose jitter is measured.

    Returns:
        Versions, processors and load, the median of the idle runs' lateness [s], and the drives found; "problems" lists
        everything that is wrong.
    """
    problems: list[str] = []
    versions = {name: _version(name) for name in PACKAGES}
    problems += [
        f"{name} is not installed: pip install 'rfdropo_bayes[deploy]'" for name, v in versions.items() if not v
    ]
    runs = [measure_jitter(1.0 / rate_hz, IDLE_SECONDS) for _ in range(IDLE_RUNS)]
    jitter = {
        "rate_hz": rate_hz,
        "real_time": runs[0].fifo,
        "runs": len(runs),
        "p50_s": float(np.median([np.percentile(run.lateness, 50) for run in runs])),
        "p99_s": float(np.median([np.percentile(run.lateness, 99) for run in runs])),
        "max_s": float(np.median([run.lateness.max() for run in runs])),
        "missed": int(np.median([run.missed for run in runs])),
    }
    if not jitter["real_time"]:
        problems.append("no real-time scheduling: allow SCHED_FIFO (ulimit -r 60, or CAP_SYS_NICE)")
    if jitter["missed"]:
        problems.append(
            f"an idle loop misses {jitter['missed']} deadlines in {IDLE_SECONDS:g} s: free this machine of other work"
        )
    drives: dict[str, Any] = {}
    if bus is not None:
        try:
            drives = scan(bus)
            if not drives:
                problems.append("no node answers: check power, termination and bit rate")
        except InputError as error:
            problems.append(str(error))
    return {
        "python": platform.python_version(),
        "system": platform.platform(),
        "processors": os.cpu_count(),
        "load": os.getloadavg()[0],
        "versions": versions,
        "jitter": jitter,
        "bus": None if bus is None else f"{bus.interface} {bus.channel}",
        "drives": drives,
        "problems": problems,
    }


def scan(bus: BusTable, patience: float = 0.5) -> dict[str, dict[str, int]]:
    """Ask every node number for its type and identity.

    Returns:
        Device type and identity (object 0x1018), by node number.

    Raises:
        InputError: if the bus cannot be opened or fails.
    """
    network = LoggedNetwork(open_bus(bus))
    answers: dict[tuple[int, int, int], int] = {}

    def take(identifier: int, data: bytearray, timestamp: float) -> None:
        if len(data) == 8 and data[0] & 0xE2 == 0x42:  # an expedited answer, which may state its size
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
            key = (identifier - 0x580, int.from_bytes(data[1:3], "little"), data[3])
            answers[key] = int.from_bytes(data[4 : 4 + size], "little")

    try:
        for node in range(1, 128):
            network.subscribe(0x580 + node, take)
        for node in range(1, 128):
            _ask(network, node, objects.Object.DEVICE_TYPE, 0)
            time.sleep(0.002)  # a bus of 125 kbit/s carries this rate
        time.sleep(patience)
        nodes = sorted(node for node, index, _ in answers if index == objects.Object.DEVICE_TYPE)
        for node in nodes:
            for subindex, _ in _IDENTITY:
                _ask(network, node, objects.Object.IDENTITY, subindex)
                time.sleep(0.01)
        time.sleep(patience if nodes else 0.0)
    except can.CanError as error:
        raise InputError(f"fails: {error}", where="bus", remedy="look at its wiring and power") from None
    finally:
        with contextlib.suppress(can.CanError):
            network.disconnect()
    return {
        str(node): {"device_type": answers[node, int(objects.Object.DEVICE_TYPE), 0]}
        | {
            name: answers[node, int(objects.Object.IDENTITY), subindex]
            for subindex, name in _IDENTITY
            if (node, int(objects.Object.IDENTITY), subindex) in answers
        }
        for node in nodes
    }


def _ask(network: LoggedNetwork, node: int, index: int, subindex: int) -> None:
    request = bytes([0x40]) + int(index).to_bytes(2, "little") + bytes([subindex]) + bytes(4)
    network.send_message(0x600 + node, request)


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
