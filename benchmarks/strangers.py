"""What does an audit find in the files of a laboratory that nobody knows? Arms, files and effects are drawn at random.

    python benchmarks/strangers.py SEED ... [--at-rest | --mujoco] [--out OUT] [--runs runs/strangers]

For each seed: an outline (length, taper, segments, cables, gravity), recordings of it under random commands with an
effect of the library hidden, and CSV files in units and a frame of their own; with --at-rest poses without times.
Then the commands of the README are typed, from init to audit, and a line of OUT/ledger.jsonl says what was hidden and
what the audit named. A seed whose line is there is not run again; a command that fails is a verdict, too. The
recordings come from our engine, with shorter time steps or elements than init chooses, or with --mujoco from 25 rigid
links that MuJoCo moves. An arm in motion takes 3 to 20 minutes of a processor, at rest 1 to 5 (yardstick 2.4).
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import shlex
import shutil
import subprocess
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
from fifteen_minutes import typed

import rfdropo_bayes as rb
from rfdropo_bayes.files import append_line, read_lines
from studies.mujoco_truth import CONTROL, ENGINE_EFFECTS, EngineEffect, MuJoCoArm

NOTHING = "nothing"


def late(levels: np.ndarray, size: float) -> np.ndarray:
    """Commands that come ``size`` [s] late."""
    periods = min(round(size / CONTROL), len(levels) - 1)
    return np.concatenate([np.repeat(levels[:1], periods, axis=0), levels[: len(levels) - periods]])


def with_play(levels: np.ndarray, size: float) -> np.ndarray:
    """Drives with a play of width ``size`` [m], which begin in its middle."""
    found = [levels[0]]
    for row in levels[1:]:
        found.append(np.clip(found[-1], row - 0.5 * size, row + 0.5 * size))
    return np.array(found)


EFFECTS = (
    NOTHING,
    "command_delay",
    "actuator_lag",
    "cable_gain",
    NOTHING,
    "cable_slack",
    "backlash",
    "payload",
    "stiffness_gradient",
    NOTHING,
    "base_tilt",
    "base_compliance",
    "viscoelasticity",
    "coulomb_friction",
    NOTHING,
    "capstan_friction",
    "softening",
    "plane_anisotropy",
    "marker_offset",
    NOTHING,
    "camera_scale",
    "clock_offset",
    "drive_zero_drift",
    "cable_gain_drift",
)
"""Hidden in turn, by seed, and nothing in one arm of five. `init` has none of them in its model but for the tilt, if an
arm lies."""
EFFECTS_AT_REST = (
    NOTHING,
    "cable_gain",
    "payload",
    "stiffness_gradient",
    NOTHING,
    "base_tilt",
    "cable_compliance",
    "camera_scale",
    "guide_azimuth",
    NOTHING,
    "soft_part",
    "base_compliance",
    "backlash",
    "marker_offset",
    NOTHING,
    "capstan_friction",
    "fibre_law",
    "cable_slack",
    "plane_anisotropy",
)
"""The same for poses at rest."""
BY_COMMANDS = {
    "command_delay": EngineEffect(("command_delay",), 0.02, "s", command=late),
    "backlash": EngineEffect(("backlash",), 1e-3, "m", command=with_play),
}
IN_MUJOCO = {effect.right[0]: effect for effect in ENGINE_EFFECTS.values()} | BY_COMMANDS
EFFECTS_IN_MUJOCO = (
    NOTHING,
    "command_delay",
    "payload",
    "backlash",
    "cable_gain",
    "actuator_lag",
    NOTHING,
    "stiffness_gradient",
    "clock_offset",
    "cable_compliance",
)
"""The same for 25 links in MuJoCo, by its means: masses, stiffnesses, tendons, actuators."""
LINKS, STEP = 25, 2.5e-4  # of MuJoCo; 40 links and .5 ms move a marker by .01 to .3 mm, of a slender cone by 1 mm
TAUT = 100.0  # stiffness of its cables in that of the arm along its axis
HIDDEN = {"motion": EFFECTS, "at_rest": EFFECTS_AT_REST, "mujoco": EFFECTS_IN_MUJOCO}
SIZE = 3.0  # root mean square of what an effect moves the markers by, in deviations of the noise
NEAR = 0.2  # relative tolerance of it
TRIES = 8  # of the search for a size
MINUTES = 15  # of an audit, at most


class Laboratory(NamedTuple):
    """An arm and how it is recorded.

    Attributes:
        outline: arguments of `Robot.outline`.
        rests: whether poses at rest are recorded, instead of motion.
        damping: stiffness damping [s].
        ramp: time that drives take for a change [s], which the laboratory writes into the robot file.
        walk: random commands; at rest the number of poses in a file, and the largest pull [m].
        noise: standard deviation of positions [m].
        unit: of commands: "mm", "deg" or "counts"; spool: radius [m] of the spools.
    """

    outline: dict[str, Any]
    rests: bool
    damping: float
    ramp: float
    walk: dict[str, Any]
    noise: float
    unit: str
    spool: float

    @property
    def robot(self) -> rb.Robot:
        """The arm, whose drives take `ramp` for a change in motion."""
        arm = rb.Robot.outline(name="arm", **self.outline)
        ramp = {"ramp_s": 0.0 if self.rests else self.ramp}
        return arm.with_changes(command=arm.command.model_copy(update=ramp))

    def commands(self, seed: int) -> Sequence[rb.Trajectory] | dict[str, Any]:
        """Random commands; at rest each segment bends into a random direction, by what its cables there can."""
        if not self.rests:
            return self.walk
        robot, rng, runs = self.robot, np.random.default_rng([seed, 4]), []
        time, segments = np.arange(float(self.walk["poses"])), self.outline["segments"]
        azimuth = np.deg2rad([cable.azimuth_deg for cable in robot.cables]).reshape(1, segments, -1)
        for name in "01":
            towards = rng.uniform(0.0, 2.0 * np.pi, (len(time), segments, 1))
            bend = rng.uniform(0.0, self.walk["high"], towards.shape)
            run = rb.Trajectory.from_arrays(
                time=time,
                position=np.tile(robot.marker_points(), (len(time), 1, 1)),  # until they are simulated
                command=(bend * np.maximum(np.cos(azimuth - towards), 0.0)).reshape(len(time), -1),
                command_time=time - 0.5,
                markers=robot.marker_names,
                channels=robot.channel_names,
                name=name,
            )
            runs.append(run)
        return runs


def draw_laboratory(rng: np.random.Generator, rests: bool) -> Laboratory:
    """Draw an arm that bears itself, moves at 1 to 4 Hz, and follows commands within its bending range.

    At rest it takes 120 to 320 poses in two files, whose cables bend a segment by .8 to 1.8 rad.
    """
    length = float(np.exp(rng.uniform(np.log(0.08), np.log(0.6))))
    radius, cone = length * float(rng.uniform(0.03, 0.09)), bool(rng.random() < 0.5)
    gravity = str(rng.choice(["+z", "+z", "-z", "+x", "-y"]))
    mass = float(np.pi * radius**2 * length * rng.uniform(750.0, 1180.0)) * (0.58 if cone else 1.0)
    area_moment, line = np.pi * radius**4 / 4.0, mass / length
    frequency = float(np.exp(rng.uniform(np.log(1.0), np.log(4.0))))
    # A cantilever of this frequency; of a third of the weight under which it buckles, or an eighth of L^3 / (E I).
    by_motion = (2.0 * np.pi * frequency / 3.516) ** 2 * line * length**4 / area_moment
    by_weight = line * 9.81 * length**3 / (3.0 if gravity == "-z" else 8.0) / area_moment
    segments, markers = int(rng.choice([1, 1, 2])), int(rng.integers(1, 4))
    heights = [*np.sort(rng.uniform(0.3, 0.85, markers - 1)), 1.0]
    outline = {
        "length": length,
        "radius": radius,
        "segments": segments,
        "cables": int(rng.choice([3, 4])),
        "shape": "cone" if cone else "cylinder",
        "gravity": gravity,
        "mass": mass,
        "markers": {f"m{k + 1}": float(length * h) for k, h in enumerate(heights)},
        "young_modulus": max(by_motion, by_weight),
        **({"tip_radius": 0.5 * radius} if cone else {}),
    }
    most = 0.12 * length * float(rng.uniform(0.5, 1.0)) / segments
    rate, number = float(rng.choice([20.0, 30.0, 50.0])), int(rng.choice([3, 4]))
    walk = {
        "duration": float(rng.choice([8.0, 12.0])),
        "interval": float(rng.choice([0.3, 0.5])),
        "step": 0.35 * most,
        "low": 0.0,
        "high": most,
        "sample_time": 1.0 / rate,
        "recordings": [str(k) for k in range(number)],
    }
    if rests:
        bend = float(rng.uniform(0.8, 1.8)) * 0.75 * radius * (0.75 if cone else 1.0)
        walk = {"poses": int(rng.choice([60, 100, 160])), "high": bend}
    noise = length * float(np.exp(rng.uniform(np.log(5e-4), np.log(2e-3))))
    unit, spool = str(rng.choice(["mm", "counts", "deg"])), float(rng.uniform(0.006, 0.02))
    damping, ramp = float(rng.uniform(0.02, 0.08)), round(float(rng.uniform(0.05, 0.15)), 3)
    return Laboratory(outline, rests, damping, ramp, walk, noise, unit, spool)


class Recorded(NamedTuple):
    """Recordings, measured positions [m] of each, true values, and the share of `SIZE` that the effect has."""

    runs: Sequence[rb.Trajectory]
    positions: list[np.ndarray]
    truth: dict[str, float]
    size: float


def noisy(own: Laboratory, positions: Sequence[np.ndarray], seed: int) -> list[np.ndarray]:
    """Positions [m] of each recording as they are measured."""
    keys = [jax.random.fold_in(jax.random.key(seed), number) for number in range(len(positions))]
    errors = [jax.random.normal(key, each.shape) for key, each in zip(keys, positions, strict=True)]
    return [each + own.noise * np.asarray(error) for each, error in zip(positions, errors, strict=True)]


def record_in_mujoco(own: Laboratory, effect: str, seed: int) -> Recorded | None:
    """The same with the arm in MuJoCo; the size of an effect is looked for in the first recording."""
    base = {"young_modulus": own.outline["young_modulus"]}
    plain = rb.Model(own.robot, priors={"young_modulus": {}}, fixed={"rayleigh_stiffness": own.damping})
    runs = rb.simulate(plain, own.walk, parameters=base, seed=seed)
    along = base["young_modulus"] * np.pi * own.outline["radius"] ** 2 / own.outline["length"]
    values = base | {"trunk_mass": own.outline["mass"], "rayleigh_stiffness": own.damping}
    hidden, size = None if effect == NOTHING else IN_MUJOCO[effect], 0.0
    arm = MuJoCoArm(own.robot, values, hidden, links=LINKS, step=STEP, cable_stiffness=TAUT * along, settled=True)
    share = 0.0
    if hidden is not None:
        still, size = arm.positions(runs[:1], 0.0), hidden.usual
        for _ in range(TRIES):
            share = float(np.sqrt(np.mean((arm.positions(runs[:1], size) - still) ** 2))) / own.noise / SIZE
            if abs(share - 1.0) < NEAR:
                break
            size *= float(np.clip(1.0 / max(share, 1e-9), 0.1, 8.0))
        else:
            return None
    return Recorded(runs, noisy(own, [*arm.positions(runs, size)], seed), base | {"size": size}, share)


def record(own: Laboratory, effect: str, seed: int, kind: str) -> Recorded | None:
    """Recordings with an effect that moves the markers by `SIZE` deviations of the noise; None if no size does."""
    if kind == "mujoco":
        return record_in_mujoco(own, effect, seed)
    rng, arm, commands = np.random.default_rng([seed, 2]), own.robot, own.commands(seed)
    settings: dict[str, Any] = {
        "priors": {"young_modulus": {}},
        "simulator": {"motion": "quasi-static", "refine": 4} if own.rests else {"time_step": 0.004},
        "fixed": {} if own.rests else {"rayleigh_stiffness": own.damping},
    }
    base, plain = {"young_modulus": own.outline["young_modulus"]}, rb.Model(arm, **settings)
    still = rb.simulate(plain, commands, parameters=base, seed=seed)

    def recorded(runs: Sequence[rb.Trajectory], values: dict[str, float], size: float) -> Recorded:
        return Recorded(runs, noisy(own, [run.position for run in runs], seed), values, size)

    if effect == NOTHING:
        return recorded(still, base, 0.0)
    model = rb.Model(arm, mechanisms=[effect], **settings)
    priors = {n: p for n, p in model.parameters.prior.items() if p is not None and n not in plain.parameters.index}
    signs, factor = {name: float(rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.0)) for name in priors}, 1.0
    for _ in range(TRIES):
        values = base | {name: drawn(prior, signs[name], factor) for name, prior in priors.items()}
        try:
            moved = rb.simulate(model, commands, parameters=values, seed=seed)
        except rb.InputError:  # beyond what the arm bears
            factor *= 0.3
            continue
        change = np.concatenate([(a.position - b.position).ravel() for a, b in zip(moved, still, strict=True)])
        size = float(np.sqrt(np.mean(change**2))) / own.noise / SIZE
        if abs(size - 1.0) < NEAR:
            return recorded(moved, values, size)
        factor = float(np.clip(factor * np.clip(1.0 / max(size, 1e-9), 0.1, 8.0), 1e-3, 8.0))
    return None


def drawn(prior: dict[str, Any], sign: float, factor: float) -> float:
    """A value of a parameter: ``factor`` deviations of its prior from the null, or the middle of a scale's prior."""
    if prior["distribution"] == "LogNormal":
        return float(prior["median"])
    if prior["distribution"] == "Uniform":
        return float(0.5 * (prior["low"] + prior["high"]))
    one_sided = prior["distribution"] == "HalfNormal"
    return float(prior.get("loc", 0.0) + (abs(sign) if one_sided else sign) * factor * prior["scale"])


