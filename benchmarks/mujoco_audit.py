"""Effects hidden in a MuJoCo arm by MuJoCo's own means, audited with the same MuJoCo file without them; resumable.

    python benchmarks/mujoco_audit.py [--out reports/audit_mujoco] [--seeds 0,1] [--effects friction,late_camera]

The arm of `mujoco_sysid.py`: three joints with gravity, motors, markers at elbow and tip. What is hidden is written
with MuJoCo alone, see `EFFECTS`; the audit reads the file as it is and infers the damping of each joint and the mass of
the last link. Three repeats and two other recordings are fitted, three are untouched; noise of 0.3 mm a coordinate. One
line of the ledger for each data set; a data set in the ledger is not run again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import rollout
from mujoco_sysid import ARM, NOISE, PARAMETERS, STEP, TRUTH, changed

import rfdropo_bayes as rb
from rfdropo_bayes.discrepancy.verdict import DESCRIBED
from rfdropo_bayes.files import append_line, read_lines

REPEATS, OTHERS, UNTOUCHED = 3, 2, 3
SECONDS, HOLD = 3.0, 0.2  # of a recording, and of one level of the torques [s]
LEVEL = 0.8  # largest torque [N m]
STRIDE = 4  # steps from one row to the next
TORQUES = ("m1", "m2", "m3")
MARKERS = ("elbow", "tip")


class Effect(NamedTuple):
    """What is hidden, and what names it.

    Attributes:
        change: of the compiled model.
        torques: what becomes of the torques (step, motor) on their way.
        late: that the camera's clock is behind [s].
        mechanisms: any of which names it; their beginnings.
        ports: where it enters, if no mechanism names it.
    """

    change: Callable[[Any], None] = lambda model: None
    torques: Callable[[np.ndarray], np.ndarray] = lambda torques: torques
    late: float = 0.0
    mechanisms: tuple[str, ...] = ()
    ports: tuple[str, ...] = ()


def _friction(model: Any) -> None:
    model.dof_frictionloss[1] = 0.03


def _spring(model: Any) -> None:
    model.jnt_stiffness[2] = 0.4


def _gravity(model: Any) -> None:
    model.opt.gravity[0] = 0.3


def _load(model: Any) -> None:
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "two")
    model.body_mass[body] += 0.06


def _weak(model: Any) -> None:
    model.actuator_gainprm[1, 0] *= 0.92


def _moved(model: Any) -> None:
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "tip")
    model.site_pos[site, 0] += 0.003


def _tiring(torques: np.ndarray) -> np.ndarray:
    """Motor m1 loses 2.5 % of its torque each second."""
    fading = 1.0 - 0.025 * STEP * np.arange(len(torques))
    return np.column_stack([fading * torques[:, 0], torques[:, 1:]])


def _coupled(torques: np.ndarray) -> np.ndarray:
    """The product of m1 and m3 acts on m2, which no mechanism of the library has."""
    return np.column_stack([torques[:, 0], torques[:, 1] + 0.15 * torques[:, 0] * torques[:, 2], torques[:, 2]])


LATE = ("command_delay", "observation_delay", "clock_offset")

EFFECTS = {
    "nothing": Effect(),
    "friction": Effect(_friction, mechanisms=("joint_frictionloss",)),
    "spring": Effect(_spring, mechanisms=("joint_stiffness",)),
    "tilted_gravity": Effect(_gravity, mechanisms=("gravity", "option_gravity", "base_tilt")),
    "load": Effect(_load, mechanisms=("body_mass",)),
    "weak_motor": Effect(_weak, mechanisms=("actuator_gain", "cable_gain", "command_gain")),
    "moved_marker": Effect(_moved, mechanisms=("marker_offset", "site_pos")),
    "late_camera": Effect(late=0.02, mechanisms=LATE),
    "late_commands": Effect(
        torques=lambda torques: np.concatenate([np.repeat(torques[:1], 4, axis=0), torques[:-4]]), mechanisms=LATE
    ),
    "tiring_motor": Effect(torques=_tiring, ports=("cable m1",)),
    "coupled_motors": Effect(torques=_coupled, ports=("cable m2",)),
}


def recorded(effect: Effect, seed: int, noise: int, name: str) -> tuple[rb.Trajectory, np.ndarray]:
    """A recording, and the same positions without noise (row, marker, 3)."""
    model = changed(TRUTH)
    effect.change(model)
    levels = np.random.default_rng(seed).uniform(-LEVEL, LEVEL, (round(SECONDS / HOLD), 3))
    torques = np.repeat(levels, round(HOLD / STEP), axis=0)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    seen = rollout.rollout(model, mujoco.MjData(model), state, effect.torques(torques))[1][0]
    shift = round(effect.late / STEP)
    clean = np.concatenate([np.repeat(seen[:1], shift, axis=0), seen])[: len(seen)].reshape(-1, 2, 3)[::STRIDE]
    run = rb.Trajectory.from_arrays(
        time=STEP * STRIDE * np.arange(len(clean)),
        position=clean + NOISE * np.random.default_rng([seed, noise]).standard_normal(clean.shape),
        command=levels,
        command_time=HOLD * np.arange(len(levels)),
        markers=MARKERS,
        channels=TORQUES,
        command_unit="N m",
        initial_command="first",
        name=name,
    )
    return run, clean


def audited(name: str, seed: int, path: Path) -> dict[str, Any]:
    """A data set and what its audit says."""
    effect, base = EFFECTS[name], 1000 * (seed + 1)
    commands = [base] * REPEATS + [base + 1 + k for k in range(OTHERS)]
    runs = [recorded(effect, command, k, f"fit_{k}")[0] for k, command in enumerate(commands)]
    unseen = [recorded(effect, base + 100 + k, 0, f"unseen_{k}") for k in range(UNTOUCHED)]
    noise = np.sqrt(np.mean([np.sum((run.position[:, -1] - clean[:, -1]) ** 2, -1) for run, clean in unseen]))
    arm = rb.MuJoCo(path, markers=list(MARKERS), parameters=dict(PARAMETERS))
    model = rb.Model(arm, priors={parameter: {} for parameter in PARAMETERS}, noise="white")
    began, used = time.monotonic(), time.process_time()
    found = rb.audit(model, runs, test=[run for run, _ in unseen], seed=seed)
    content = found.content
    gain = content["gain"] or {}
    return {
        "effect": name,
        "seed": seed,
        "verdict": found.verdict,
        "named": [finding["mechanism"] for finding in content["findings"]],
        "alike": sorted({other for finding in content["findings"] for other in finding["equivalence_class"]}),
        "law": content["law"] or {},
        "explained": gain.get("explained_fraction"),
        "noise_mm": round(1e3 * float(noise), 4),
        "sentence": found.sentence,
        "seconds": round(time.monotonic() - began, 1),
        "cpu_seconds": round(time.process_time() - used, 1),
    }


def rightly(line: dict[str, Any]) -> bool:
    """Whether an audit names what is hidden, or finds its port; of nothing, whether it is silent."""
    effect = EFFECTS[line["effect"]]
    if not effect.mechanisms and not effect.ports:
        return line["verdict"] in ("no_discrepancy", "negligible")
    at = [term["port"] for term in line["law"].get("terms", [])]
    by_name = any(name.startswith(start) for name in [*line["named"], *line["alike"]] for start in effect.mechanisms)
    return by_name or any(port in effect.ports for port in at)


def table(lines: list[dict[str, Any]]) -> str:
    """The ledger as Markdown."""
    rows = ["| hidden | seed | verdict | named or described | right | CPU s |", "|---|---|---|---|---|---|"]
    for line in lines:
        law, told = line["law"].get("terms", []), list(line["named"])
        at = [term["port"].replace("cable", "actuator") for term in law]  # as sentences say it; files keep their keys
        if line["verdict"] == DESCRIBED:
            told += [f"{port}: {term['feature']}" for port, term in zip(at, law, strict=True)]
        elif law:  # not adopted, as unseen recordings do not support its form
            told.append(f"something at {at[0]}")
        told = ", ".join(told) or "-"
        right = "yes" if rightly(line) else "no"
        effect, told = (words.replace("_", " ") for words in (line["effect"], told))
        cells = [effect, str(line["seed"]), f"`{line['verdict']}`", told, right, f"{line['cpu_seconds']:.0f}"]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join([*rows, ""])


def main() -> None:
    """Run what the ledger lacks, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("reports/audit_mujoco"))
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--effects", default=",".join(EFFECTS))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    ledger = given.out / "ledger.jsonl"
    lines = read_lines(ledger)
    done = {(line["effect"], line["seed"]) for line in lines}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(ARM)
        for seed in map(int, given.seeds.split(",")):
            for name in given.effects.split(","):
                if (name, seed) in done:
                    continue
                lines.append(audited(name, seed, path))
                append_line(ledger, json.dumps(lines[-1]))
                print(json.dumps(lines[-1]), flush=True)
    (given.out / "table.md").write_text(table(lines))
    print(table(lines))


if __name__ == "__main__":
    main()
