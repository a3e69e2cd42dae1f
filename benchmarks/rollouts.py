"""Rollouts per second of both engines, 100 solves each: a uniform bar, and the notched trunk behind its simulator.

    python benchmarks/rollouts.py [--push] [--json FILE] [--mesh FILE] [--seconds S] [--batch N]

The bar has 20 elements and 8 cables; it is timed at the engine. The trunk is timed as inference calls it,
through commands, limits and markers. Parameters differ from rollout to rollout. Compilation is not counted; the best of
the repeats is. The JAX engine uses as many processors as XLA likes; the Numba engine is timed on one thread and on all.
Rates of one thread are those of processor time, others of the clock on the wall.

With `--push` follow: the trunk with plate and cube, and without them at the same commands, which bring it onto the
cube; SOFA's mesh, with and without ($RFDROPO_DATA, or `--mesh`); MuJoCo's flex and PyElastica on the bar, one rollout
of a second at a time, where they are installed; and the memory of a batch of 10,000. That is the whole table, in six
minutes after installation and three from then on. Beside FILE the table is written as Markdown.

The last column is how far the tip of the bar, held at one end, sags under its own weight, against the heavy elastica.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import peers

from rfdropo_bayes import fem
from rfdropo_bayes.model.assembly import backend, build_robot_simulator
from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.body_engine import Engine
from rfdropo_bayes.simulators.protocol import Result
from rfdropo_bayes.simulators.trunk import Assembly

SOLVES = 100
TIME_STEP = 0.01  # [s]
TRUNK = "trunk_sofa"
CUBE = " + cube"
MESH = "mesh"
LENGTH, HALF_WIDTH, ELEMENTS, CABLES = 0.195, 0.01, 20, 8
SAG = 0.0948  # [m] of the tip, heavy elastica of the bar's length, section, modulus and density
MESH_FILE = "sofa_trunk/trunk.vtk"
MANY = 10_000
KEYS = ("body", "engine", "precision", "threads", "pushing")
"""What tells one row from another."""

Values = dict[str, jax.Array]
Run = Callable[[Values], jax.Array]  # number of rollouts that failed


EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"
SOFA: dict[str, Any] = tomllib.loads((EXPERIMENTS / "sofa_push.toml").read_text())["simulator"]["tetrahedra"]
"""How SOFA simulates its mesh."""


class Case(NamedTuple):
    """One row of the table: a body, an engine, its precision, its threads (None: all) and the batch it is given."""

    body: str
    engine: str
    precision: str
    threads: int | None
    batch: int
    mesh: str | None = None
    pushing: bool = False

    @property
    def table(self) -> SimulatorTable:
        """What an experiment says of the engine."""
        threads = {"threads": self.threads} if self.engine == "numba" else {}
        body = {"body": "tetrahedra", "tetrahedra": SOFA | {"mesh": self.mesh}} if self.mesh else {}
        push = self.body.endswith(CUBE)
        return SimulatorTable(engine=self.engine, precision=self.precision, push=push, **threads, **body)


def cases(batch: int) -> Iterator[Case]:
    """Both bodies on both engines; the slower engine gets an eighth of the batch."""
    for body in ("bar", TRUNK):
        yield Case(body, "jax", "float64", None, max(1, batch // 8))
        for precision in ("float64", "float32"):
            for threads in sorted({1, os.cpu_count() or 1}):
                yield Case(body, "numba", precision, threads, batch)


def pushing_cases(batch: int, mesh: Path | None) -> Iterator[Case]:
    """The trunk without and with cube, in layers and, where there is one, as a mesh."""
    for file in (None, mesh) if mesh else (None,):
        for precision in ("float64", "float32"):
            for cube in ("", CUBE):
                for threads in sorted({1, os.cpu_count() or 1}):
                    name = (MESH if file else TRUNK) + cube
                    size = batch // 8 if file else batch
                    yield Case(name, "numba", precision, threads, size, str(file) if file else None, True)


def drawn(nominal: dict[str, float], batch: int) -> Values:
    """Parameters around their nominal values."""
    factors = np.random.default_rng(0).uniform(0.8, 1.2, (len(nominal), batch))
    return {name: jnp.asarray(value * factor) for (name, value), factor in zip(nominal.items(), factors, strict=True)}


def pulls(channels: int, steps: int) -> np.ndarray:
    """Commands [m] that grow and go round; opposite cables give way."""
    share = np.arange(steps)[:, None] / steps
    return 0.01 * share * np.sin(2 * np.pi * share + np.pi / 2 * np.arange(channels))


def bar() -> Assembly:
    """The uniform bar with cables on a circle, guided at every other station."""
    body = fem.uniform_rod(LENGTH, HALF_WIDTH, HALF_WIDTH, ELEMENTS)
    angle = 2 * np.pi * np.arange(CABLES) / CABLES
    circle = 0.009 * np.stack([np.cos(angle), np.sin(angle), np.zeros(CABLES)], axis=1)
    height = np.array([0.0, 0.0, 1.0])
    guides = [place + height * body.station[2::2, None] for place in circle]
    system = fem.System(body, fem.cable_layout(body, circle - 0.01 * height, guides))
    return Assembly(system, fem.attach(body, LENGTH * height[None]), np.arange(ELEMENTS + 1))


def bar_material(young_modulus: jax.Array, density: jax.Array, **changes: Any) -> fem.Material:
    """Soft silicone, hanging from the side."""
    damping = {"rayleigh_mass": 0.1, "rayleigh_stiffness": 0.01}
    return fem.material(
        bar().system,
        young_modulus=young_modulus,
        poisson_ratio=0.45,
        density=density,
        gravity=(9.81, 0.0, 0.0),
        **(damping | changes),
    )


def bar_engine(case: Case, from_equilibrium: bool) -> Engine:
    """The engine of a case, for the bar."""
    return Engine(bar(), TIME_STEP, backend(case.table, True), from_equilibrium)


def bar_rollouts(case: Case) -> tuple[Run, Values]:
    """Rollouts of the bar at the engine."""
    engine, displacement = bar_engine(case, False), jnp.asarray(pulls(CABLES, SOLVES))

    def failed(values: Values) -> jax.Array:
        return engine.motion(bar_material(**values), jnp.zeros(CABLES), displacement, None).diverged

    return jax.jit(lambda values: jnp.sum(jax.vmap(failed)(values))), drawn(
        {"young_modulus": 4.5e5, "density": 1000.0}, case.batch
    )


def sag_error(case: Case) -> float:
    """Relative error of the bar's sag, cables slack."""
    slack = jnp.full(CABLES, -0.1)
    material = bar_material(jnp.asarray(4.5e5), jnp.asarray(1000.0))
    motion = bar_engine(case, True).motion(material, slack, slack[None], None)
    return float(motion.position[0, 0, 0]) / SAG - 1.0


