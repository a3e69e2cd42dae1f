"""Targets that nobody has looked at: a robot with drawn flaws, made from a kind and a seed, with six recordings.

Every row of a comparison is fitted to these six. A scene is a robot with a task: the smooth arm, which reaches for
goals, or the virtual trunk, which pushes a cube.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
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
from rfdropo_bayes.verbs.simulate import simulate
from studies.fresh_laws import LAWS, CableEffect, HystereticCable
from studies.mujoco_truth import ENGINE_EFFECTS, arm_xml, write_arm

KINDS = ("library", "unknown", "mujoco")
FROM_LIBRARY, UNKNOWN = 3, 2  # effects of a target; MuJoCo's has as many as one with unknown laws
LARGER = (1.0, 2.0)  # sizes of an unknown law or of an engine's effect, in usual ones
ENGINE_LINKS, ENGINE_STEP = 10, 2e-3
"""Links and time step [s] of MuJoCo's arm: a control period takes 1 ms of a processor, with 20 links and 1 ms 7. The
step moves the tip by 0.01 mm, so few links by 5 mm of 100: this arm is a robot of its own, no converged one."""
RECORDINGS = tuple(f"recording_{k + 1}" for k in range(6))
AUDITED = 4  # recordings that an audit fits; it measures the gain in the others
NOISE = 5e-4  # m, of motion capture
ENGINE_ARM, MODEL_ARM = "arm.xml", "arm.toml"
INNER = (0.2, 0.8)  # shares of the ranges between which truths are drawn


@dataclass(frozen=True)
class Scene:
    """A robot and a task, of which targets are made.

    Attributes:
        robot: name of its description.
        task: keys of [training] that say what an episode is.
        evaluated: steps of training between evaluations, of which the best has the policy that is kept.
        ranges: uniform priors of the body's parameters, in SI units.
        commands: keys of [commands] of a recording, whose names and blindness are added.
        simulated: table [simulator] of model and target.
        finer: what the target's table [simulator] has besides.
        flawed: cables on which an unknown law acts, each with a size of its own.
        laws: that are drawn from.
    """

    robot: str
    task: Mapping[str, Any]
    evaluated: int
    ranges: Mapping[str, tuple[float, float]]
    commands: Mapping[str, float]
    simulated: Mapping[str, Any] = field(default_factory=dict)
    finer: Mapping[str, Any] = field(default_factory=dict)
    flawed: int = 1
    laws: tuple[type[CableEffect], ...] = LAWS


SCENES = {
    "reach": Scene(
        "smooth_arm",
        {"task": "TrunkReach-v0", "goals": [[-0.04, -0.05, 0.14], [0.04, 0.02, 0.17]]},
        50_000,
        {"young_modulus": (1e6, 4e6), "trunk_mass": (0.04, 0.18), "rayleigh_stiffness": (0.01, 0.15)},
        {"duration": 5.0, "interval": 0.05, "step": 0.005, "low": 0.0, "high": 0.02, "sample_time": 0.05},
        finer={"refine": 2, "time_step": 0.005},
    ),
    # Recorded before the cube is put there; its mass and its friction are known, and nominal. The other laws grow with
    # commands, which are up to 70 mm here: with the usual crosstalk no training of a target learns to push.
    "push": Scene(
        "virtual_trunk",
        {
            "task": "TrunkPush-v0",
            "start": {"cube_x": [-0.005, 0.005], "cube_z": [0.095, 0.105], "cube_yaw": [-0.1, 0.1]},
        },
        100_000,
        {"young_modulus": (3e6, 7e6), "trunk_mass": (0.2, 0.6), "rayleigh_stiffness": (0.01, 0.15)},
        {"duration": 3.0, "interval": 0.05, "step": 0.005, "low": 0.0, "high": 0.04, "sample_time": 0.05},
        simulated={"integrator": "euler"},
        flawed=4,
        laws=(HystereticCable,),
    ),
}


def make_target(kind: str, seed: int, out: Path, scene: str = "reach") -> dict[str, Path]:
    """Draw a target, and write its files and recordings.

    A folder that holds a target keeps it, since another library of mechanisms draws another target from the same seed;
    its recordings are written again.

    Args:
        kind: "library", three mechanisms of the library, sizes drawn from their priors; "unknown", one or two laws
            that the library lacks, each of as many cables as the scene says, as large as usual to twice as large; or
            "mujoco", an arm that MuJoCo moves with two effects of its own, as large. Only the arm that reaches can be
            made in MuJoCo.
        seed: of all that is drawn: the same seed makes the same target.
        out: folder to write to.
        scene: a name of `SCENES`.

    Returns:
        ``truth``, the scene's name and ``audit``: the experiment files of the target, of the fits and trainings, and of
        the audit. The last two have no part of the truth.

    Raises:
        InputError: unknown kind or scene, a trunk in MuJoCo, or a target whose recordings cannot be simulated.
    """
    out = output_folder(Path(out))
    files = {name: out / f"{name}.toml" for name in ("truth", scene, "audit")}
    if not all(path.exists() for path in files.values()):
        _draw(kind, seed, scene, files)
    _record(SCENES[scene], files["truth"], seed)
    return files


def _draw(kind: str, seed: int, scene: str, files: Mapping[str, Path]) -> None:
    """Draw a target and write its files."""
    model, chosen = draw_flaws(kind, seed, scene), SCENES[scene]
    truth, robot = (
        {"robot": chosen.robot, "simulator": {**chosen.simulated, **chosen.finer}, "model": model},
        chosen.robot,
    )
    if kind == "mujoco":
        truth, robot = _in_mujoco(chosen, model, files["truth"].parent)
        chosen = replace(chosen, robot=robot)
    training = {**chosen.task, "noise": NOISE}
    every = training | {"anneal": True, "evaluate_every": chosen.evaluated}
    training.pop("task")
    tables: dict[str, dict[str, Any]] = {
        "truth": truth | {"training": training},
        scene: _fitted(chosen, RECORDINGS, (), {"noise": "white"}) | {"training": every},
        "audit": _fitted(chosen, RECORDINGS[:AUDITED], RECORDINGS[AUDITED:], {})
        | {"noise": {"standard_deviation": NOISE}},
    }
    if kind == "mujoco":  # laws fit what the engines differ by, term after term: after an hour there was no end
        tables["audit"]["audit"] = {"ports": False}
    for name, path in files.items():
        write_text(path, describe({"robot": robot, "seed": seed, **tables[name]}))


def draw_flaws(kind: str, seed: int, scene: str = "reach") -> dict[str, Any]:
    """The table [model] of a target: its mechanisms, or MuJoCo's effects, and its true values; see `make_target`."""
    for name, known, what in ((kind, KINDS, "kind"), (scene, tuple(SCENES), "scene")):
        if name not in known:
            remedy = f"use {' or '.join(known)}"
            raise InputError(f"unknown {what} {name!r} of target", where="make_target", remedy=remedy)
    chosen, rng = SCENES[scene], np.random.default_rng([seed, KINDS.index(kind)])
    body = {name: low + (high - low) * rng.uniform(*INNER) for name, (low, high) in chosen.ranges.items()}
    if kind == "mujoco" and scene != "reach":
        raise InputError("only the arm that reaches is made in MuJoCo", where="make_target", remedy='scene = "reach"')
    drawn = {"library": _from_library, "unknown": _unknown, "mujoco": _of_mujoco}[kind]
    names, sizes = drawn(chosen, rng)
    return {"mechanisms": names, "fixed": {name: float(f"{v:.6g}") for name, v in {**body, **sizes}.items()}}


