"""How near the motion comes to the converged one, for implicit Euler and SDIRK2, and what a millimetre costs.

    python benchmarks/convergence.py [--elements | --prior N] [--robots NAME [NAME ...]] [--motions N] [--seconds S]

Every robot is pulled about at random: one command moves its cable by 5 mm every 50 ms, within its range. The error is
the root mean square over motions and time of the tip's distance from the converged motion, that of SDIRK2 with the
shortest step. Usual damping is the robot's nominal one, small damping a stiffness damping of 2 ms. Processor time is
that of one rollout on one thread; between two steps, and beyond the shortest, it follows the line through the last two
points of error against time, in logarithms.

With `--elements` the rod is refined instead, every element cut into 1, 2, 4, 8 and 16, with SDIRK2 at 10 ms and at rest
under every command. The limit is Richardson's extrapolation from the two finest rods. Distances from it are in mm and
in percent of the tip's root mean square way from its mean place. The observed order is log2 of the ratio of differences
between successive rods: of 1, 2 and 4 times the elements, of 2, 4 and 8, and of 4, 8 and 16.

With `--prior N` parameters are drawn N times from the robot's default priors, each with a motion of its own: the median
and the 90 % quantile of the draws' errors, and how many lie beyond half a millimetre.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from prior_draws import drawn

from rfdropo_bayes.fem.native.rod_engine import NativeRod
from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.trunk import TrunkSimulator

ROBOTS = ("trunk_sofa", "trunk_physical", "smooth_arm", "asl_trunk", "motor_trunk")
PERIOD, MOVE, FARTHEST, OBSERVED = 0.05, 0.005, 0.03, 0.02
"""[s] and [m] between commands; [m] largest pull; [s] between observations."""
STEPS_MS = (20.0, 10.0, 5.0, 2.5)
FURTHER_MS = (1.25, 0.625)
"""Where Euler is still more than a millimetre away."""
CONVERGED_MS = 0.3125
SMALL_DAMPING = 0.002  # [s]
ALLOWED = 1.0  # [mm]
REFINED = (1, 2, 4, 8, 16)
"""Elements for each of the robot's own."""
ELEMENTS_MS = 10.0
AT_REST: Any = "quasi-static"
REPEATS = 3
PRIOR_MS, PRIOR_CONVERGED_MS = (20.0, 10.0, 5.0), 1.25
WANTED = 0.5  # [mm]


class Row(NamedTuple):
    """One integrator on one robot."""

    robot: str
    damping_s: float
    integrator: str
    error_mm: dict[str, float]  # by step [ms]
    cpu_s: dict[str, float]  # of one rollout
    cpu_s_for_1_mm: float


class ElementRow(NamedTuple):
    """One robot with more elements, by how many for each of its own."""

    robot: str
    motion: str
    solved: str  # motions whose equilibria were all found, with all elements
    elements: int  # its own
    error_mm: dict[str, float]  # from Richardson's limit
    share: dict[str, float]  # of the tip's way
    order: list[float]  # of 1, 2, 4 times the elements, of 2, 4, 8, and of 4, 8, 16
    cpu_s: dict[str, float]  # of one rollout


def simulator(robot: Robot, integrator: str, step_ms: float, refine: int = 1) -> TrunkSimulator:
    """A robot on one thread of the compiled engine."""
    options: dict[str, Any] = {"engine": "numba", "threads": 1, "time_step": 1e-3 * step_ms}
    options |= {"integrator": integrator, "refine": refine}
    built = build_simulator(ModelSpec(robot, simulator=SimulatorTable.model_validate(options)))
    assert isinstance(built, TrunkSimulator)
    return built


def walk(robot: Robot, motions: int, seconds: float) -> Float[np.ndarray, "motion command channel"]:
    """Random commands [m or rad], cumulative."""
    random = np.random.default_rng(0)
    gain = np.abs(robot.channel_matrix({})).max(axis=0)
    low, high = robot.drive_limits().T
    matrix, count = np.asarray(robot.channel_matrix({})), round(seconds / PERIOD)
    two_sided = np.any(matrix < 0.0, axis=0)  # a motor that pulls one cable lets another one go
    reach = min(FARTHEST, float(np.min(high)), float(np.min(-low)))
    moves = np.zeros((motions, count, len(gain)))
    chosen, sign = random.integers(len(gain), size=(motions, count)), random.choice([-MOVE, MOVE], (motions, count))
    np.put_along_axis(moves, chosen[..., None], sign[..., None], axis=2)
    there = np.zeros((motions, len(gain)))
    for k in range(count):
        there = np.clip(there + moves[:, k], np.where(two_sided, -0.5 * reach, 0.0), reach)
        moves[:, k] = there
    return moves / gain


