"""Rollouts per second of both engines: 100 solves each, the notched trunk, eight cables moving.

    python benchmarks/rollouts.py [--json FILE] [--seconds S] [--batch N]

The parameters differ from rollout to rollout, as in inference. Compilation is not counted; the best of the repeats is.
The JAX engine uses as many processors as XLA likes; the Numba engine is timed on one thread and on all.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rfdropo_bayes.robots import load_robot
from rfdropo_bayes.simulators.protocol import Observation, Result
from rfdropo_bayes.simulators.trunk import TrunkSimulator
from rfdropo_bayes.workflow.assembly import build_simulator
from rfdropo_bayes.workflow.experiment import Experiment

SOLVES = 100
ROBOT = "trunk_sofa"


class Case(NamedTuple):
    """One row of the table: an engine, its precision, its threads (None: all) and the batch it is given."""

    engine: str
    precision: str
    threads: int | None
    batch: int


def cases(batch: int) -> Iterator[Case]:
    """Both engines; the slower one gets an eighth of the batch."""
    yield Case("jax", "float64", None, max(1, batch // 8))
    processors = os.cpu_count() or 1
    for precision in ("float64", "float32"):
        for threads in sorted({1, processors}):
            yield Case("numba", precision, threads, batch)


def simulator(case: Case) -> TrunkSimulator:
    """The trunk on the engine of a case, at the robot's own discretisation."""
    table: dict[str, Any] = {"engine": case.engine, "precision": case.precision}
    if case.engine == "numba":
        table["threads"] = case.threads
    return build_simulator(Experiment(robot=ROBOT, simulator=table), load_robot(ROBOT))


def batched_rollout(trunk: TrunkSimulator, batch: int) -> tuple[Any, dict[str, jax.Array]]:
    """A compiled function of a batch of parameters, and such a batch, drawn around the nominal values."""
    step = trunk.discretisation.time_step
    channels = len(trunk.channel_names)
    duration = SOLVES * step
    clock = np.arange(0, SOLVES, 10) * step
    share = clock[:, None] / duration
    pulls = 0.01 * share * np.sin(2 * np.pi * share + np.pi / 2 * np.arange(channels))  # [m]; opposite cables give way
    commands = trunk.commands(clock, pulls, np.zeros(channels), np.array([0.0, duration]))
    drawn = np.random.default_rng(0).uniform(0.8, 1.2, (2, batch))
    nominal = {spec.name: spec.nominal for spec in trunk.parameters}
    names = ("young_modulus", "trunk_mass")
    values = {name: jnp.asarray(nominal[name] * factor) for name, factor in zip(names, drawn, strict=True)}
    return jax.jit(jax.vmap(lambda one: trunk.rollout(one, commands))), values


def measure(case: Case, seconds: float) -> dict[str, Any]:
    """Best rate of a case over repeats that fill ``seconds``, with its first call and its failures."""
    run, values = batched_rollout(simulator(case), case.batch)
    started = time.perf_counter()
    first: Observation = jax.block_until_ready(run(values))
    first_call = time.perf_counter() - started
    best, spent = float("inf"), 0.0
    while spent < seconds:
        started = time.perf_counter()
        jax.block_until_ready(run(values))
        elapsed = time.perf_counter() - started
        best, spent = min(best, elapsed), spent + elapsed
    failed = int(np.sum(np.asarray(first.status) != Result.OK))
    return case._asdict() | {"rollouts_per_second": case.batch / best, "first_call_s": first_call, "failed": failed}


def main() -> None:
    """Print the table; write it as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path, help="file to write the table to")
    parser.add_argument("--seconds", type=float, default=5.0, help="time spent on each row")
    parser.add_argument("--batch", type=int, default=512, help="rollouts in a batch")
    options = parser.parse_args()
    print(f"{ROBOT}, {SOLVES} solves a rollout, {os.cpu_count()} processors")
    print(f"{'engine':8}{'precision':11}{'threads':>8}{'batch':>7}{'rollouts/s':>12}{'first call':>12}{'failed':>8}")
    rows = []
    for case in cases(options.batch):
        row = measure(case, options.seconds)
        rows.append(row)
        print(
            f"{case.engine:8}{case.precision:11}{case.threads or 'all':>8}{case.batch:7d}"
            f"{row['rollouts_per_second']:12.1f}{row['first_call_s']:10.1f} s{row['failed']:8d}",
            flush=True,
        )
    if options.json:
        machine = {"processors": os.cpu_count(), "machine": platform.machine(), "python": platform.python_version()}
        table = {"robot": ROBOT, "solves": SOLVES, "machine": machine, "rows": rows, "schema_version": 1}
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