def trunk_rollouts(case: Case) -> tuple[Run, Values]:
    """Rollouts of the trunk at the simulator."""
    robot = "trunk_sofa_mesh" if case.mesh else TRUNK
    trunk = build_robot_simulator(ModelSpec(Robot.load(robot), simulator=case.table))
    step = trunk.description["time_step_s"]
    channels, clock = len(trunk.channel_names), np.arange(0, SOLVES, 10) * step
    ends = np.array([0.0, SOLVES * step])
    value = pulls(channels, len(clock))
    if case.pushing:
        value[:, 2] += 0.05 * np.arange(1, len(clock) + 1) / len(clock)  # the cable on the cube's side
    commands = trunk.commands(clock, value, np.zeros(channels), ends)
    nominal = {spec.name: float(spec.nominal) for spec in trunk.parameters}

    def failed(values: Values) -> jax.Array:
        return trunk.rollout(values, commands).status != Result.OK

    names = ("young_modulus", "trunk_mass")
    return jax.jit(lambda values: jnp.sum(jax.vmap(failed)(values))), drawn(
        {name: nominal[name] for name in names}, case.batch
    )


def measure(case: Case, seconds: float) -> dict[str, Any]:
    """Best rate of a case over repeats that fill ``seconds``, with its first call and its failures."""
    run, values = bar_rollouts(case) if case.body == "bar" else trunk_rollouts(case)
    clock = time.process_time if case.threads == 1 else time.perf_counter
    started = clock()
    failed = int(jax.block_until_ready(run(values)))
    first_call = clock() - started
    best, spent = float("inf"), 0.0
    while spent < seconds:
        started = clock()
        jax.block_until_ready(run(values))
        elapsed = clock() - started
        best, spent = min(best, elapsed), spent + elapsed
    row = case._asdict() | {"rollouts_per_second": case.batch / best, "first_call_s": first_call, "failed": failed}
    row["mesh"] = case.mesh and Path(case.mesh).name  # where it lies is of no interest elsewhere
    return row | ({"sag_error": sag_error(case)} if case.body == "bar" else {})


def line(case: Case, row: dict[str, Any]) -> str:
    """A row of the printed table."""
    sag = f"{100 * row['sag_error']:+8.2f}%" if "sag_error" in row else ""
    name = case.body + (" *" if case.pushing else "")
    return (
        f"{name:20}{case.engine:8}{case.precision:11}{case.threads or 'all':>8}"
        f"{row['rollouts_per_second']:12.1f}{row['first_call_s']:10.1f} s{row['failed']:8d}{sag:>9}"
    )


