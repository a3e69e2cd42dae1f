"""The master against a slave of another maker: the npm package `canopen` (CiA 301, JavaScript) behind our hub.

`peer/package.json` pins it; npm installs it once into pytest's cache. Needs Node.js and a package registry.
"""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bench.hub import HubBus
from rfdropo_bayes.deployment.bus import LoggedNetwork
from rfdropo_bayes.deployment.cia402 import Controlword, DriveState, controlword_towards
from rfdropo_bayes.deployment.drives import Drives, Guards, Identity, drives_of
from rfdropo_bayes.deployment.objects import Nmt, NmtState, Object
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot

pytestmark = pytest.mark.slow

PEER = Path(__file__).with_name("peer")
NODE = 1


@pytest.fixture(scope="module")
def program(request: pytest.FixtureRequest) -> Path:
    """The slave's program with its package beside it."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("Node.js and npm are not installed")
    folder = Path(request.config.cache.mkdir("canopen_peer"))
    for name in ("package.json", "peer.js"):
        shutil.copy(PEER / name, folder / name)
    if not (folder / "node_modules" / "canopen").is_dir():
        # Its one native dependency computes the checksum of block transfers, which nobody here sends.
        command = ["npm", "install", "--ignore-scripts", "--no-audit", "--no-fund"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"npm cannot install the package canopen: {done.stderr.strip().splitlines()[-1:]}")
    return folder / "peer.js"


@pytest.fixture
def drives(program: Path, robot: Robot, tcp_hub: str) -> Iterator[Drives]:
    """One drive of ours on the other maker's slave."""
    host, port = tcp_hub.split(":")
    command = ["node", str(program), host, port, str(NODE), str(objects.SIMULATED_EDS)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        network = LoggedNetwork(HubBus(tcp_hub))
        motor = robot.motors[0].model_copy(update={"rated_torque_n_m": 0.1})
        yield Drives(
            network, drives_of(network, [motor], [0.0], str(objects.SIMULATED_EDS)), Guards(master_timeout_s=5.0)
        )
        network.disconnect()
        process.kill()


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


def bring(drives: Drives, target: DriveState) -> None:
    (drive,) = drives.all
    for _ in range(12):
        if drive.state is not None:
            drive.controlword = controlword_towards(drive.state, target, drive.controlword)
        assert drives.exchange(1.0)
        if drive.state is target:
            return
    raise AssertionError(drive.state)


def test_objects_of_every_size_are_read_and_written(drives: Drives) -> None:
    (drive,) = drives.all
    found = drive.check(Identity(product=0x52464401))
    assert found["modes"] == 0x80
    for index, subindex, value in (
        (Object.MODE, 0, -3),  # one byte, signed
        (Object.ABORT_CONNECTION, 0, 3),  # two, signed
        (Object.PRODUCER_HEARTBEAT, 0, 250),  # two
        (Object.POSITION_LIMIT, 1, -123456),  # four, signed
        (Object.CONSUMER_HEARTBEAT, 1, 0x007F0032),  # four
    ):
        drive.write(index, value, subindex)
        assert drive.read(index, subindex) == value


def test_aborts_are_told_with_their_object(drives: Drives) -> None:
    (drive,) = drives.all
    with pytest.raises(InputError, match="object 0x6041:0: does not take 1"):
        drive.write(Object.STATUSWORD, 1)


def test_mapping_states_set_points_and_status(drives: Drives) -> None:
    (drive,) = drives.all
    drives.configure(0.01, lambda text: None)
    bring(drives, DriveState.OPERATION_ENABLED)
    for target in (0, 1, -1, 2**31 - 1, -(2**31), 25_000):
        drive.target = target
        assert drives.exchange(1.0)
        assert drives.exchange(1.0)  # this slave applies a set-point when it comes, and samples on SYNC
        assert drive.reading is not None
        assert drive.reading.position == target
    bring(drives, DriveState.SWITCH_ON_DISABLED)


def test_every_state_is_reached_and_left(drives: Drives) -> None:
    drives.configure(0.01, lambda text: None)
    for state in (
        DriveState.READY_TO_SWITCH_ON,
        DriveState.OPERATION_ENABLED,
        DriveState.SWITCHED_ON,
        DriveState.SWITCH_ON_DISABLED,
    ):
        bring(drives, state)


def test_the_quick_stop_needs_no_sync_and_stays(drives: Drives) -> None:
    (drive,) = drives.all
    drives.configure(0.01, lambda text: None)
    bring(drives, DriveState.OPERATION_ENABLED)
    assert drives.quick_stop() == []
    until(lambda: drive.read(Object.STATUSWORD) & 0x6F == 0x07)
    drive.controlword = int(Controlword.ENABLE_OPERATION)
    for _ in range(5):
        assert drives.exchange(1.0)
    assert drive.state is DriveState.QUICK_STOP_ACTIVE


def test_emergencies_faults_and_their_reset(drives: Drives) -> None:
    (drive,) = drives.all
    drives.configure(0.01, lambda text: None)
    bring(drives, DriveState.OPERATION_ENABLED)
    drive.write(Object.SIMULATED_FAULT, 4, read_back=False)
    until(lambda: len(drives.emergencies) > 0)
    assert drives.emergencies[0].code == 0x2310
    assert drives.exchange(1.0)
    assert drive.state is DriveState.FAULT
    bring(drives, DriveState.OPERATION_ENABLED)  # through the reset, with its rising edge


def test_heartbeats_and_network_management(drives: Drives) -> None:
    (drive,) = drives.all
    drives.configure(0.01, lambda text: None)
    assert drive.node.nmt == NmtState.OPERATIONAL
    drives.manage(Nmt.PRE_OPERATIONAL)
    until(lambda: drive.node.nmt == NmtState.PRE_OPERATIONAL)
    assert not drives.exchange(0.2)  # no process data in this state
    drives.manage(Nmt.START)
    until(lambda: drive.node.nmt == NmtState.OPERATIONAL)
    assert drives.exchange(1.0)
    before = drive.node.heartbeat
    until(lambda: drive.node.heartbeat > before)
