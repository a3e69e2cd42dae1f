"""One session: check the drives, home them, run a policy on them, watch it in the shadow, or replay a recording."""

from __future__ import annotations

import contextlib
import json
import platform
import sys
import threading
from collections.abc import Mapping
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
import tomli_w
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from rfdropo_bayes import __version__
from rfdropo_bayes.data import GOAL_AXES, Trajectory
from rfdropo_bayes.deployment.bench.simulated_bus import SimulationTable, simulated_drives
from rfdropo_bayes.deployment.bus import BusTable, LoggedNetwork, open_bus
from rfdropo_bayes.deployment.causes import Cause, Stop
from rfdropo_bayes.deployment.clock import real_time, steady_interpreter
from rfdropo_bayes.deployment.drives import Drives, drives_of
from rfdropo_bayes.deployment.emergency import EmergencyStop, Hook, StopSignals, file_hook
from rfdropo_bayes.deployment.homing import Homing, homing_motors, homing_result, load_homing
from rfdropo_bayes.deployment.log import SCHEMA_VERSION, SESSION, SUMMARY, SessionLog, session_trajectory
from rfdropo_bayes.deployment.loop import ControlLoop, Phase, Snapshot
from rfdropo_bayes.deployment.policy import CommandSource, OnnxPolicy, RecordedCommands, pulls_too_hard, replay_rate
from rfdropo_bayes.deployment.sensors import MarkerSensor, MarkerView, SimulatedMarkers, open_sensor
from rfdropo_bayes.deployment.settings import Deployment, DrivesTable, load_deployment
from rfdropo_bayes.deployment.vendors import LEFT_OUT
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import write_text
from rfdropo_bayes.robots import Motor, Robot


class Mode(StrEnum):
    """Kind of a session.

    ``CHECK`` reads and writes nothing; ``HOME`` finds length zero; ``DRY_RUN`` is ``RUN`` on simulated drives;
    ``SHADOW`` runs the policy while nothing moves; ``REPLAY`` sends the commands of a recording again.
    """

    CHECK = "check"
    HOME = "home"
    DRY_RUN = "dry-run"
    SHADOW = "shadow"
    RUN = "run"
    REPLAY = "replay"


class Outcome(NamedTuple):
    """End of a session."""

    # cause, detail: reason of the end, and one line about it
    cause: Cause
    detail: str
    folder: Path  # folder with the session's files
    figures: dict[str, Any]  # lateness, misses, the policy's time, the time to a stop; as in summary.json
    drives: dict[str, dict[str, int]]  # identity of each drive as read at the check
    without: dict[str, list[str]]  # objects that each drive lacks, with the consequence of each

    @property
    def finished(self) -> bool:
        """Whether the session ended as planned."""
        return self.cause is Cause.FINISHED


def deploy(
    settings: Deployment | Path | str,
    mode: Mode | str,
    out: Path,
    *,
    simulated: bool = False,
    commands: CommandSource | Path | str | None = None,
    hooks: tuple[Hook, ...] = (),
    show: bool = False,
    keyboard: bool = False,
    bus: can.BusABC | None = None,
    sensor: MarkerSensor | None = None,
) -> Outcome:
    """Run one session.

    Args:
        settings: the deployment, or its file.
        mode: see `Mode`.
        out: folder for log, frames, recording and summary.
        simulated: use simulated drives in any mode; a dry run always does.
        commands: commands for `Mode.REPLAY`, as a session's folder or a trajectory file; or a source of commands that
            replaces the policy.
        hooks: each returns True while its emergency button is pressed.
        show: live view in the terminal.
        keyboard: keys of the terminal stop the drives.
        bus, sensor: replace the bus and sensor of the settings.

    Raises:
        InputError: if anything does not fit: a drive's identity, data sheet or mapping, units, rates, the policy's card
            or hash, the homing. No drive has been enabled then, and the log has the reason.
    """
    settings = load_deployment(Path(settings)) if isinstance(settings, Path | str) else settings
    mode = Mode(mode)
    robot = Robot.load(settings.robot)
    if not robot.motors:
        raise InputError("has no motors", where=f"robot {robot.name}", remedy="add [[motors]], one per channel")
    with contextlib.ExitStack() as stack:
        signals = stack.enter_context(StopSignals())
        hooks = (*hooks, signals.arrived)
        session = _Session(settings, mode, robot, Path(out), simulated or mode is Mode.DRY_RUN, stack)
        try:
            session.open(bus, sensor)
            session.prepare(commands)
            return session.run(hooks, show, keyboard)
        except (InputError, can.CanError) as error:
            session.log.event("refused", str(error))
            session.summarise("refused", str(error), {})
            if isinstance(error, InputError):
                raise
            raise InputError(f"the bus fails: {error}", where="bus", remedy="look at its wiring and power") from None