def write_files(own: Laboratory, recorded: Recorded, seed: int, folder: Path) -> str:
    """Write CSV files in a frame and units of the laboratory; the options of ``rfdropo init``."""
    rng = np.random.default_rng([seed, 3])
    turn = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)
    turn[0] *= np.sign(np.linalg.det(turn))
    clamp, turns = rng.uniform(-500.0, 500.0, 3), 1.0 / (2.0 * np.pi * own.spool)
    scales = {"mm": 1e3, "deg": 360.0 * turns, "counts": 4096.0 * turns}
    folder.mkdir(parents=True)
    for number, (run, position) in enumerate(zip(recorded.runs, recorded.positions, strict=True), 1):
        # A moving arm carries a command out after its row; a pose is what has come of it.
        levels = np.vstack([run.initial_command, run.command])
        row = np.searchsorted(run.command_time, run.time + (-1e-9 if own.rests else 1e-9))
        sent = (levels[row] * scales[own.unit]).round(0 if own.unit == "counts" else 3)
        frame = pd.DataFrame({} if own.rests else {"time": run.time.round(5)})
        for motor, column in enumerate(sent.T, 1):
            frame[f"motor{motor}_{own.unit}"] = column
        seen = (1e3 * position @ turn.T + clamp).round(3)
        for marker, name in enumerate(own.outline["markers"]):
            frame[[f"{name}_{axis}" for axis in "xyz"]] = seen[:, marker]
        frame.to_csv(folder / f"rec{number:02d}.csv", index=False)
    told = own.outline
    options = {
        "length-mm": f"{1e3 * told['length']:.6g}",
        "radius-mm": f"{1e3 * told['radius']:.3g}",
        "segments": told["segments"],
        "cables": told["cables"],
        "mass-g": f"{1e3 * told['mass']:.3g}",
        "gravity": told["gravity"],
        "shape": told["shape"],
        "markers": ",".join(f"{name}={1e3 * height:.6g}" for name, height in told["markers"].items()),
    }
    options |= {"tip-radius-mm": f"{1e3 * told['tip_radius']:.3g}"} if "tip_radius" in told else {}
    options |= {"counts-per-turn": 4096} if own.unit == "counts" else {}
    options |= {"spool-radius-mm": f"{1e3 * own.spool:.4g}"} if own.unit != "mm" else {}
    return " ".join(f"--{name}={value}" for name, value in options.items())