@cache
def inputs(robot: str, step_ms: float, motions: int, seconds: float, refine: int = 1) -> Any:
    """What the engine moves the body by, at nominal parameters; the same for every integrator."""
    model = simulator(Robot.load(robot), "euler", step_ms, refine)
    clock, values = PERIOD * np.arange(round(seconds / PERIOD) + 1), model.complete({})
    grid = [
        model.commands(clock[:-1], rows, np.zeros(rows.shape[1]), clock) for rows in walk(model.robot, motions, seconds)
    ]
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *grid)
    material, start, displacement = jax.jit(jax.vmap(lambda c: model.inputs(values, c)))(stacked)
    return jax.tree.map(np.asarray, (material, start, displacement))


def tip(
    robot: str, integrator: str, step_ms: float, damping: float | None, motions: int, seconds: float, refine: int = 1
) -> tuple[Float[np.ndarray, "motion time 3"], float]:
    """Path of the tip [m], and processor time of one rollout [s]."""
    model = simulator(Robot.load(robot), "euler" if integrator == AT_REST else integrator, step_ms, refine)
    material, start, displacement = inputs(robot, step_ms, motions, seconds, refine)
    if damping is not None:
        material = material._replace(rayleigh_stiffness=np.full(motions, damping))
    begin = {"start" if model.engine.from_equilibrium else "before": start}
    engine, cost, stride = model.engine.native, np.inf, round(1e3 * OBSERVED / step_ms)
    if integrator == AT_REST:
        engine = NativeRod(
            model.assembly.system, model.assembly.markers, engine.time_step, threads=1, integrator=AT_REST
        )
        held = round(1e3 * PERIOD / step_ms)
        displacement, stride = displacement[:, held - 1 :: held], 1
    for _ in range(REPEATS):
        began = time.process_time()
        found = engine.rollout(material, displacement, **begin, stride=stride)
        cost = min(cost, (time.process_time() - began) / motions)
    if found.diverged.any():
        raise SystemExit(f"{robot}: {integrator} at {step_ms} ms diverged")
    return np.where(found.converged[:, None, None], found.position[:, :, -1], np.nan), cost


def error(path: np.ndarray, converged: np.ndarray) -> float:
    """Root mean square of the distance [mm]."""
    return float(1e3 * np.sqrt(np.mean(np.sum((path - converged) ** 2, axis=-1))))


def cost_of(allowed: float, errors: dict[str, float], costs: dict[str, float]) -> float:
    """Processor time [s] at which the error is the allowed one, by the line between its neighbours."""
    pairs = list(itertools.pairwise(errors))
    first, second = next((pair for pair in pairs if errors[pair[1]] <= allowed), pairs[-1])
    at = np.log([errors[first], errors[second]])
    slope = (np.log(costs[second]) - np.log(costs[first])) / (at[1] - at[0])
    return float(np.exp(np.log(costs[first]) + slope * (np.log(allowed) - at[0])))


def rows_of(robot: str, damping: float | None, motions: int, seconds: float) -> list[Row]:
    """Both integrators on one robot."""
    converged, _ = tip(robot, "sdirk2", CONVERGED_MS, damping, motions, seconds)
    nominal = float(inputs(robot, STEPS_MS[0], motions, seconds)[0].rayleigh_stiffness[0])
    rows = []
    for integrator in ("euler", "sdirk2"):
        errors: dict[str, float] = {}
        costs: dict[str, float] = {}
        for step in (*STEPS_MS, *FURTHER_MS):
            if step in FURTHER_MS and errors and min(errors.values()) <= ALLOWED:
                break
            path, cost = tip(robot, integrator, step, damping, motions, seconds)
            errors[f"{step:g}"], costs[f"{step:g}"] = error(path, converged), cost
        cheap = cost_of(ALLOWED, errors, costs)
        rows.append(Row(robot, nominal if damping is None else damping, integrator, errors, costs, cheap))
    return rows


def element_row(robot: str, integrator: Any, motions: int, seconds: float) -> ElementRow | None:
    """A robot with more and more elements; None if in every motion an equilibrium was not found."""
    found = {n: tip(robot, integrator, ELEMENTS_MS, None, motions, seconds, n) for n in REFINED}
    solved = np.all([np.isfinite(place).all(axis=(1, 2)) for place, _ in found.values()], axis=0)
    if not solved.any():
        return None
    path = {n: place[solved] for n, (place, _) in found.items()}
    near, far = path[REFINED[-1]], path[REFINED[-2]]
    limit = near + (near - far) / 3.0
    way = error(limit, limit.mean(axis=1, keepdims=True))
    change = [error(path[n], path[m]) for n, m in itertools.pairwise(REFINED)]
    errors = {str(n): error(place, limit) for n, place in path.items()}
    return ElementRow(
        robot,
        integrator,
        f"{solved.sum()} of {motions}",
        simulator(Robot.load(robot), "euler", ELEMENTS_MS).assembly.system.body.elements,
        errors,
        {name: away / way for name, away in errors.items()},
        [float(np.log2(one / two)) for one, two in itertools.pairwise(change)],
        {str(n): cost for n, (_, cost) in found.items()},
    )


