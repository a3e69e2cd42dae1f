"""Simulated drives whose processes all share one processor: nobody waits there for one that is not given its turn."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from rfdropo_bayes.deployment.clock import real_time

PATIENCE = 60.0  # [s]: the processes need six to import what they need

PLANTS = """
import threading, time
from rfdropo_bayes.deployment.bench.plant import SpringCables

def with_threads(robot):
    # As numerical libraries have them.
    for _ in range(20):
        threading.Thread(target=threading.Event().wait, daemon=True).start()
    return SpringCables(robot)

class Slow(SpringCables):
    # Twice as slow as real time.
    def advance(self, length, duration):
        end = time.monotonic() + 0.02
        while time.monotonic() < end:
            pass
        return super().advance(length, duration)
"""

SERVE = """
import contextlib, os, sys
from pathlib import Path
import psutil
from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bus import BusTable, LoggedNetwork, open_bus
from rfdropo_bayes.deployment.drives import drives_of
from rfdropo_bayes.deployment.bench.simulated_bus import SimulationTable, simulated_drives
from rfdropo_bayes.robots import Robot

os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # here: a fork before it would copy what JAX holds
plant, own_process = sys.argv[1], sys.argv[2] == "own"
hub = BusTable(interface="hub", channel="127.0.0.1:0")
with simulated_drives(SimulationTable("motor_arm", hub, plant, own_process=own_process)) as found:
    network = LoggedNetwork(open_bus(found))
    (drive,) = drives_of(network, Robot.load("motor_arm").motors[:1], [0.0], str(objects.SIMULATED_EDS), 10.0)
    print("type", drive.read(objects.Object.DEVICE_TYPE), flush=True)
    network.disconnect()
    for process in psutil.Process().children(recursive=True):  # as a task manager does
        for entry in Path(f"/proc/{process.pid}/task").glob("*/*"):
            with contextlib.suppress(OSError):
                if entry.name in ("stat", "status", "comm"):
                    entry.read_bytes()
print("ended", flush=True)
"""


@pytest.fixture(autouse=True)
def permitted() -> None:
    """Skip where the system gives no real-time priority: without it everyone gets a turn."""
    with real_time() as granted:
        if not granted:
            pytest.skip("the system does not permit SCHED_FIFO")


def serve_on_one_processor(folder: Path, plant: str, where: str) -> str:
    """What a master says that starts drives, asks one, and ends them, all on one processor."""
    (folder / "plants_for_test.py").write_text(PLANTS)
    path = os.pathsep.join([str(folder), *filter(None, sys.path)])
    command = [sys.executable, "-c", SERVE, f"plants_for_test:{plant}", where]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": path})
    try:
        return process.communicate(timeout=PATIENCE)[0]
    except subprocess.TimeoutExpired:
        everyone = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
        for other in everyone:
            # One that spins in the kernel lets go, and can be ended.
            os.sched_setscheduler(other.pid, os.SCHED_OTHER, os.sched_param(0))
        for other in everyone:
            other.kill()
        process.communicate()
        pytest.fail(f"after {PATIENCE:g} s they have not ended")


@pytest.mark.parametrize(
    ("plant", "where"),
    [
        # Linux clears the threads of an ended process out of /proc, and whoever waits for the process helps.
        pytest.param("with_threads", "own", marks=pytest.mark.slow),
        pytest.param("Slow", "here", marks=pytest.mark.slow),
    ],
)
def test_drives_on_one_processor_answer_and_end(tmp_path: Path, plant: str, where: str) -> None:
    said = serve_on_one_processor(tmp_path, plant, where)
    assert said.split() == ["type", str(0x00020192), "ended"]
