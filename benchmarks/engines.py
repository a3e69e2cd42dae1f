"""How far another engine's arm is from ours where nothing is hidden and nothing is noise, and which effects imitate it.

    python benchmarks/engines.py [--truth mujoco] [--pieces 20] [--refine 2] [--poisson 0.42 0.1 0] [--seed 1]

The recordings are the four different fitted ones of the study's data set with a payload (`python -m studies audit
--truth mujoco`), the truth's values are given to ours, with the compliance of the servos. Each row is a difference of
two arms: of their tips, root mean square; and its linear fit by the total mass, the damping, the servos' compliance,
a payload and a tilt of gravity, with the deviations that the study's noise gives them. Poisson's ratio is held.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.noise.autoregression import STATED, Autoregression
from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.experiment import SimulatorTable
from rfdropo_bayes.model.model_spec import spec_of
from studies.engine_study import FITTED, REPEATS, TRUTHS, Truth, drawn_arm, seed_of
from studies.hidden_effects import MEMORY, NOISE, experiment_tables
from studies.mujoco_truth import CABLE

MECHANISMS = ("cable_compliance", "payload", "base_tilt")
STEPS = {"trunk_mass": 1e-4, "cable_compliance": 1e-6, "payload_mass": 2e-4, "base_tilt_x": 5e-3, "base_tilt_z": 5e-3}
"""Of central differences, in the parameters' units; a payload is one about `WEIGHT`, for it cannot be negative."""
RELATIVE = 0.01  # the same of damping, in its own size
WEIGHT = 4e-4  # [kg]
SHOWN = {
    "trunk_mass": ("mass [g]", 1e3),
    "payload_mass": ("payload [g]", 1e3),
    "base_tilt_x": ("tilt about x [rad]", 1.0),
}

Paths = Float[np.ndarray, "recording time marker 3"]


class Ours(NamedTuple):
    """Our arm at the truth's values.

    Attributes:
        path: of its markers [m].
        slopes: of the path by each parameter of the fit.
    """

    path: Paths
    slopes: Mapping[str, Paths]


def rollouts(
    truth: Truth, recordings: Sequence[Trajectory], refine: int
) -> Callable[[Mapping[str, np.ndarray]], Paths]:
    """What turns a batch of parameters into paths (draw, recording, time, marker, 3)."""
    spec = spec_of(experiment_tables(truth.setting), Path(), mechanisms=MECHANISMS)
    table = {**truth.setting.audited, "refine": refine, "engine": "numba"}
    simulator = build_simulator(replace(spec, simulator=SimulatorTable.model_validate(table)))
    commands = gather_recordings(simulator, list(recordings)).commands

    def path(values: Mapping[str, jax.Array]) -> jax.Array:
        return jax.vmap(lambda c: simulator.rollout(values, c, jnp.asarray(c.step.shape[0])).position)(commands)

    batch = jax.jit(jax.vmap(path))
    return lambda values: np.asarray(batch({name: jnp.asarray(column) for name, column in values.items()}))


def ours_at(batch: Callable[[Mapping[str, np.ndarray]], Paths], values: Mapping[str, float]) -> Ours:
    """Path and slopes, by central differences."""
    start = {"rayleigh_mass": 0.0, "rayleigh_stiffness": 0.0, **values, "cable_compliance": 1.0 / CABLE}
    start |= {"payload_mass": 0.0, "base_tilt_x": 0.0, "base_tilt_z": 0.0}
    damping = next(name for name in values if name.startswith("rayleigh"))
    steps = {**STEPS, damping: RELATIVE * start[damping]}
    points = [start]
    for name, step in steps.items():
        about = WEIGHT if name == "payload_mass" else start[name]
        points += [{**start, name: about + step}, {**start, name: about - step}]
    path, *moved = batch({name: np.array([point[name] for point in points]) for name in start})
    pairs = zip(steps.items(), moved[::2], moved[1::2], strict=True)
    return Ours(path, {name: (high - low) / (2.0 * step) for (name, step), high, low in pairs})


def apart(difference: Paths) -> float:
    """Root mean square distance of the tips [mm]."""
    return float(1e3 * np.sqrt(np.mean(np.sum(difference[:, :, -1] ** 2, axis=-1))))


def white(change: Paths) -> Float[np.ndarray, " value"]:
    """A change in deviations of the noise, rows made independent; the first recording is the mean of repeats."""
    series = change.reshape(*change.shape[:2], -1)
    noise = Autoregression(np.full(series.shape[2], NOISE), np.array([1.0, MEMORY]), STATED, np.inf)
    repeats = np.array([REPEATS, *[1.0] * (len(series) - 1)])
    return np.asarray(np.sqrt(repeats)[:, None, None] * noise.whiten(series, np.ones(series.shape, dtype=bool))).ravel()


def imitated(difference: Paths, slopes: Mapping[str, Paths]) -> tuple[dict[str, tuple[float, float]], Paths]:
    """The sizes that imitate a difference, each with its deviation, and the difference without them."""
    columns = np.stack([white(slope) for slope in slopes.values()], axis=1)
    scale = np.linalg.norm(columns, axis=0)
    covariance = np.linalg.inv((columns / scale).T @ (columns / scale)) / np.outer(scale, scale)
    sizes = covariance @ columns.T @ white(difference)
    left = difference - np.tensordot(sizes, np.stack(list(slopes.values())), 1)
    return dict(zip(slopes, zip(sizes, np.sqrt(np.diag(covariance)), strict=True), strict=True)), left


def row(title: str, difference: Paths, slopes: Mapping[str, Paths]) -> str:
    """A row of the table."""
    sizes, left = imitated(difference, slopes)
    cells = [f"{scale * sizes[name][0]:+.2f} ± {scale * sizes[name][1]:.2f}" for name, (_, scale) in SHOWN.items()]
    return f"| {title} | {apart(difference):.2f} | {' | '.join(cells)} | {apart(left):.2f} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truth", choices=sorted(TRUTHS), default="mujoco")
    parser.add_argument("--pieces", type=int, help="of the other engine's arm; its own number by default")
    parser.add_argument("--refine", type=int, default=2, help="parts of each layer of ours")
    parser.add_argument("--poisson", type=float, nargs="+", default=[0.42, 0.1, 0.0], help="ratios of ours")
    parser.add_argument("--seed", type=int, default=1, help="of the study")
    given = parser.parse_args()
    truth = TRUTHS[given.truth]
    arm, blank = drawn_arm(truth, None, seed_of(truth, "payload at the tip", given.seed, 0))
    if given.pieces is not None:
        arm = replace(arm, **{"links" if given.truth == "mujoco" else "elements": given.pieces})
    recordings = [blank[0], *blank[REPEATS:FITTED]]
    theirs, batch = arm.positions(recordings, 0.0), rollouts(truth, recordings, given.refine)
    print(
        "| difference | tips apart [mm] | " + " | ".join(f"as {word}" for word, _ in SHOWN.values()) + " | left [mm] |"
    )
    print("|" + "---|" * (3 + len(SHOWN)))
    found = {ratio: ours_at(batch, {**arm.values, "poisson_ratio": ratio}) for ratio in given.poisson}
    for ratio, ours in found.items():
        print(row(f"{given.truth} less ours, ratio {ratio:g}", theirs - ours.path, ours.slopes), flush=True)
    (first, many), *others = found.items()
    for ratio, ours in others:
        print(row(f"ours, ratio {ratio:g} less {first:g}", ours.path - many.path, ours.slopes), flush=True)


if __name__ == "__main__":
    main()