def memory() -> float:
    """Largest memory [GB] of a process that rolls out `MANY` trunks at once, measured in a process of its own."""
    command = [sys.executable, __file__, "--memory"]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def measure_memory() -> None:
    """Print the largest memory [GB] of this process after `MANY` rollouts of the trunk."""
    run, values = trunk_rollouts(Case(TRUNK, "numba", "float32", None, MANY))
    jax.block_until_ready(run(values))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9)


def as_markdown(table: dict[str, Any]) -> str:
    """The table, with the share of the rate without a cube, and the gain of the threads."""
    rates = {tuple(row[key] for key in KEYS): row["rollouts_per_second"] for row in table["rows"]}
    machine = table["machine"]
    lines = [
        "# Rollouts per second",
        "",
        f"{table['solves']} solves a rollout, on {machine['processors']} processors ({machine['cpu']}); load before "
        f"the first row {table['load'][0]:.1f}. Written by `make bench`.",
        "Rows with a star pull the trunk onto a cube; others do not reach one.",
        "",
        "| body | engine | precision | threads | rollouts/s | of one thread | of no cube | failed | sag |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in table["rows"]:
        body, *rest, threads, pushing = (row[key] for key in KEYS)
        rate = row["rollouts_per_second"]
        gain = rates.get((body, *rest, 1, pushing)) if threads != 1 else None
        free = rates.get((body.removesuffix(CUBE), *rest, threads, pushing)) if body.endswith(CUBE) else None
        shares = [f"{rate / other:.2f}" if other else "" for other in (gain, free)]
        sag = f"{100 * row['sag_error']:+.2f} %" if "sag_error" in row else ""
        cells = [body + (" *" if pushing else ""), *rest, threads or "all", f"{rate:.0f}", *shares, row["failed"], sag]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    for peer in table["peers"]:
        rate = peer["rollouts_per_second"]
        if rate is not None:
            sag = f"{100 * (peer['sag'] / peers.SAG - 1.0):+.1f} %"
            lines.append(f"| bar | {peer['name']} | | 1 | {rate:.2f} | | | | {sag} |")
    if table["memory_gb"] is not None:
        lines += ["", f"{MANY} rollouts of the trunk at once, in single precision: {table['memory_gb']:.2f} GB."]
    return "\n".join(lines) + "\n"


def processor() -> str:
    """Name of the processor, where the system tells."""
    try:
        told = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine()
    names = [row.partition(":")[2].strip() for row in told.splitlines() if row.startswith("model name")]
    return names[0] if names else platform.machine()


def chosen_mesh(given: Path | None) -> Path | None:
    """The mesh asked for, or SOFA's where it is at hand."""
    default = Path(os.environ.get("RFDROPO_DATA", "")) / MESH_FILE
    return given or (default.resolve() if default.is_file() else None)


def gather(options: argparse.Namespace) -> dict[str, Any]:
    """Measure all rows, printing each."""
    chosen = list(cases(options.batch))
    if options.push:
        chosen += pushing_cases(options.batch, chosen_mesh(options.mesh))
    load, rows = os.getloadavg(), []
    print(f"{SOLVES} solves a rollout, {os.cpu_count()} processors, load {load[0]:.1f}; *: pulled onto a cube's place")
    print(f"{'body':20}{'engine':8}{'precision':11}{'threads':>8}", end="")
    print(f"{'rollouts/s':>12}{'first call':>12}{'failed':>8}{'sag':>9}")
    for case in chosen:
        rows.append(measure(case, options.seconds))
        print(line(case, rows[-1]), flush=True)
    used = memory() if options.push else None
    if used is not None:
        print(f"memory of {MANY} rollouts: {used:.2f} GB")
    others = peers.settle_all() if options.push or options.peers else []
    machine = {"processors": os.cpu_count(), "cpu": processor(), "python": platform.python_version()}
    table = {"solves": SOLVES, "machine": machine, "load": load, "rows": rows, "memory_gb": used, "schema_version": 2}
    table["peers"] = [peer._asdict() | {"rollouts_per_second": peer.rollouts_per_second} for peer in others]
    return table


def main() -> None:
    """Print the table; write it as JSON and Markdown where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--push", action="store_true", help="the whole table: cubes, the mesh, peers and memory, too")
    parser.add_argument("--json", type=Path, help="file to write the table to; as Markdown beside it")
    parser.add_argument(
        "--mesh", type=Path, help=f"a mesh of the trunk, for --push; by default $RFDROPO_DATA/{MESH_FILE}"
    )
    parser.add_argument("--seconds", type=float, default=3.0, help="time spent on each row")
    parser.add_argument("--batch", type=int, default=512, help="rollouts in a batch")
    parser.add_argument("--peers", action="store_true", help="other simulators, without all of --push")
    parser.add_argument("--memory", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory:
        measure_memory()
        return
    table = gather(options)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(table, indent=2) + "\n")
        options.json.with_suffix(".md").write_text(as_markdown(table))


if __name__ == "__main__":
    main()