class _Session:
    """State of one `deploy` call, with a stack that closes all open resources."""

    def __init__(
        self, settings: Deployment, mode: Mode, robot: Robot, out: Path, simulated: bool, stack: contextlib.ExitStack
    ) -> None:
        self.settings, self.mode, self.robot, self.out = settings, mode, robot, out
        self.simulated, self._stack = simulated, stack
        self.period = 1.0 / settings.rate_hz
        self._facts: dict[str, Any] = {"mode": mode.value, "simulated": simulated, "rate_hz": settings.rate_hz}
        self.identities: dict[str, dict[str, int]] = {}
        self.without: dict[str, list[str]] = {}
        self.source: CommandSource | None = None
        settings.drives.check_serial(robot.channel_names)
        self._load_policy()
        self.offsets = self._offsets()
        self.log = SessionLog(out, robot, self._facts)
        stack.callback(self.log.close)
        if "warning" in self._facts:
            self.log.event("warning", self._facts["warning"])
            print(f"warning: {self._facts['warning']}", file=sys.stderr, flush=True)
        content = settings.model_dump(mode="json", exclude_none=True)
        (out / "config.toml").write_text(tomli_w.dumps({"mode": mode.value} | content), encoding="utf-8")

    def _load_policy(self) -> None:
        """Before anything is opened: a policy that does not fit is refused without a drive having been touched."""
        settings = self.settings
        if settings.policy is not None and self.mode in (Mode.CHECK, Mode.RUN, Mode.DRY_RUN, Mode.SHADOW):
            policy = OnnxPolicy(
                Path(settings.policy.file), self.robot, settings.goal, settings.policy.sha256, settings.policy.markers
            )
            self._facts["policy_sha256"] = policy.sha256
            warning = pulls_too_hard(policy.pull, self.robot.motors)
            self._facts |= {} if warning is None else {"warning": warning}
            if policy.sees_object:
                self._facts[GOAL_AXES] = np.delete(np.arange(3), np.argmax(np.abs(self.robot.gravity))).tolist()
            self.source = policy

    def _offsets(self) -> list[float]:
        table = self.settings.homing
        if table.file is None or self.simulated or self.mode in (Mode.HOME, Mode.CHECK):
            return [float(motor.offset_counts) for motor in self.robot.motors]
        result = load_homing(Path(table.file), self.robot)
        self._facts["homed"] = result.date.isoformat()
        return [float(home.offset_counts) for home in result.homes]

    def open(self, bus: can.BusABC | None, sensor: MarkerSensor | None) -> None:
        """Start the simulation if needed; open sensor, bus and drives."""
        settings, sensor_table = self.settings, self.settings.sensor
        bus_table, identity = settings.bus, settings.drives
        if self.simulated:
            sensor = sensor or SimulatedMarkers(len(self.robot.marker_names))
            identity = DrivesTable(product=0x52464401, answer_s=identity.answer_s)
            if bus is None:
                bus_table = self._stack.enter_context(simulated_drives(self._simulation(sensor)))
        self.sensor = sensor if sensor is not None else open_sensor(sensor_table, self.robot)
        self._stack.callback(self.sensor.close)
        opened = open_bus(bus_table) if bus is None else bus
        self.network = LoggedNetwork(opened, self.log.frames)
        self._stack.callback(self._leave)
        receivers = [thread.native_id for thread in self.network.receivers if thread.native_id is not None]
        self._stack.enter_context(real_time(threads=receivers))
        motors = self._motors()
        guards = settings.safety.guards([motor.node for motor in motors])
        drives = drives_of(
            self.network, motors, self.offsets, identity.eds, identity.answer_s, identity.units, identity.unguarded
        )
        self.drives = Drives(self.network, drives, guards)
        for drive in drives:
            self.identities[drive.motor.channel] = drive.check(
                identity.identity(drive.motor.channel), identity.check_eds
            )
            self.log.event("checked", drive.name, **self.identities[drive.motor.channel])
            self.without[drive.motor.channel] = [f"0x{index:04X}: {LEFT_OUT[index]}" for index in drive.lacking()]
        if self.mode is Mode.HOME:
            for drive in drives:
                drive.offset = float(self.identities[drive.motor.channel]["position"])

    def _motors(self) -> list[Motor]:
        motors = list(self.robot.motors)
        return homing_motors(motors, self.settings.homing) if self.mode is Mode.HOME else motors

    def _simulation(self, sensor: MarkerSensor) -> SimulationTable:
        address = sensor.address if isinstance(sensor, SimulatedMarkers) else ""
        table = self.settings.simulation
        hub = BusTable(interface="hub", channel="127.0.0.1:0")
        return SimulationTable(self.settings.robot, hub, table.plant, table.settings, table.own_process, address)

    def _leave(self) -> None:
        with contextlib.suppress(can.CanError):
            self.network.disconnect()

    def prepare(self, commands: CommandSource | Path | str | None) -> None:
        """Find the source of commands, and configure the drives unless they are only checked."""
        if commands is not None and not isinstance(commands, Path | str):
            self.source = commands
        elif self.mode is Mode.REPLAY:
            if commands is None:
                raise InputError("names no recording", where="replay", remedy="give one with --recording")
            path = Path(commands)
            trajectory = session_trajectory(path, (Phase.RUNNING,)) if path.is_dir() else Trajectory.load(path)
            again = RecordedCommands(trajectory, self.robot, replay_rate(trajectory, self.settings.rate_hz))
            if again.last_s >= self.settings.duration_s:
                limit = f"duration_s = {self.settings.duration_s:g} s ends the replay before"
                self.log.event(
                    "note", f"the last command of {trajectory.name} comes after {again.last_s:.4g} s; {limit}"
                )
            self.source = again
        if self.source is None and self.mode not in (Mode.CHECK, Mode.HOME):
            raise InputError("names no policy", where="deployment", remedy="add [policy] file")
        if self.source is not None:
            cycles = self.settings.rate_hz / self.source.rate_hz
            if abs(cycles - round(cycles)) > 1e-6 or cycles < 1.0:
                raise InputError(
                    f"{self.source.rate_hz:g} Hz of the policy does not divide {self.settings.rate_hz:g} Hz",
                    where="rate_hz",
                    remedy="choose a multiple of the policy's rate",
                )
            seen = self.settings.sensor
            if self.source.sees_object and seen.kind == "natnet" and seen.object_body is None and not self.simulated:
                remedy = "give the identifier of its rigid body"
                raise InputError(
                    "the policy observes an object, but no sensor measures one",
                    where="sensor.object_body",
                    remedy=remedy,
                )
        if self.mode is not Mode.CHECK:
            self.drives.configure(self.period, lambda text: self.log.event("note", text))

    def run(self, hooks: tuple[Hook, ...], show: bool, keyboard: bool) -> Outcome:
        """Run the phases of the mode in their own thread, with the emergency stop beside it."""
        if self.mode is Mode.CHECK:
            return self._outcome(Stop(Cause.FINISHED, "nothing was written"), None)
        safety = self.settings.safety
        markers = MarkerView(self.sensor, self.settings.sensor, self.robot.marker_names)
        loop = ControlLoop(
            self.robot, self.drives, markers, self.log, safety, self.period, lambda text: self.log.event("stop", text)
        )
        if safety.button_file is not None:
            hooks = (*hooks, file_hook(Path(safety.button_file)))

        def press(what: str, silence: bool) -> None:
            loop.demanded = Stop(Cause.DEADLINES if silence else Cause.EMERGENCY_STOP, what)
            failures = self.drives.quick_stop()
            self.log.event("pressed", what, failures=failures)

        homing = Homing(self.settings.homing)
        phases = homing if self.mode is Mode.HOME else self._phases
        ended: list[Stop] = []

        def body() -> None:
            with real_time() as granted:
                if not granted:
                    self.log.event("note", "no real-time scheduling: the system does not permit SCHED_FIFO")
                ended.append(loop.run(phases))

        patience = (safety.misses + 1.5) * self.period
        with steady_interpreter(), EmergencyStop(press, hooks, lambda: loop.pulse, patience, keyboard):
            thread = threading.Thread(target=body, name="control loop")
            thread.start()
            self._wait(thread, loop, show)
        stop = ended[0]
        if self.mode is Mode.HOME and stop.cause is Cause.FINISHED:
            self._keep_homing(homing)
        return self._outcome(stop, loop)

    def _wait(self, thread: threading.Thread, loop: ControlLoop, show: bool) -> None:
        live = Live(refresh_per_second=4) if show else None
        with live or contextlib.nullcontext():
            while thread.is_alive():
                thread.join(0.2)
                if live is not None:
                    live.update(session_table(loop.snapshot, self.mode.value))

    def _phases(self, loop: ControlLoop) -> None:
        assert self.source is not None
        if self.mode is Mode.SHADOW:
            loop.find()
            loop.follow(self.source, self.settings.duration_s, Phase.SHADOW)
            return
        loop.enable()
        start = self.source.start * loop.scale
        loop.go_to(start, Phase.STARTING, self.settings.safety.settle_s)
        loop.follow(self.source, self.settings.duration_s)

    def _keep_homing(self, homing: Homing) -> None:
        result = homing_result(self.robot, homing)
        result.save(Path(self.settings.homing.file or self.out / "homing.json"))
        for home in result.homes:
            self.log.event("homed", home.channel, offset_counts=home.offset_counts, tension_n=home.tension_n)

    def _outcome(self, stop: Stop, loop: ControlLoop | None) -> Outcome:
        self.log.flush()
        figures = {} if loop is None else _figures(loop, self.period)
        if loop is not None:
            self._write_recording(stop)
        self.summarise(stop.cause.word, stop.detail, figures)
        return Outcome(stop.cause, stop.detail, self.out, figures, self.identities, self.without)

    def _write_recording(self, stop: Stop) -> None:
        running = (Phase.RUNNING, Phase.STOPPING, Phase.HOLDING, Phase.BRAKED, Phase.SHADOW)
        try:
            trajectory = session_trajectory(self.out, running if self.mode is not Mode.HOME else None)
            trajectory.with_attributes(settings={"cause": stop.cause.word}).save(self.out / SESSION)
        except InputError as error:
            self.log.event("note", f"no {SESSION}: {error}")

    def summarise(self, cause: str, detail: str, figures: Mapping[str, Any]) -> None:
        """Write summary.json."""
        names = ("canopen", "python-can", "onnxruntime", "numpy")
        content = {
            "mode": self.mode.value,
            "robot": self.robot.name,
            "cause": cause,
            "detail": detail,
            "facts": self._facts,
            "figures": dict(figures),
            "drives": self.identities,
            "without": self.without,
            "versions": {"rfdropo_bayes": __version__, "python": platform.python_version()}
            | {name: metadata.version(name) for name in names},
            "schema_version": SCHEMA_VERSION,
        }
        write_text(self.out / SUMMARY, json.dumps(content, indent=2) + "\n")