def _record(scene: Scene, truth: Path, seed: int) -> None:
    """Write the six recordings, which do not tell what made them, each of commands of its own."""
    noise = {"standard_deviation": NOISE}
    commands = {**scene.commands, "recordings": list(RECORDINGS), "blind": True}
    for recording in simulate(Model.read(truth), commands, noise=noise, seed=seed):
        recording.save(truth.parent / f"{recording.name}.nc")


def _fitted(scene: Scene, fit: tuple[str, ...], test: tuple[str, ...], model: Mapping[str, Any]) -> dict[str, Any]:
    data = {"format": "netcdf", "fit": [f"{name}.nc" for name in fit]}
    priors = {name: {"distribution": "Uniform", "low": low, "high": high} for name, (low, high) in scene.ranges.items()}
    return {
        "data": data | ({"test": [f"{name}.nc" for name in test]} if test else {}),
        **({"simulator": dict(scene.simulated)} if scene.simulated else {}),
        "model": {**model, "priors": priors},
    }


def _from_library(scene: Scene, rng: np.random.Generator) -> tuple[list[str], dict[str, float]]:
    """Names of mechanisms, and draws of all their parameters' priors; of the grid of one that has no prior size."""
    names = sorted(rng.choice(sorted(REGISTRY), FROM_LIBRARY, replace=False).tolist())
    sizes = {}
    for spec in (spec for mechanism in _made(scene, names) for spec in mechanism.parameters):
        prior = prior_from_table(spec, spec.prior, where=spec.name)
        drawn = prior.sample(jax.random.key(int(rng.integers(2**31))))
        sizes[spec.name] = float(rng.choice(spec.grid)) if spec.grid else float(drawn)
    return names, sizes


