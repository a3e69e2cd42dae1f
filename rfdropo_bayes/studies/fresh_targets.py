"""Targets that nobody has looked at: a robot with drawn flaws, made from a kind and a seed, with six recordings.

Every row of a comparison is fitted to these six. All robots are the smooth arm, which reaches for goals.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rfdropo_bayes.bayes.priors import prior_from_table
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import output_folder, write_text
from rfdropo_bayes.mechanisms.registry import REGISTRY, mechanisms_named
from rfdropo_bayes.model.experiment_file import describe
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.mechanisms import Mechanism
from rfdropo_bayes.studies.fresh_laws import LAWS, CableEffect
from rfdropo_bayes.verbs.simulate import simulate

KINDS = ("library", "unknown")
ROBOT = "smooth_arm"
FROM_LIBRARY, UNKNOWN = 3, 2  # effects of a target
LARGER = (1.0, 2.0)  # sizes of an unknown law, in usual ones
RECORDINGS = tuple(f"recording_{k + 1}" for k in range(6))
AUDITED = 4  # recordings that an audit fits; it measures the gain in the others
NOISE = 5e-4  # m, of motion capture
RANGES = {
    "young_modulus": (1e6, 4e6),
    "poisson_ratio": (0.4, 0.499),
    "trunk_mass": (0.04, 0.18),
    "rayleigh_stiffness": (0.01, 0.15),
}
INNER = (0.2, 0.8)  # shares of the ranges between which truths are drawn
COMMANDS = {"duration": 5.0, "interval": 0.05, "step": 0.005, "low": 0.0, "high": 0.02, "sample_time": 0.05}
FINER = {"refine": 2, "time_step": 0.005}  # the target's mesh and time step, half of its model's
GOALS = [[-0.04, -0.05, 0.14], [0.04, 0.02, 0.17]]  # m
EVALUATED = 50_000  # steps of training between evaluations, of which the best has the policy that is kept


def make_target(kind: str, seed: int, out: Path) -> dict[str, Path]:
    """Draw a target, and write its files and recordings.

    Args:
        kind: "library", three mechanisms of the library, their sizes drawn from their priors; or "unknown", two laws
            that the library lacks, each of one cable, as large as usual to twice as large.
        seed: of all that is drawn: the same seed makes the same target.
        out: folder to write to.

    Returns:
        ``truth``, ``reach`` and ``audit``: the experiment files of the target, of the fits and trainings, and of the
        audit. The last two have no part of the truth.

    Raises:
        InputError: an unknown kind, or a target whose recordings cannot be simulated.
    """
    model = draw_flaws(kind, seed)
    out = output_folder(Path(out))
    tables: dict[str, dict[str, Any]] = {
        "truth": {"simulator": FINER, "model": model, "training": {"goals": GOALS, "noise": NOISE}},
        "reach": _fitted(RECORDINGS, (), {"noise": "white"}) | {"training": _training()},
        "audit": _fitted(RECORDINGS[:AUDITED], RECORDINGS[AUDITED:], {}) | {"noise": {"standard_deviation": NOISE}},
    }
    files = {}
    for name, table in tables.items():
        files[name] = out / f"{name}.toml"
        write_text(files[name], describe({"robot": ROBOT, "seed": seed, **table}))
    _record(files["truth"], seed)
    return files


def draw_flaws(kind: str, seed: int) -> dict[str, Any]:
    """The table [model] of a target: its mechanisms, and its true values; see `make_target`."""
    if kind not in KINDS:
        raise InputError(f"unknown kind {kind!r} of target", where="make_target", remedy=f"use {' or '.join(KINDS)}")
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    body = {name: low + (high - low) * rng.uniform(*INNER) for name, (low, high) in RANGES.items()}
    names, sizes = _from_library(rng) if kind == "library" else _unknown(rng)
    return {"mechanisms": names, "fixed": {name: float(f"{v:.6g}") for name, v in {**body, **sizes}.items()}}


def _record(truth: Path, seed: int) -> None:
    """Write the six recordings, which do not tell what made them, each of commands of its own."""
    noise = {"standard_deviation": NOISE}
    commands = {**COMMANDS, "recordings": list(RECORDINGS), "blind": True}
    for recording in simulate(Model.read(truth), commands, noise=noise, seed=seed):
        recording.save(truth.parent / f"{recording.name}.nc")


def _fitted(fit: tuple[str, ...], test: tuple[str, ...], model: Mapping[str, Any]) -> dict[str, Any]:
    data = {"format": "netcdf", "fit": [f"{name}.nc" for name in fit]}
    priors = {name: {"distribution": "Uniform", "low": low, "high": high} for name, (low, high) in RANGES.items()}
    return {
        "data": data | ({"test": [f"{name}.nc" for name in test]} if test else {}),
        "model": {**model, "priors": priors},
    }


def _training() -> dict[str, Any]:
    return {"task": "TrunkReach-v0", "goals": GOALS, "noise": NOISE, "anneal": True, "evaluate_every": EVALUATED}


def _from_library(rng: np.random.Generator) -> tuple[list[str], dict[str, float]]:
    """Names of mechanisms, and draws of all their parameters' priors; of the grid of one that has no prior size."""
    names = sorted(rng.choice(sorted(REGISTRY), FROM_LIBRARY, replace=False).tolist())
    sizes = {}
    for spec in (spec for mechanism in _made(names) for spec in mechanism.parameters):
        prior = prior_from_table(spec, spec.prior, where=spec.name)
        drawn = prior.sample(jax.random.key(int(rng.integers(2**31))))
        sizes[spec.name] = float(rng.choice(spec.grid)) if spec.grid else float(drawn)
    return names, sizes


def _unknown(rng: np.random.Generator) -> tuple[list[str], dict[str, float]]:
    """Names of laws, and the size of each at one cable."""
    kinds: list[type[CableEffect]] = [LAWS[k] for k in sorted(rng.choice(len(LAWS), UNKNOWN, replace=False))]
    names = [f"{kind.__module__}:{kind.__qualname__}" for kind in kinds]
    sizes = {}
    for mechanism in _made(names):
        spec = mechanism.parameters[int(rng.integers(len(mechanism.parameters)))]
        sizes[spec.name] = float(rng.uniform(*LARGER) * spec.prior["scale"])
    return names, sizes


def _made(names: list[str]) -> tuple[Mechanism, ...]:
    return mechanisms_named(names, Robot.load(ROBOT))