def audited(seed: int, effect: str, kind: str, folder: Path) -> dict[str, Any]:
    """Draw, record, type the README's commands; what was hidden and what was said."""
    own = draw_laboratory(np.random.default_rng([seed, 1]), kind == "at_rest")
    recorded = record(own, effect, seed, kind)
    if recorded is None:
        return {"hidden": effect, "verdict": "unreached", "sentence": "no size moves it enough"}
    options = write_files(own, recorded, seed, folder / "data")
    steps = [typed(f'rfdropo init arm --recording "data/*.csv" {options} --defaults', folder)]
    robot = folder / "arm/arm.toml"
    text = robot.read_text(encoding="utf-8")
    robot.write_text(text.replace("ramp_s = 0.0", f"ramp_s = {own.ramp}"), encoding="utf-8")
    commands = (
        "rfdropo check arm/experiment.toml",
        "rfdropo calibrate arm/experiment.toml --out runs/arm",
        f"rfdropo audit arm/experiment.toml --from runs/arm --out runs/audit --set audit.minutes={MINUTES}",
    )
    steps += [typed(command, folder) for command in commands]
    audit = json.loads((folder / "runs/audit/audit.json").read_text(encoding="utf-8"))
    summary = json.loads((folder / "runs/arm/summary.json").read_text(encoding="utf-8"))
    base = tomllib.loads((folder / "arm/experiment.toml").read_text(encoding="utf-8"))["model"]["mechanisms"]
    first = next((finding["equivalence_class"] for finding in audit["findings"]), [])
    silent = audit["verdict"] == "no_discrepancy"
    return {
        "hidden": effect,
        "right": silent if effect in (NOTHING, *base) else effect in first,
        "rests": own.rests,
        "base": base,
        "share_of_size": round(recorded.size, 3),
        "truth": recorded.truth,
        "outline": own.outline,
        "walk": own.walk,
        "noise": own.noise,
        "damping": own.damping,
        "ramp": own.ramp,
        "unit": own.unit,
        "verdict": audit["verdict"],
        "named": [finding["mechanism"] for finding in audit["findings"]],
        "classes": [finding["equivalence_class"] for finding in audit["findings"]],
        "sizes": [] if kind == "mujoco" else sizes_beside_truth(audit, own, effect, recorded.truth),
        "parameters": {finding["mechanism"]: finding["parameters"] for finding in audit["findings"]},
        "sentence": audit["sentence"],
        "fit_mm": [*summary["rmse"]["fit"].values()][-1],
        "test_mm": [*summary["rmse"]["test"].values()][-1],
        "draws": summary["effective_draws"],
        "randomisation": summary["randomisation"]["verdict"],
        "wall_s": {shlex.split(step.command)[1]: round(step.wall) for step in steps},
        "processor_s": {shlex.split(step.command)[1]: round(step.cpu) for step in steps},
    }


