"""Punctuality of a session on 4 and 8 simulated drives, with the idle jitter of the same machine beside it.

    python benchmarks/motors.py [--seconds S] [--json FILE] [--ordinary]

Each session runs a 64 x 64 ONNX policy at 10 Hz on a set-point loop at 100 Hz; drives, hub and session are processes of their
own. Before and after it an idle loop of the same rate is timed; the median of its runs stands beside. Columns: deadlines
missed by more than a cycle; lateness of the loop; time from SYNC to the last drive's status; lag of the measured length
behind the set-point where it moves (one cycle of it is the set-point's own: it says where to be at the next SYNC); time of
the policy, observation included. `--ordinary` leaves real-time scheduling out, to see what it is worth.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from rfdropo_bayes.deployment import clock, session
from rfdropo_bayes.deployment.clock import measure_jitter
from rfdropo_bayes.deployment.drives import Drives
from rfdropo_bayes.deployment.log import read_journal
from rfdropo_bayes.deployment.loop import Phase
from rfdropo_bayes.deployment.policy import PolicyCard
from rfdropo_bayes.deployment.settings import Deployment, PolicyTable
from rfdropo_bayes.robots import Robot, load_robot

ROBOTS = ("motor_arm", "motor_trunk")
PERIOD = 0.01  # [s]
IDLE_RUNS, IDLE_SECONDS = 5, 4.0
PERCENTILES = (50, 99, 100)


def write_policy(path: Path, robot: Robot, width: int = 64) -> None:
    """A random network of two hidden layers that keeps the cables in motion: its output depends on the last command."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    channels = robot.channel_names
    names = tuple(f"command.{channel}" for channel in channels)
    names += tuple(f"marker.{marker}.{axis}" for marker in robot.marker_names for axis in "xyz")
    card = PolicyCard(
        robot=robot.name, rate_hz=10.0, unit="m", action="command", channels=channels, observation=names,
        low=(-0.01,) * len(channels), high=(0.01,) * len(channels),
    )  # fmt: skip
    random = np.random.default_rng(0)
    sizes = (len(names), width, width, len(channels))
    gains = (300.0, 3.0, 3.0)  # commands are millimetres; a gain above one keeps a random network from coming to rest
    nodes, values, last = [], [], "observation"
    for layer, (rows, columns, gain) in enumerate(zip(sizes, sizes[1:], gains, strict=False)):
        weight = gain * random.normal(size=(rows, columns)) / np.sqrt(rows)
        values.append(numpy_helper.from_array(weight.astype(np.float32), f"w{layer}"))
        nodes += [helper.make_node("MatMul", [last, f"w{layer}"], [f"p{layer}"]),
                  helper.make_node("Tanh", [f"p{layer}"], [f"h{layer}"])]  # fmt: skip
        last = f"h{layer}"
    values.append(numpy_helper.from_array(np.float32(0.01), "scale"))
    nodes.append(helper.make_node("Mul", [last, "scale"], ["action"]))
    shapes = (("observation", len(names)), ("action", len(channels)))
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [None, size]) for name, size in shapes]
    graph = helper.make_graph(nodes, "random", ends[:1], ends[1:], values)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, card.metadata())
    onnx.save(model, str(path))


class TimedDrives(Drives):
    """Drives that note how long each exchange takes."""

    times: list[float] = []  # noqa: RUF012: one session at a time

    def exchange(self, timeout: float) -> bool:
        """As ever, timed."""
        start = time.monotonic()
        complete = super().exchange(timeout)
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
    robot = load_robot(name)
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
        },  # fmt: skip
        "idle_before": before,
        "idle_after": after,
    }


def triple(values: dict[str, float]) -> str:
    """Median / p99 / greatest, in ms."""
    return " / ".join(f"{1e3 * values[str(p)]:.2f}" for p in PERCENTILES)


def table(rows: list[dict[str, Any]]) -> str:
    """The sessions as Markdown."""
    lines = [
        "| drives | cycles | missed | late [ms] | idle, late [ms] | SYNC to last status [ms] | lag [ms] | policy [ms] | ended |",
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
            module.schedule_fifo = lambda thread=0: False  # type: ignore[attr-defined]
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