def _figures(loop: ControlLoop, period: float) -> dict[str, Any]:
    late, acts = np.array(loop.lateness or [0.0]), np.array(loop.act_times or [0.0])
    return {
        "cycles": len(loop.lateness),
        "period_s": period,
        "lateness_s": {"p50": _at(late, 50), "p99": _at(late, 99), "max": float(late.max())},
        "missed": loop.watch.missed,
        "act_s": {"p50": _at(acts, 50), "p99": _at(acts, 99), "max": float(acts.max())},
        "stop_s": loop.stop_time,
    }


def _at(values: np.ndarray, percent: float) -> float:
    return float(np.percentile(values, percent))


def session_table(snapshot: Snapshot, mode: str) -> Table:
    """Cycle time, states, set-points, tensions, misses and time left."""
    phase = "-" if snapshot.phase is None else snapshot.phase.name.lower()
    title = (
        f"{mode}: {phase}, {snapshot.left:.1f} s left, late {1e3 * snapshot.lateness:.2f} ms, "
        f"missed {snapshot.missed}, policy {1e3 * snapshot.act_time:.2f} ms. Any of space, Enter, Esc, q stops."
    )
    table = Table(title=title, title_justify="left")
    for column in ("channel", "node", "state", "set-point [mm]", "actual [mm]", "tension [N]"):
        table.add_column(column, justify="left" if column in ("channel", "state") else "right")
    for drive, length in zip(snapshot.drives, snapshot.set_point, strict=True):
        axis = f" axis {drive.motor.axis}" if drive.motor.axis > 1 else ""
        node = f"{drive.motor.node}{axis}"
        if drive.reading is None:
            table.add_row(escape(drive.motor.channel), node, "silent", "", "", "")
            continue
        state = drive.state
        limit = drive.motor.tension_limit_n[1]
        tension = f"{drive.tension:.2f}"
        table.add_row(
            escape(drive.motor.channel),
            node,
            "unknown" if state is None else state.words,
            f"{1e3 * length:.2f}",
            f"{1e3 * drive.length:.2f}",
            f"[red]{tension}[/red]" if drive.tension > 0.8 * limit else tension,
        )
    return table
