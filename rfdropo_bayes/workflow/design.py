"""``rfdropo design``: the next command sequence, as a CSV, and what it will decide."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from rfdropo_bayes.audit.experiment_design import Hypothesis, Outlook, at_hand, best, outlooks
from rfdropo_bayes.audit.extension import DISCRETISATION, Inquiry
from rfdropo_bayes.audit.pipeline import base_model
from rfdropo_bayes.audit.screen import Look
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.data.plain_csv import command_columns
from rfdropo_bayes.simulators.commands import Commands, stack_commands
from rfdropo_bayes.workflow.assembly import load_data
from rfdropo_bayes.workflow.audit import build_question
from rfdropo_bayes.workflow.experiment import load_experiment
from rfdropo_bayes.workflow.files import output_folder

COMMANDS, DESIGN = "next_commands.csv", "design.json"
SEQUENCES, HYPOTHESES = 24, 4


def run_design(
    path: Path,
    out: Path,
    *,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    overwrite: bool = False,
    report: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Propose the commands that best separate the leading explanations of an experiment's recordings.

    The proposals stay within the range of commands that the recordings have used, are as long as the first recording
    and of four kinds: random walks, holds, slow loops and chirps. Where no candidate is significant, the sequence that
    tells most about the base parameters is proposed.

    Returns:
        the content of design.json.

    Raises:
        InputError: bad input.
    """
    experiment, _ = load_experiment(path, overrides)
    folder = Path(path).resolve().parent
    fitted = load_data(experiment, folder, "fit")
    question = build_question(experiment, folder, fitted, [], experiment.seed if seed is None else seed)
    out = output_folder(out)
    rng = np.random.default_rng(question.seed)
    target, base = base_model(question, question.seed)
    inquiry = Inquiry(target, question.candidates, question.rules, question.seed)
    found, _ = inquiry.look_at(base)
    hypotheses = _hypotheses(inquiry, found, report)
    first = fitted[0]
    proposals = list(_proposals(first, fitted, rng))
    simulator = question.lanes.simulator
    sequences = [simulator.commands(t, v, first.initial_command, first.time) for _, t, v in proposals]
    shaped = _shaped(sequences, question.recordings.commands)
    outlook = outlooks(target, base, hypotheses, shaped)
    chosen = best(outlook, len(hypotheses) > 1)
    kind, time, value = proposals[chosen]
    if experiment.data is not None and experiment.data.columns is not None:
        columns = command_columns(experiment.data.columns, time, value)
    else:
        columns = {"time_s": time} | {f"{c}_{first.command_unit}": value[:, k] for k, c in enumerate(first.cable_names)}
    pd.DataFrame(columns).to_csv(out / COMMANDS, index=False, float_format="%.6f")
    now = at_hand(target, hypotheses)
    content = {
        "sentence": _sentence(kind, outlook[chosen], now),
        "commands": str(out / COMMANDS),
        "kind": kind,
        "hypotheses": [h.name for h in hypotheses],
        "separation_now": {" / ".join(pair): value for pair, value in now.items()},
        "separation_with_it": {" / ".join(pair): value for pair, value in outlook[chosen].pairs.items()},
        "probability_of_the_right_decision": outlook[chosen].right if len(hypotheses) > 1 else None,
        "information_gain_nats": outlook[chosen].information,
        "tried": [
            {"kind": k, "separation": o.separation, "information_nats": o.information}
            for (k, _, _), o in zip(proposals, outlook, strict=True)
        ],
        "seed": question.seed,
        "schema_version": 1,
    }
    (out / DESIGN).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return content


def _hypotheses(inquiry: Inquiry, found: Look, report: Callable[[str], None]) -> list[Hypothesis]:
    """The leading significant candidates, each refitted."""
    rows = [row for row in found.rows if row.adjusted_p <= inquiry.rules.family and row.name != DISCRETISATION]
    hypotheses = []
    for row in rows[: 2 * HYPOTHESES]:
        hypotheses.append(Hypothesis(row.name, inquiry.refit(found.fit, row)))
        report(f"hypothesis {row.name}")
    hypotheses.sort(key=lambda h: -h.fit.log_evidence)
    return hypotheses[:HYPOTHESES]


def _shaped(sequences: Sequence[Commands], like: Commands) -> list[Commands]:
    """Sequences padded and cut to the shape of the recordings at hand, which the compiled simulator expects."""
    steps, rows = like.step.shape[1], like.sample_step.shape[1]
    stacked = stack_commands([*sequences, Commands(*(np.asarray(part)[0] for part in like))])
    return [
        Commands(
            np.asarray(stacked.initial)[k],
            np.asarray(stacked.step)[k, :steps],
            np.asarray(stacked.sample_step)[k, :rows],
            np.asarray(stacked.sample_fraction)[k, :rows],
        )
        for k in range(len(sequences))
    ]


def _proposals(
    first: Trajectory, fitted: Sequence[Trajectory], rng: np.random.Generator
) -> list[tuple[str, Float[np.ndarray, " k"], Float[np.ndarray, "k channel"]]]:
    """Command sequences within the range that the recordings have used."""
    low = np.min([np.min(t.command, axis=0) for t in fitted], axis=0)
    high = np.max([np.max(t.command, axis=0) for t in fitted], axis=0)
    low, high = np.minimum(low, first.initial_command), np.maximum(high, first.initial_command)
    duration, channels = float(first.time[-1]), len(low)
    found = []
    for index in range(SEQUENCES):
        kind = ("random walk", "holds", "slow loop", "chirp")[index % 4]
        if kind in ("random walk", "holds"):
            interval = duration / (25 if kind == "random walk" else rng.integers(4, 9))
            time = interval * np.arange(int(duration / interval))
            level = rng.uniform(low, high, (len(time), channels))
            moved = rng.uniform(size=level.shape) < (0.3 if kind == "random walk" else 0.6)
            value = _held(level, moved, first.initial_command)
        else:
            time = np.arange(0.0, duration, duration / 100)
            turns = rng.integers(1, 4)
            phase = turns * time / duration if kind == "slow loop" else 4.0 * turns * (time / duration) ** 2
            swing = 0.5 - 0.5 * np.cos(2 * np.pi * phase)
            weight = rng.dirichlet(np.ones(channels)) ** 0.5
            value = first.initial_command + np.outer(swing, weight * (high - first.initial_command))
        found.append((kind, time, np.clip(value, low, high)))
    return found


def _held(level: np.ndarray, moved: np.ndarray, initial: np.ndarray) -> np.ndarray:
    """Channels that keep their command until they are moved."""
    value, last = np.empty_like(level), np.array(initial, dtype=float)
    for row in range(len(level)):
        last = np.where(moved[row], level[row], last)
        value[row] = last
    return value


def _sentence(kind: str, outlook: Outlook, now: dict[tuple[str, str], float]) -> str:
    if not outlook.pairs:
        return (
            f"No candidate is significant. The {kind} in {COMMANDS} would tell most about the base parameters: "
            f"{outlook.information:.1f} nats."
        )
    pair = min(outlook.pairs, key=lambda p: outlook.pairs[p])
    words = " and ".join(name.replace("_", " ") for name in pair)
    return (
        f"Record the {kind} in {COMMANDS}: it raises the expected log likelihood ratio of the pair that is hardest to "
        f"tell apart, {words}, from {0.5 * now[pair]:.1f} to {0.5 * outlook.pairs[pair]:.1f} nats, and names the right "
        f"one with probability {outlook.right:.2f}."
    )