def sizes_beside_truth(audit: dict[str, Any], own: Laboratory, effect: str, truth: dict[str, float]) -> list[Any]:
    """Named sizes of the hidden effect: mean, 90 % interval and truth, in the form that the data show: over a power of
    Young's modulus, or less the median of the channels. Channels have other names and units in the files, and the same
    order.
    """
    rows, hidden = [], [name for name in truth if name != "young_modulus"]
    arm = rb.Robot.outline(name="arm", **own.outline)
    made = rb.Model(arm, priors={"young_modulus": {}}, mechanisms=[effect] if hidden else []).parameters.unit
    for finding in audit["findings"]:
        if finding["mechanism"] != effect:
            continue
        named = {}
        for name, (told, row) in zip(hidden, finding["parameters"].items(), strict=True):
            wound = row["unit"].startswith("rad") and made[name].startswith("m")
            named[told] = truth[name] / (own.spool if wound else 1.0)
        shown = {row["parameter"]: row for row in finding["relative"].values()}
        for name, row in (finding["parameters"] | shown).items():
            power, size = shown[name]["power"] if name in shown else None, named[name]
            size = size - np.median([*named.values()]) if power == 0 else size * truth["young_modulus"] ** -(power or 0)
            if row["sd"] > 0.0:
                interval = {key: row[key] for key in ("mean", "q05", "q95")}
                rows.append({"name": row["title"], "truth": float(size), **interval})
    return rows