def print_elements(robots: list[str], motions: int, seconds: float) -> list[ElementRow]:
    """Print the table of elements."""
    titles = (f"{n} x: mm, % of the way, CPU ms" for n in REFINED)
    print("| robot | motion | solved | elements | " + " | ".join(titles) + " | order |")
    print("|" + "---|" * (5 + len(REFINED)))
    rows = []
    for robot, integrator in itertools.product(robots, ("sdirk2", AT_REST)):
        row = element_row(robot, integrator, motions, seconds)
        if row is None:
            print(f"| {robot} | {integrator} | 0 of {motions} |", flush=True)
            continue
        rows.append(row)
        cells = [
            f"{row.error_mm[n]:.3f}, {100.0 * row.share[n]:.2f}, {1e3 * row.cpu_s[n]:.1f}" for n in map(str, REFINED)
        ]
        order = ", ".join(f"{value:.2f}" for value in row.order)
        print(
            "| " + " | ".join([row.robot, row.motion, row.solved, str(row.elements), *cells, order]) + " |", flush=True
        )
    return rows


def drawn_tip(model: TrunkSimulator, values: dict[str, np.ndarray], seconds: float) -> Float[np.ndarray, "draw time 3"]:
    """Path of the tip [m] of every draw; not a number where a draw was lost."""
    draws, clock = len(next(iter(values.values()))), PERIOD * np.arange(round(seconds / PERIOD) + 1)
    grid = [model.commands(clock[:-1], row, np.zeros(row.shape[1]), clock) for row in walk(model.robot, draws, seconds)]
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *grid)
    material, start, displacement = jax.tree.map(np.asarray, jax.jit(jax.vmap(model.inputs))(values, stacked))
    begin = {"start" if model.engine.from_equilibrium else "before": start}
    stride = round(OBSERVED / model.time_step)
    found = model.engine.native.rollout(material, displacement, **begin, stride=stride)
    return np.where(found.diverged[:, None, None], np.nan, found.position[:, :, -1])


def print_priors(robots: list[str], draws: int, seconds: float) -> None:
    """Print the table of errors over a robot's prior."""
    print("| robot | " + " | ".join(f"{step:g} ms: median, 90 %, beyond {WANTED} mm" for step in PRIOR_MS) + " |")
    print("|" + "---|" * (1 + len(PRIOR_MS)))
    for name in robots:
        robot = Robot.load(name)
        values = drawn(simulator(robot, "sdirk2", PRIOR_CONVERGED_MS), draws)
        converged = drawn_tip(simulator(robot, "sdirk2", PRIOR_CONVERGED_MS), values, seconds)
        cells = [name]
        for step in PRIOR_MS:
            path = drawn_tip(simulator(robot, "sdirk2", step), values, seconds)
            away = 1e3 * np.sqrt(np.mean(np.sum((path - converged) ** 2, axis=-1), axis=1))
            middle, high = np.nanquantile(away, [0.5, 0.9])
            cells.append(f"{middle:.2f}, {high:.2f}, {np.mean(~(away <= WANTED)):.0%}")
        print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS))
    parser.add_argument("--motions", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=3.0, help="of every motion")
    parser.add_argument("--elements", action="store_true", help="refine the rod instead of the time step")
    parser.add_argument("--prior", type=int, metavar="N", help="draw so many times from the robot's default priors")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    chosen = parser.parse_args()
    if chosen.prior:
        return print_priors(chosen.robots, chosen.prior, chosen.seconds)
    if chosen.elements:
        refined = print_elements(chosen.robots, chosen.motions, chosen.seconds)
        if chosen.json:
            chosen.json.write_text(json.dumps([row._asdict() for row in refined], indent=1))
        return
    names = [f"{step:g}" for step in (*STEPS_MS, *FURTHER_MS)]
    steps = " | ".join(f"{name} ms" for name in names)
    print(f"| robot | damping [s] | integrator | {steps} | CPU ms for 1 mm |")
    print("|" + "---|" * (4 + len(STEPS_MS) + len(FURTHER_MS)))
    rows = []
    for robot in chosen.robots:
        for damping in (None, SMALL_DAMPING):
            for row in rows_of(robot, damping, chosen.motions, chosen.seconds):
                rows.append(row)
                shown = [f"{row.error_mm[k]:.2f}" if k in row.error_mm else "" for k in names]
                cells = [row.robot, f"{row.damping_s:g}", row.integrator, *shown, f"{1e3 * row.cpu_s_for_1_mm:.1f}"]
                print("| " + " | ".join(cells) + " |", flush=True)
    if chosen.json:
        chosen.json.write_text(json.dumps([row._asdict() for row in rows], indent=1))


if __name__ == "__main__":
    main()
