"""report.html of an audit: one file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from rfdropo_bayes.audit.bootstrap import p_in_words
from rfdropo_bayes.audit.omnibus import BLOCK
from rfdropo_bayes.audit.pipeline import Answer
from rfdropo_bayes.audit.score import likeness
from rfdropo_bayes.report import audit_figures as figures
from rfdropo_bayes.report.page import breakable, duration, number
from rfdropo_bayes.report.robot_figure import robot_figure
from rfdropo_bayes.report.style import Picture, embed
from rfdropo_bayes.report.units import display_name

SECTIONS = (
    ("result", "Verdict"),
    ("show", "Where the model fails"),
    ("name", "Candidates"),
    ("measure", "Gain"),
    ("remainder", "What remains"),
    ("limits", "Limits"),
)
MOST_COSINES = 16
LEAST_P = 1e-16


def render_audit(
    answer: Answer, content: Mapping[str, Any], title: str, config: str, outline: Mapping[str, Any] | None = None
) -> str:
    """HTML of an audit.

    Args:
        answer: the audit.
        content: of audit.json.
        title: of the experiment.
        config: the experiment file as it was run.
        outline: of the robot, for its picture.
    """
    environment = Environment(
        loader=PackageLoader("rfdropo_bayes.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "words": display_name, "duration": duration, "breakable": breakable}
    environment.filters |= {"bootstrap_p": _bootstrap_p, "p_value": p_value}
    stylesheet = environment.loader.get_source(environment, "page.css")[0] if environment.loader else ""
    return environment.get_template("audit.html.j2").render(
        audit=content,
        title=title,
        sections=SECTIONS,
        stylesheet=Markup(stylesheet),
        pictures=_pictures(answer, outline),
        config=config,
    )


def _bootstrap_p(p: float, simulated: int) -> str:
    """A bootstrap's p-value in a table."""
    return p_in_words(p, simulated).removeprefix("= ")


def p_value(p: float) -> str:
    """A p-value from a distribution, which holds only so far out."""
    return number(p, 2) if p >= LEAST_P else f"< {LEAST_P:.0e}"


def residuals_of(answer: Answer) -> figures.Residuals:
    """The base model's residuals beside commands, rates, tensions and positions."""
    target = answer.target
    measured, forward = target.measurements, target.forward
    shown = forward.observe_one(answer.base.x)
    position = shown["position"].reshape(*shown["position"].shape[:2], -1)
    valid = measured.valid[..., : measured.markers]
    left = np.where(valid, target.errors(answer.base.x)[..., : measured.markers], 0.0)
    rows = valid.any(axis=2)
    flat = left[rows]
    values, vectors = np.linalg.eigh(flat.T @ flat)
    pattern = vectors[:, -1]
    times = np.asarray(measured.time)
    command = []
    for group in range(len(times)):
        sent = np.vstack([forward.commands.initial[group][None], forward.commands.step[group]])
        command.append(sent[np.minimum(forward.commands.sample_step[group], len(sent) - 1)])
    # Over the time between rows: commands that are held jump between two of them.
    apart = np.maximum(np.diff(times, axis=1), 1e-9)[..., None]
    rate = np.concatenate([np.zeros_like(command)[:, :1], np.diff(command, axis=1) / apart], axis=1)
    return figures.Residuals(
        flat @ pattern,
        float(values[-1] / max(values.sum(), 1e-300)),
        times[rows],
        np.stack(command)[rows],
        rate[rows],
        shown["tension"][rows],
        (position - position[:, :1])[rows] @ pattern,
        tuple(forward.lanes.simulator.channel_names),
        tuple(forward.lanes.simulator.cable_names),
        answer.question.trajectories[0].command_unit,
    )


def _pictures(answer: Answer, outline: Mapping[str, Any] | None) -> dict[str, Picture | None]:
    measured = answer.target.measurements
    step = float(np.median(np.diff(measured.time[0])))
    titles = ["base model", *(f"with {display_name(s.name)}" for s in answer.steps)]
    found: dict[str, Picture | None] = {
        "robot": embed(robot_figure(outline), "The robot from the side and from its base") if outline else None,
        "panels": embed(
            figures.panels_figure(residuals_of(answer)), "Residual against time, command, rate, position and tension"
        ),
        "blocks": embed(
            figures.blocks_figure([look.omnibus.blocks.tolist() for look in answer.looks], BLOCK * step, titles),
            "Misfit of each block of rows",
        ),
        "cosines": None,
        "overlay": None,
        "remainder": None,
    }
    rows = [row for row in answer.looks[0].rows if row.probe is not None][:MOST_COSINES]
    if len(rows) > 1:
        marks = [row.probe.mark for row in rows if row.probe is not None]
        cosines = np.array([[likeness(a, b) for b in marks] for a in marks])
        found["cosines"] = embed(figures.cosine_figure([r.name for r in rows], cosines), "Cosines between signatures")
    if answer.predictions is not None and answer.unseen is not None:
        unseen, (base, extended) = answer.unseen, map(answer.unseen.predicted, answer.predictions)
        valid = unseen.valid[..., : unseen.markers]
        worst = int(np.argmax(np.sum((unseen.position - base) ** 2 * valid, (1, 2))))
        seen = valid[worst].any(axis=1)
        series = {
            "measured": np.where(valid, unseen.position, np.nan)[worst, seen, -3:],
            "base model": base[worst, seen, -3:],
            "extended model": extended[worst, seen, -3:],
        }
        found["overlay"] = embed(
            figures.overlay_figure(step * np.flatnonzero(seen), series, "last marker"),
            "Measured, base model and extended model",
        )
    rest = answer.remainder
    if rest.amplitude > 0.0:
        found["remainder"] = embed(
            figures.remainder_figure(rest.time, rest.mean[0, :, -3:], rest.sd[0, :, -3:], "left of the last marker"),
            "Gaussian process of what remains",
        )
    return found