def _unknown(scene: Scene, rng: np.random.Generator) -> tuple[list[str], dict[str, float]]:
    """Names of laws, and the sizes of each at the cables on which it acts."""
    count = min(UNKNOWN, len(scene.laws))
    kinds: list[type[CableEffect]] = [scene.laws[k] for k in sorted(rng.choice(len(scene.laws), count, replace=False))]
    names = [f"{kind.__module__}:{kind.__qualname__}" for kind in kinds]
    sizes = {}
    for mechanism in _made(scene, names):
        left = list(mechanism.parameters)
        for _ in range(scene.flawed):
            spec = left.pop(int(rng.integers(len(left))))
            sizes[spec.name] = float(rng.uniform(*LARGER) * spec.prior["scale"])
    return names, sizes


def _of_mujoco(scene: Scene, rng: np.random.Generator) -> tuple[list[str], dict[str, float]]:
    """Names of effects that stand in a MuJoCo model, and their sizes."""
    known = sorted(name for name, effect in ENGINE_EFFECTS.items() if effect.model is not None)
    names = sorted(rng.choice(known, UNKNOWN, replace=False).tolist())
    return names, {name: float(rng.uniform(*LARGER) * ENGINE_EFFECTS[name].usual) for name in names}


def _in_mujoco(scene: Scene, drawn: Mapping[str, Any], out: Path) -> tuple[dict[str, Any], str]:
    """Write the arm as MuJoCo has it, and the robot of the models, which carries commands out at once as MuJoCo does;
    the tables of the target, and the robot's file."""
    robot = Robot.load(scene.robot).without_command_timing()
    values = drawn["fixed"]
    effects = {name: values[name] for name in drawn["mechanisms"]}
    write_arm(out / ENGINE_ARM, arm_xml(robot, values, ENGINE_LINKS, ENGINE_STEP), effects)
    write_text(out / MODEL_ARM, describe(robot.model_dump(mode="json", exclude_none=True, exclude_defaults=True)))
    adapter = {
        "start": "rest",
        "command_unit": robot.command_unit,
        "markers": {name: f"site/{name}" for name in robot.marker_names},
        "channels": {name: name for name in robot.channel_names},
    }
    return {"robot": ENGINE_ARM, "adapter": adapter, "model": {}}, MODEL_ARM


def _made(scene: Scene, names: list[str]) -> tuple[Mechanism, ...]:
    return mechanisms_named(names, Robot.load(scene.robot))
