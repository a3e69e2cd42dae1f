"""What makes a policy transfer: one training setting changed at a time, on a target of development; resumable.

    python benchmarks/transfer.py [--trainings 2] [--steps 600000] [--setting NAME ...] [--only-done]

The target is the virtual trunk with a lag and a hysteresis on four cables each (`fresh_targets`, scene "push", kind
"unknown", seed 1), which was used for development before. The model of all trainings knows which laws act, and infers
their sizes from the target's six recordings: what differs is the training alone. Each policy plays the same 200
episodes on the target. Writes ledger.jsonl and table.md into reports/fresh_targets/transfer; policies stay in the
ignored folder work beside them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd

from rfdropo_bayes.files import append_line, output_folder, read_lines, write_text
from rfdropo_bayes.model.experiment_file import describe, read_tables
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.model.run_folder import CHECKPOINTS, run_ended
from rfdropo_bayes.policies import training
from rfdropo_bayes.policies.evaluation import EVALUATION_SEED, draw_cases, play
from rfdropo_bayes.policies.training_config import TrainingOptions
from rfdropo_bayes.verbs.calibrate import calibrate
from rfdropo_bayes.verbs.evaluate import CSV, evaluate
from rfdropo_bayes.verbs.make_vec import make_vec
from rfdropo_bayes.verbs.train import train
from studies.fresh_targets import make_target
from studies.table2 import share_of

OUT = Path("reports/fresh_targets/transfer")
SCENE, KIND, SEED, TASK = "push", "unknown", 1, "TrunkPush-v0"
ROLLOUTS, EPISODES = 2_000, 200
WITHIN = (5.0, 10.0, 15.25)  # mm
RECURRENT = "a recurrent policy"
VARIANTS: dict[str, dict[str, Any]] = {
    "as it comes": {},
    "no noise in training": {"noise": 0.0},
    "noise of 2 mm in training": {"noise": 2e-3},
    "twice as wide as the posterior": {"width": 2.0},
    "the posterior's middle alone": {"width": 1e-3},
    "entropy bonus of 0.005": {"options": {"ent_coef": 0.005}},
    "input floor of 0.1 mm": {},
    RECURRENT: {},
}
"""Keys of [training] that differ from those of the fresh targets: 0.5 mm of noise, draws of the posterior."""
FLOORS = {"input floor of 0.1 mm": 1e-4}
"""What is added to the deviations of inputs in the place of 10 mm [m]: that of Stable-Baselines3."""


def prepared(work: Path) -> tuple[Path, Path]:
    """Experiment of the target, and of the model whose posterior its recordings give; both are made if they are not."""
    files = make_target(KIND, SEED, work / "target", SCENE)
    truth, fitted = read_tables(files["truth"]), read_tables(files[SCENE])
    names = truth["model"]["mechanisms"]
    own: dict[str, dict[str, Any]] = {
        name: {} for name in truth["model"]["fixed"] if name not in fitted["model"]["priors"]
    }
    fitted["model"] = {**fitted["model"], "mechanisms": names, "priors": {**fitted["model"]["priors"], **own}}
    fitted["inference"] = {"method": "laplace", "rollouts": ROLLOUTS}
    known, fit = files[SCENE].with_name("known.toml"), work / "fit"
    write_text(known, describe(fitted))
    if not run_ended(fit):
        calibrate(Model.read(known), out=fit, resume=(fit / CHECKPOINTS).exists())
    return files["truth"], known


def experiment(work: Path, known: Path, name: str, keys: Mapping[str, Any]) -> Path:
    """An experiment that trains under the posterior, with further keys of [training]."""
    tables = read_tables(known)
    tables.pop("data")
    tables["training"] |= {"randomisation": "posterior", "source": str((work / "fit").resolve()), **keys}
    tables["simulator"] = {**tables.get("simulator", {}), "precision": "float32"}
    path = known.with_name(f"{name}.toml")
    write_text(path, describe(tables))
    return path


def cell(work: Path, truth: Path, known: Path, variant: str, seed: int, steps: int) -> dict[str, Any]:
    """Train a policy and play it on the target."""
    name = f"{variant.replace(' ', '_')}_{seed}"
    model = Model.read(experiment(work, known, name, {"steps": steps, **VARIANTS[variant]}))
    if variant == RECURRENT:
        return recurrent_cell(model, Model.read(truth), seed)
    out = work / "policies" / name
    if not run_ended(out):
        with patch.object(training, "LEAST_SPREAD", FLOORS.get(variant, training.LEAST_SPREAD)):
            train(model, out, seed=seed, resume=(out / CHECKPOINTS).exists(), page=False)
    played = work / "evaluations" / name
    evaluate(
        Model.read(truth), [out], played, TrainingOptions(task=TASK), episodes=EPISODES, film=False, overwrite=True
    )
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    distance = pd.read_csv(played / CSV)["distance"].to_numpy(dtype=float)
    home = {key: 1e3 * summary["evaluation"][f"distance_{key}"] for key in ("median", "q95")}
    return {"home_mm": home, "seconds": round(summary["seconds"], 1), "distance_mm": millimetres(distance)}


def recurrent_cell(model: Model, target: Model, seed: int) -> dict[str, Any]:
    """The same of a recurrent policy, on the same episodes."""
    from recurrent_policy import Recalling, learnt

    table = model.settings.training
    policy, normalisation, row = learnt(make_vec(TASK, model, n=table.environments), table, seed)
    venv = make_vec(TASK, target)
    cases = draw_cases(venv, EPISODES, EVALUATION_SEED)
    episodes = play(Recalling(policy, normalisation, venv), venv, cases)
    return {**row, "distance_mm": millimetres(np.array([episode.distance for episode in episodes]))}


def millimetres(distance: np.ndarray) -> list[float]:
    """Distances as the ledger holds them."""
    return [round(1e3 * value, 3) for value in distance.tolist()]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Shares of episodes within each distance with 95 % intervals, by setting."""
    heads = ["setting", *(f"{mm:g} mm" for mm in WITHIN), "15.25 mm by training", "median [mm]", "medians at home [mm]"]
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for variant in VARIANTS:
        own = [row for row in rows if row["variant"] == variant]
        if not own:
            continue
        distance = np.array([row["distance_mm"] for row in own])
        shares = [share_of(distance <= mm) for mm in WITHIN]
        words = [f"{100 * s['share']:.0f} % [{100 * s['low']:.0f}, {100 * s['high']:.0f}]" for s in shares]
        single = ", ".join(f"{100 * share:.0f}" for share in (distance <= WITHIN[-1]).mean(axis=1))
        homes = ", ".join(f"{row['home_mm']['median']:.1f}" for row in own)
        lines.append(f"| {' | '.join([variant, *words, single, f'{np.median(distance):.1f}', homes])} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Go on with the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trainings", type=int, default=2)
    parser.add_argument("--steps", type=int, default=600_000)
    parser.add_argument("--setting", action="append", choices=VARIANTS, help="only these, in this order")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--only-done", action="store_true")
    given = parser.parse_args()
    ledger, work = output_folder(given.out) / "ledger.jsonl", given.out / "work"
    variants, seeds = given.setting or list(VARIANTS), range(given.trainings)
    jobs = [{"variant": variant, "seed": seed, "steps": given.steps} for seed in seeds for variant in variants]
    done = [{key: row[key] for key in jobs[0]} for row in read_lines(ledger)]
    left = [job for job in jobs if job not in done]
    if left and not given.only_done:
        truth, known = prepared(work)
        for job in left:
            append_line(ledger, json.dumps({**job, **cell(work, truth, known, **job)}))
    text = table([row for row in read_lines(ledger) if row["steps"] == given.steps])
    write_text(given.out / "table.md", text)
    print(text)


if __name__ == "__main__":
    main()