def as_table(rows: Sequence[dict[str, Any]]) -> str:
    """The ledger as a Markdown table."""
    lines = [
        "| seed | arm and files | hidden | named | right | 90 % interval of the size, truth | CPU s |",
        "|---" * 7 + "|",
    ]
    for row in rows:
        arm, walk = row["outline"], row["walk"]
        rows_of = (
            f"2 of {walk['poses']} poses" if row["rests"] else f"{len(walk['recordings'])} of {walk['duration']:.0f} s"
        )
        cables = f"{arm['segments']}x{arm['cables']} cables, {arm['gravity']}"
        made = f"{1e3 * arm['length']:.0f} mm {arm['shape']}, {cables}, {rows_of} in {row['unit']}"
        hidden = row["hidden"].replace("_", " ") + (" (in the base model)" if row["hidden"] in row["base"] else "")
        found = "; ".join(", ".join(each) for each in row["classes"]).replace("_", " ")
        sizes = [f"[{each['q05']:.3g}, {each['q95']:.3g}], {each['truth']:.3g}" for each in row["sizes"]]
        cells = [row["seed"], made, hidden, f"`{row['verdict']}` {found}", "yes" if row["right"] else "no"]
        lines.append("| " + " | ".join(map(str, [*cells, "; ".join(sizes), sum(row["processor_s"].values())])) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the seeds that the ledger does not have yet, and write its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", nargs="+", type=int, metavar="SEED")
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument(
        "--at-rest", dest="kind", action="store_const", const="at_rest", default="motion", help="poses without times"
    )
    kinds.add_argument("--mujoco", dest="kind", action="store_const", const="mujoco", help="arms that MuJoCo moves")
    parser.add_argument("--out", type=Path, help="reports/strangers/motion, at_rest or mujoco by default")
    parser.add_argument("--runs", type=Path, default=Path("runs/strangers"))
    given = parser.parse_args()
    out = given.out or Path("reports/strangers") / given.kind
    ledger = out / "ledger.jsonl"
    ledger.parent.mkdir(parents=True, exist_ok=True)
    known = {line["seed"] for line in read_lines(ledger)}
    for seed in given.seeds:
        if seed not in known:
            folder = given.runs / given.kind / str(seed)
            shutil.rmtree(folder, ignore_errors=True)
            effect = HIDDEN[given.kind][seed % len(HIDDEN[given.kind])]
            try:
                row = audited(seed, effect, given.kind, folder)
            except subprocess.CalledProcessError as error:
                said = f"failed: {shlex.join(error.cmd[3:])}"
                row = {"hidden": effect, "verdict": "failed", "right": False, "sentence": said}
            append_line(ledger, json.dumps({"seed": seed, **row}))
            print(f"{seed}: {row['hidden']} is hidden; {row['sentence']}", flush=True)
    found = [line for line in read_lines(ledger) if "outline" in line]
    (out / "table.md").write_text(as_table(found), encoding="utf-8")


if __name__ == "__main__":
    main()
