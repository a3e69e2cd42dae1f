"""Punctuality of a session on 4 and 8 simulated drives, with the idle jitter of the same machine beside it.

    python benchmarks/motors.py [--seconds S] [--json FILE] [--ordinary]

Each session runs a 64 x 64 ONNX policy at 10 Hz on a set-point loop at 100 Hz; drives, hub and session are processes of
their own. Before and after it an idle loop of the same rate is timed; the median of its runs stands beside. Columns:
deadlines missed by more than a cycle; lateness of the loop; time from SYNC to the last drive's status; lag of the
measured length behind the set-point where it moves (one cycle of it is the set-point's own: it says where to be at the
next SYNC); time of the policy, observation included. `--ordinary` leaves real-time scheduling out, to see what it is
worth.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rfdropo_bayes.deployment import clock, session
from rfdropo_bayes.deployment.clock import measure_jitter
from rfdropo_bayes.deployment.drives import Drives
from rfdropo_bayes.deployment.log import read_journal
from rfdropo_bayes.deployment.loop import Phase
from rfdropo_bayes.deployment.policy import METADATA
from rfdropo_bayes.deployment.settings import Deployment, PolicyTable
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.policy_layout import ObservationPart, PolicyLayout

ROBOTS = ("motor_arm", "motor_trunk")
PERIOD = 0.01  # [s]
IDLE_RUNS, IDLE_SECONDS = 5, 2.0
PERCENTILES = (50, 99, 100)


def write_policy(path: Path, robot: Robot, width: int = 64) -> None:
    """Two hidden layers, and beside them a rotation of the command, so that all cables stay in motion."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    channels, half = robot.channel_names, len(robot.channel_names) // 2
    markers = len(robot.marker_names)
    layout = PolicyLayout(
        task="circles",
        period_s=0.1,
        observation=(ObservationPart("commands", len(channels), "m"), ObservationPart("markers", 3 * markers, "m")),
        channels=channels,
        unit="m",
        kind="continuous",
        moves=((0.01,) * len(channels),),
        low=(-0.03,) * len(channels),
        high=(0.03,) * len(channels),
    )
    random, turn, circle = np.random.default_rng(0), 0.4, np.zeros((layout.size, len(channels)))
    for one in range(half):
        rows, other = [one, one, one + half, one + half], one + half
        circle[rows, [one, other] * 2] = [np.cos(turn) - 1, np.sin(turn), -np.sin(turn), np.cos(turn) - 1]
    sizes = (layout.size, width, width, len(channels))
    arrays = {f"w{k}": random.normal(size=sizes[k : k + 2]) / np.sqrt(sizes[k]) for k in range(3)}
    arrays |= {"circle": circle, "scale": np.array(1e-4), "push": np.full(len(channels), 2e-3)}
    node = helper.make_node
    nodes = [
        node("MatMul", ["observation", "w0"], ["p0"]),
        node("Tanh", ["p0"], ["h0"]),
        node("MatMul", ["h0", "w1"], ["p1"]),
        node("Tanh", ["p1"], ["h1"]),
        node("MatMul", ["h1", "w2"], ["p2"]),
        node("Mul", ["p2", "scale"], ["little"]),
        node("MatMul", ["observation", "circle"], ["round"]),
        node("Add", ["round", "push"], ["pushed"]),
        node("Add", ["pushed", "little"], ["action"]),
    ]
    values = [numpy_helper.from_array(array.astype(np.float32), name) for name, array in arrays.items()]
    shapes = (("observation", layout.size), ("action", len(channels)))
    ends_of_graph = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [None, size]) for name, size in shapes]
    graph = helper.make_graph(nodes, "circles", ends_of_graph[:1], ends_of_graph[1:], values)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {METADATA: layout.to_json()})
    onnx.save(model, str(path))


class TimedDrives(Drives):
    """Drives that note how long each exchange takes."""

    times: ClassVar[list[float]] = []

    def exchange(self, timeout: float, meanwhile: Callable[[], None] | None = None) -> bool:
        """As ever, timed."""
        start = time.monotonic()
        complete = super().exchange(timeout, meanwhile)
        self.times.append(time.monotonic() - start)
        return complete


