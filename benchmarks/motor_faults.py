"""What a session does about every fault it must survive, on simulated drives: one row per fault.

    python benchmarks/motor_faults.py [--case NAME] [--json FILE]

Three processes a case: the drives, the session, and this one, which is an observer on the same bus. It reads statusword
and position of every drive by SDO, some hundred times a second, whatever the session does. The fault is set off half a
second into the policy's motion. "Safe" is the time from the fault until every drive that still lives is seen at rest
and braked, faulted or without power, and stays so; where the session slows its set-points down instead, the drives hold
enabled for a while before they brake. "Beyond" is how far any cable was seen outside the limits of its motor.

Sessions that must be refused have no time: their drives are never powered.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.deployment.bench.hub import HubBus
from rfdropo_bayes.deployment.bench.simulated_bus import SimulationTable, simulated_drives
from rfdropo_bayes.deployment.bench.simulated_node import SimulatedFault
from rfdropo_bayes.deployment.bus import BusTable
from rfdropo_bayes.deployment.cia402 import DriveState, state_of
from rfdropo_bayes.deployment.objects import Object
from rfdropo_bayes.deployment.policy import METADATA
from rfdropo_bayes.deployment.sensors import Sighting, SimulatedMarkers
from rfdropo_bayes.deployment.session import deploy
from rfdropo_bayes.deployment.settings import Deployment, DrivesTable, SafetyTable
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.policy_layout import ObservationPart, PolicyLayout

ROBOT = "motor_arm"
ALLOWED = 0.1  # [s]
ONSET = 0.5  # [s] of motion before the fault
STILL = 5e-5  # [m]: nearer to where it comes to rest than this, a cable rests
VICTIM = 2  # node of the drive that fails
SAFE = {DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT, DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON}


class Case(NamedTuple):
    """A fault: the cause that the log must name, who sets it off, and what it is."""

    cause: str
    by: str  # "drive": object 0x2F00; "bus", "policy", "sensor", "settings": inside the session; "outside"
    what: Any
    dead: tuple[int, ...] = ()
    bounded: bool = True  # False where the fault shows only after the robot has moved
    ramp: bool = False  # True where the set-points come to rest first, and the drives hold enabled


CASES: dict[str, Case] = {
    "master killed": Case("", "outside", signal.SIGKILL),
    "drive killed": Case("stale_status", "drive", SimulatedFault.CRASH, dead=(VICTIM,)),
    "drive reboots": Case("node_state", "drive", SimulatedFault.REBOOT),
    "SYNC lost": Case("stale_status", "bus", "drop SYNC"),
    "drive's heartbeat lost": Case("heartbeat_lost", "drive", SimulatedFault.NO_HEARTBEAT),
    "master's heartbeat lost": Case("emergency_message", "bus", "drop heartbeat"),
    "TPDO stale": Case("stale_status", "drive", SimulatedFault.NO_TPDO),
    "EMCY and fault": Case("emergency_message", "drive", SimulatedFault.OVER_CURRENT),
    "short TPDO": Case("short_frame", "drive", SimulatedFault.SHORT_TPDO),
    "short RPDO": Case("emergency_message", "bus", "short RPDO"),
    "one send error": Case("send_error", "bus", "one send error"),
    "bus lost": Case("send_error", "bus", "all sends fail"),
    "reception fails": Case("send_error", "bus", "recv raises"),
    "motor jammed": Case("following_error", "drive", SimulatedFault.JAMMED, bounded=False),
    "status frozen": Case("following_error", "drive", SimulatedFault.FROZEN_STATUS, bounded=False),
    "NaN action": Case("action_not_finite", "policy", "nan", ramp=True),
    "action outside limits": Case("action_outside", "policy", "outside", ramp=True),
    "policy fails": Case("policy_failed", "policy", "raise", ramp=True),
    "markers lost": Case("markers_lost", "sensor", "lost", ramp=True),
    "deadline storm": Case("deadlines_missed", "sensor", "slow"),
    "control loop hangs": Case("deadlines_missed", "policy", "hang"),
    "emergency stop, signal": Case("emergency_stop", "outside", signal.SIGINT),
    "emergency stop, button": Case("emergency_stop", "button", None),
    "wrong EDS": Case("refused", "settings", "eds"),
    "wrong drive": Case("refused", "settings", "product"),
    "wrong node": Case("refused", "settings", "node"),
}


class Row(NamedTuple):
    """What was seen: seconds to safety (None for a refusal), cause in the log, metres beyond a limit, verdict."""

    case: str
    safe_s: float | None
    cause: str
    beyond_m: float
    states: str
    passed: bool


class Observer:
    """Reads statusword and position of every drive by SDO, on a connection of its own."""

    def __init__(self, channel: str) -> None:
        self.robot = Robot.load(ROBOT)
        self._bus = HubBus(channel)
        self._done = threading.Event()
        self.seen: list[tuple[float, int, DriveState | None, float]] = []  # time, node, state, length
        self._thread = threading.Thread(target=self._run, daemon=True)

    def begin(self) -> None:
        """Look on, but not while the session configures: two SDO clients of one node disturb each other."""
        if not self._thread.is_alive():
            self._thread.start()

    def _read(self, node: int, index: int) -> int | None:
        self._bus.send(can.Message(arbitration_id=0x600 + node, data=_upload(index), is_extended_id=False))
        end = time.monotonic() + 0.02
        while (left := end - time.monotonic()) > 0.0:
            message = self._bus.recv(left)
            if message is not None and message.arbitration_id == 0x580 + node:
                data = bytes(message.data)
                if data[0] & 0xE3 == 0x43 and data[1:3] == struct.pack("<H", index):
                    return int.from_bytes(data[4 : 8 - (data[0] >> 2 & 3)], "little", signed=index == Object.POSITION)
        return None

    def _run(self) -> None:
        while not self._done.is_set():
            for motor in self.robot.motors:
                word, counts = self._read(motor.node, Object.STATUSWORD), self._read(motor.node, Object.POSITION)
                if word is not None and counts is not None:
                    self.seen.append((time.monotonic(), motor.node, state_of(word), motor.length(counts, 0)))
            time.sleep(0.002)

    def request(self, node: int, fault: SimulatedFault) -> float:
        """Set off a fault; returns when."""
        at = time.monotonic()
        bus = HubBus(self._bus.channel_info.removeprefix("hub at "))
        data = struct.pack("<BHBBxxx", 0x2F, Object.SIMULATED_FAULT, 0, fault)
        bus.send(can.Message(arbitration_id=0x600 + node, data=data, is_extended_id=False))
        bus.shutdown()
        return at

    def close(self) -> None:
        """End."""
        self._done.set()
        self._thread.join()
        self._bus.shutdown()

    def safe_after(self, start: float, dead: tuple[int, ...], ramp: bool) -> float | None:
        """Seconds from ``start`` until every living drive is safe and stays so; None if one never is."""
        times = []
        for node in {motor.node for motor in self.robot.motors} - set(dead):
            mine = [row for row in self.seen if row[1] == node and row[0] >= start]
            if not mine or mine[-1][2] not in SAFE:
                return None
            rest = mine[-1][3]
            unsafe = [
                number
                for number, (_, _, state, length) in enumerate(mine)
                if abs(length - rest) > STILL or not (state in SAFE or (ramp and state is DriveState.OPERATION_ENABLED))
            ]
            times.append(mine[unsafe[-1] + 1][0] - start if unsafe else 0.0)
        return max(times)

    def beyond(self) -> float:
        """Greatest way of any cable outside its limits [m]."""
        limits = {motor.node: motor.length_limit_m for motor in self.robot.motors}
        return max(max(limits[node][0] - length, length - limits[node][1], 0.0) for _, node, _, length in self.seen)


def _upload(index: int) -> bytes:
    return struct.pack("<BHB4x", 0x40, index, 0)


# The session's process


class FaultyBus(can.BusABC):
    """A bus that does to frames what the case says, once ``armed``."""

    def __init__(self, inner: can.BusABC, what: str) -> None:
        self._inner, self._what, self.armed = inner, what, False
        self.channel_info = inner.channel_info
        super().__init__(channel=None)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send, or not."""
        if self.armed:
            if self._what == "drop SYNC" and msg.arbitration_id == objects.SYNC:
                return
            if self._what == "drop heartbeat" and msg.arbitration_id & 0x780 == objects.HEARTBEAT:
                return
            if self._what == "short RPDO" and msg.arbitration_id == objects.RPDO1 + VICTIM:
                msg = can.Message(arbitration_id=msg.arbitration_id, data=msg.data[:3], is_extended_id=False)
            if self._what in ("one send error", "all sends fail"):
                self.armed = self._what == "all sends fail"
                raise can.CanOperationError("the transmit buffer is full")
        self._inner.send(msg, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.armed and self._what == "recv raises":
            raise ValueError("a garbled line")  # as serial adapters do
        return self._inner._recv_internal(timeout)

    def shutdown(self) -> None:
        """Close."""
        super().shutdown()
        self._inner.shutdown()


class FaultySensor:
    """Markers that vanish, or take two and a half cycles to come, once ``armed``."""

    def __init__(self, inner: SimulatedMarkers, what: str) -> None:
        self._inner, self._what, self.armed = inner, what, False

    def latest(self) -> Sighting:
        """The newest frame; every marker lost where armed."""
        found = self._inner.latest()
        if self.armed and self._what == "slow":
            time.sleep(0.025)
            return found
        return found._replace(seen=np.zeros_like(found.seen)) if self.armed else found

    def close(self) -> None:
        """Close."""
        self._inner.close()


def session(name: str, channel: str, port: int, folder: Path) -> None:
    """Body of the session's process: says RUNNING and the time of the fault on its standard output."""
    from rfdropo_bayes.deployment.policy import OnnxPolicy

    case, robot = CASES[name], Robot.load(ROBOT)
    bus = FaultyBus(HubBus(channel), case.what if case.by == "bus" else "")
    sensor = FaultySensor(SimulatedMarkers(len(robot.marker_names), port), str(case.what))
    button = folder.parent / "button"

    class Policy(OnnxPolicy):
        started = 0.0
        struck = False

        def _run(self, observation: np.ndarray) -> np.ndarray:
            now = time.monotonic()
            if not self.started and hasattr(self, "_input"):
                self.started = now if np.any(observation) else 0.0
                if self.started:
                    print("RUNNING", flush=True)
            if self.started and now > self.started + ONSET and case.by in ("bus", "policy", "sensor", "button"):
                return self._strike(observation)
            return super()._run(observation)

        def _strike(self, observation: np.ndarray) -> np.ndarray:
            if not self.struck:
                self.struck = True
                print(f"FAULT {time.monotonic()}", flush=True)
                bus.armed, sensor.armed = case.by == "bus", case.by == "sensor"
                if case.by == "button":
                    button.write_text("0")
            if case.by == "policy":
                if case.what == "raise":
                    self._network = None
                if case.what == "hang":
                    time.sleep(1.5)
                if case.what in ("nan", "outside"):
                    return super()._run(observation) + (np.nan if case.what == "nan" else 1.0)
            return super()._run(observation)

    path = folder.parent / "policy.onnx"
    write_policy(path)
    button.write_text("1")
    settings = Deployment(
        robot=ROBOT,
        duration_s=4.0,
        drives=_drives_table(case, folder.parent),
        safety=SafetyTable(settle_s=0.1, following_error_m=0.001, following_time_s=0.02, button_file=str(button)),
    )
    source = Policy(path, robot, {})
    outcome = deploy(settings, "run", folder, bus=bus, sensor=sensor, commands=source)  # type: ignore[arg-type]
    print(f"ENDED {outcome.cause.word}", flush=True)


def _drives_table(case: Case, folder: Path) -> DrivesTable:
    if case.by != "settings":
        return DrivesTable(product=0x52464401)
    if case.what == "product":
        return DrivesTable(product=0x12345678)
    if case.what == "node":
        return DrivesTable(serial={Robot.load(ROBOT).channel_names[1]: 77})
    text = objects.SIMULATED_EDS.read_text()
    other = folder / "other.eds"  # of another drive of the same maker
    other.write_text(text.replace("ProductNumber=0x52464401", "ProductNumber=0x52464402"))
    return DrivesTable(eds=str(other))


def write_policy(path: Path) -> None:
    """A policy of one layer: cables move in a circle driven by what they did last (a rotation of the command)."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    robot = Robot.load(ROBOT)
    channels, markers = robot.channel_names, len(robot.marker_names)
    layout = PolicyLayout(
        task="circle",
        period_s=0.1,
        observation=(ObservationPart("commands", len(channels), "m"), ObservationPart("markers", 3 * markers, "m")),
        channels=channels,
        unit="m",
        kind="continuous",
        moves=((5e-3,) * len(channels),),
        low=(-0.03,) * len(channels),
        high=(0.03,) * len(channels),
    )
    turn = 0.4  # [rad] per act
    weight = np.zeros((layout.size, len(channels)))
    for a, b in ((0, 2), (1, 3)):
        weight[[a, a, b, b], [a, b, a, b]] = [np.cos(turn) - 1, np.sin(turn), -np.sin(turn), np.cos(turn) - 1]
    weight[-1, 0] = weight[-1, 1] = 0.002 / robot.marker_points()[-1, 2]  # sets it off, and keeps it going
    graph = helper.make_graph(
        [
            helper.make_node("MatMul", ["observation", "weight"], ["unclipped"]),
            helper.make_node("Clip", ["unclipped", "low", "high"], ["action"]),
        ],
        "circle",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, [None, layout.size])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, [None, len(channels)])],
        [
            numpy_helper.from_array(weight.astype(np.float32), "weight"),
            numpy_helper.from_array(np.float32(-5e-3), "low"),
            numpy_helper.from_array(np.float32(5e-3), "high"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {METADATA: layout.to_json()})
    onnx.save(model, str(path))


# The observer's process


def examine(name: str) -> Row:
    """Run one case."""
    case = CASES[name]
    with tempfile.TemporaryDirectory(prefix="rfdropo_") as scratch:
        markers = SimulatedMarkers(1)
        port = int(markers.address.rsplit(":", 1)[1])
        markers.close()
        table = SimulationTable(ROBOT, BusTable(interface="hub", channel="127.0.0.1:0"), markers=f"127.0.0.1:{port}")
        with simulated_drives(table) as bus:
            observer = Observer(bus.channel)
            folder = Path(scratch) / "session"
            try:
                fault = _run_session(name, case, bus.channel, port, folder, observer)
            finally:
                observer.close()
            cause = ""
            summary = folder / "summary.json"
            if summary.is_file():
                cause = json.loads(summary.read_text())["cause"]
        return _judge(name, case, observer, fault, cause)


def _run_session(name: str, case: Case, channel: str, port: int, folder: Path, observer: Observer) -> float | None:
    command = [sys.executable, __file__, "--session", name, channel, str(port), str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    fault: float | None = None
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if line.startswith("FAULT "):
                fault = float(line.split()[1])
            if line.startswith("RUNNING"):
                observer.begin()
            if line.startswith("RUNNING") and case.by in ("drive", "outside"):
                time.sleep(ONSET)
                if case.by == "drive":
                    fault = observer.request(VICTIM, case.what)
                else:
                    fault = time.monotonic()
                    os.kill(process.pid, case.what)
        process.wait(60.0)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    observer.begin()
    time.sleep(0.3)
    return fault


def _judge(name: str, case: Case, observer: Observer, fault: float | None, cause: str) -> Row:
    beyond = observer.beyond()
    last = {node: state for _, node, state, _ in observer.seen if node not in case.dead}
    states = ", ".join(sorted({"-" if state is None else state.words for state in last.values()}))
    named = cause == case.cause
    if case.cause == "refused":
        powered = any(state is not None and state.powered for _, _, state, _ in observer.seen)
        return Row(name, None, cause, beyond, states, named and not powered)
    safe = None if fault is None else observer.safe_after(fault, case.dead, case.ramp)
    intime = safe is not None and (safe <= ALLOWED or not case.bounded)
    return Row(name, safe, cause, beyond, states, named and intime and beyond == 0.0)


def table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    lines = [
        "| fault | safe after [ms] | cause in the log | drives end in | beyond limits [mm] | |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        safe = (
            "never powered"
            if row.safe_s is None and row.cause == "refused"
            else "-"
            if row.safe_s is None
            else f"{1e3 * row.safe_s:.0f}"
        )
        cause = row.cause or "(killed)"
        lines.append(
            f"| {row.case} | {safe} | {cause} | {row.states} | {1e3 * row.beyond_m:.2f} | "
            f"{'ok' if row.passed else 'FAILED'} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the cases and print the table; status 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", action="append", choices=list(CASES))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--session", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.session:
        name, channel, port, folder = arguments.session
        try:
            session(name, channel, int(port), Path(folder))
        except InputError as error:
            print(f"ENDED refused: {error}", flush=True)
        return
    rows = []
    for name in arguments.case or CASES:
        rows.append(examine(name))
        print(f"  {name}: {'ok' if rows[-1].passed else 'FAILED'}", file=sys.stderr, flush=True)
    text = table(rows)
    print(text)
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps([row._asdict() for row in rows], indent=2) + "\n")
        arguments.json.with_suffix(".md").write_text(text + "\n")
    sys.exit(0 if all(row.passed for row in rows) else 1)


if __name__ == "__main__":
    main()