def idle() -> dict[str, Any]:
    """Median of the idle runs."""
    runs = [measure_jitter(PERIOD, IDLE_SECONDS) for _ in range(IDLE_RUNS)]
    median = {str(p): float(np.median([np.percentile(run.lateness, p) for run in runs])) for p in PERCENTILES}
    return {"lateness_s": median, "missed": int(np.median([run.missed for run in runs])), "real_time": runs[0].fifo}


def percentiles(values: np.ndarray) -> dict[str, float]:
    """Median, 99th percentile and greatest."""
    return {str(p): float(np.percentile(values, p)) for p in PERCENTILES}


def measure(name: str, seconds: float) -> dict[str, Any]:
    """One session."""
    robot = Robot.load(name)
    TimedDrives.times.clear()
    session.Drives = TimedDrives  # type: ignore[misc]
    before = idle()
    with tempfile.TemporaryDirectory(prefix="rfdropo_") as scratch:
        policy = Path(scratch) / "policy.onnx"
        write_policy(policy, robot)
        settings = Deployment(robot=name, duration_s=seconds, policy=PolicyTable(file=str(policy)))
        outcome = session.deploy(settings, "dry-run", Path(scratch) / "session")
        rows = read_journal(Path(scratch) / "session")[1]
    after = idle()
    rows = rows[rows["phase"] == Phase.RUNNING]
    rate = np.diff(rows["set_point"], axis=0) / PERIOD
    lag = (rows["set_point"][1:] - rows["length"][1:])[np.abs(rate) > 0.01] / rate[np.abs(rate) > 0.01]
    return {
        "robot": name,
        "drives": len(robot.motors),
        "seconds": seconds,
        "cause": outcome.cause.word,
        "detail": outcome.detail,
        "cycles": outcome.figures["cycles"],
        "missed": outcome.figures["missed"],
        "lateness_s": percentiles(rows["lateness"]),
        "answer_s": percentiles(np.array(TimedDrives.times)),
        "lag_s": percentiles(lag),
        "act_s": {
            "50": outcome.figures["act_s"]["p50"],
            "99": outcome.figures["act_s"]["p99"],
            "100": outcome.figures["act_s"]["max"],
        },
        "idle_before": before,
        "idle_after": after,
    }


def triple(values: dict[str, float]) -> str:
    """Median / p99 / greatest, in ms."""
    return " / ".join(f"{1e3 * values[str(p)]:.2f}" for p in PERCENTILES)


def table(rows: list[dict[str, Any]]) -> str:
    """The sessions as Markdown."""
    lines = [
        "| drives | cycles | missed | late [ms] | idle, late | SYNC to status [ms] | lag [ms] | policy [ms] | end |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        quiet = f"{triple(row['idle_before']['lateness_s'])}; {triple(row['idle_after']['lateness_s'])}"
        figures = (triple(row[key]) for key in ("answer_s", "lag_s", "act_s"))
        lines.append(
            f"| {row['drives']} | {row['cycles']} | {row['missed']} | {triple(row['lateness_s'])} | {quiet} | "
            + " | ".join(figures)
            + f" | {row['cause']} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the sessions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--ordinary", action="store_true", help="without real-time scheduling in the session's process")
    arguments = parser.parse_args()
    if arguments.ordinary:
        for module in (clock, session):
            module.real_time = lambda *_, **__: contextlib.nullcontext(False)  # type: ignore[attr-defined]
    rows = [measure(name, arguments.seconds) for name in ROBOTS]
    load = f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}"
    real = "granted" if rows[0]["idle_before"]["real_time"] else "not granted: figures without it are not dependable"
    text = f"{table(rows)}\n\nMedian / 99th percentile / greatest. {load}; real-time scheduling {real}.\n"
    print(text)
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")
        arguments.json.with_suffix(".md").write_text(text)


if __name__ == "__main__":
    main()
