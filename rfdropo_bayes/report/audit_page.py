"""report.html of an audit: one file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rfdropo_bayes.discrepancy.omnibus import BLOCK
from rfdropo_bayes.discrepancy.pipeline import Answer
from rfdropo_bayes.discrepancy.score import likeness
from rfdropo_bayes.discrepancy.score_tests import ScoreRow, ScoreTests
from rfdropo_bayes.report import audit_figures as figures
from rfdropo_bayes.report.page import render
from rfdropo_bayes.report.replay import Track, replay
from rfdropo_bayes.report.robot_figure import robot_figure
from rfdropo_bayes.report.style import Picture, embed
from rfdropo_bayes.report.units import display_name

SECTIONS = (
    ("result", "Verdict"),
    ("show", "Where the model fails"),
    ("name", "Candidates"),
    ("measure", "Gain"),
    ("remainder", "Remaining misfit"),
    ("limits", "Limits"),
)
MOST_COSINES = 16


def render_audit(
    seen: figures.Shown, content: Mapping[str, Any], title: str, config: str, outline: Mapping[str, Any] | None = None
) -> str:
    """HTML of an audit.

    Args:
        seen: data of the figures.
        content: content of audit.json.
        title: title of the experiment.
        config: the experiment file of the run.
        outline: outline of the robot.
    """
    return render(
        "audit.html.j2",
        audit=content,
        title=title,
        sections=SECTIONS,
        pictures=_pictures(seen, outline),
        classes=[
            (c, embed(figures.class_figure(seen.residuals, c), f"Misfit with and without {display_name(c.names[0])}"))
            for c in seen.classes
        ],
        replayed=replay(seen.tracks, outline),
        config=config,
    )


def residuals_of(answer: Answer) -> figures.Residuals:
    """The base model's residuals beside commands, rates, tensions and positions."""
    target = answer.target
    measured, forward = target.measurements, target.forward
    shown = forward.observe_one(answer.base.x)
    position = shown["position"].reshape(*shown["position"].shape[:2], -1)
    valid = measured.valid[..., : measured.markers]
    residual = np.where(valid, target.errors(answer.base.x)[..., : measured.markers], 0.0)
    rows = valid.any(axis=2)
    flat = residual[rows]
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
        answer.problem.trajectories[0].command_unit,
    )


def shown(answer: Answer) -> figures.Shown:
    """Data of the figures of an audit."""
    step = float(np.median(np.diff(answer.target.measurements.time[0])))
    probed = [row for row in answer.test_series[0].rows if row.probe is not None][:MOST_COSINES]
    marks = [row.probe.mark for row in probed if row.probe is not None]
    unseen, validation, tracks = None, answer.validation, list[Track]()
    if validation.predictions is not None and validation.unseen is not None and validation.gain is not None:
        recordings, (base, extended) = validation.unseen, map(validation.unseen.predicted, validation.predictions)
        valid = recordings.valid[..., : recordings.markers]
        worst = int(np.argmax([each.rmse_base for each in validation.gain.differences.values()]))
        seen = valid[worst].any(axis=1)
        measured = np.where(valid, recordings.position, np.nan)
        series = {"measured": measured, "base model": base, "extended model": extended}
        unseen = (step * np.flatnonzero(seen), {name: path[worst, seen, -3:] for name, path in series.items()})
        names = answer.problem.model.recordings.markers  # markers that all recordings have
        for index in np.argsort([-each.rmse_base for each in validation.gain.differences.values()]):
            rows = slice(0, int(np.flatnonzero(valid[index].any(axis=1))[-1]) + 1)
            moved = {name: path[index, rows].reshape(-1, len(names), 3) for name, path in series.items()}
            time = step * np.arange(len(moved["measured"]))
            tracks.append(Track(recordings.names[index], "unseen", time, names, moved))
    rest = answer.remainder
    return figures.Shown(
        residuals_of(answer),
        [tests.omnibus.blocks.tolist() for tests in answer.test_series],
        BLOCK * step,
        ["base model", *(f"with {display_name(step.name)}" for step in answer.steps)],
        [row.name for row in probed],
        np.array([[likeness(a, b) for b in marks] for a in marks]),
        unseen,
        (rest.time, rest.mean[0, :, -3:], rest.sd[0, :, -3:]) if rest.amplitude > 0.0 else None,
        tracks,
        _signal(answer),
        class_effects(answer),
    )


def class_effects(answer: Answer) -> list[figures.ClassEffect]:
    """Effects of the leading classes of candidates on the base model's residuals, adopted or not."""
    first, rules = answer.test_series[0], answer.problem.rules
    heads: list[list[ScoreRow]] = []
    for row in first.rows:
        if row.probe is None or row.adjusted_p > rules.level:
            continue
        own = next((h for h in heads if _alike(h[0], row) > rules.class_cosine), None)
        if own is not None:
            own.append(row)
        elif len(heads) < rules.classes:
            heads.append([row])
    return [_effect(answer, first, members) for members in heads]


def _alike(first: ScoreRow, second: ScoreRow) -> float:
    return likeness(first.probe.mark, second.probe.mark) if first.probe and second.probe else 0.0


def _effect(answer: Answer, tests: ScoreTests, members: Sequence[ScoreRow]) -> figures.ClassEffect:
    """The linear effect of the leading member of a class at the size that explains most."""
    assert members[0].probe is not None
    measured, basis, residual = answer.target.measurements, members[0].probe.mark.basis, tests.fit.residual
    both = [
        measured.series(each)[..., : measured.markers] ** 2
        for each in (residual, residual - basis @ (basis.T @ residual))
    ]
    valid = measured.valid[..., : measured.markers]
    rows, each = valid.any(axis=2), valid.reshape(*valid.shape[:2], -1, 3)
    counts = np.maximum(valid.sum(axis=2), 1)

    def pairs(names: Sequence[str], axis: int) -> dict[str, tuple[float, float]]:
        others = tuple(k for k in range(4) if k != axis)
        count = np.maximum(each.sum(axis=others), 1)
        means = [np.where(each, square.reshape(each.shape), 0.0).sum(axis=others) / count for square in both]
        return {name: (float(b), float(a)) for name, b, a in zip(names, *means, strict=True)}

    before, after = ((np.where(valid, square, 0.0).sum(axis=2) / counts)[rows] for square in both)
    names = tuple(row.name for row in members)
    markers = answer.problem.model.recordings.markers
    return figures.ClassEffect(names, before, after, pairs(markers, 2), pairs(measured.names, 0))


def _signal(answer: Answer) -> figures.Signal | None:
    """The signal at the port of the law, of its members the one of most evidence; without a law at the port of most."""
    described = answer.described
    if described is None or not described.search.significant(answer.problem.rules.level):
        return None
    row, terms = described.search.ports[0], described.search.terms
    if terms:
        members = described.search.map.members(terms[0].term.port)
        row = next(each for each in described.search.ports if each.port in members)
    names = answer.target.measurements.names
    return figures.Signal(row.port.words, row.port.unit, names, described.search.centre, row.mean, row.sd)


def _pictures(seen: figures.Shown, outline: Mapping[str, Any] | None) -> dict[str, Picture | None]:
    """The figures of the page by name, None if there is nothing to show."""
    drawn = {
        "robot": (robot_figure(outline), "The robot from the side and from its base") if outline else None,
        "panels": (figures.panels_figure(seen.residuals), "Residual against time, command, rate, position and tension"),
        "blocks": (figures.blocks_figure(seen), "Misfit of each block of rows"),
        "cosines": (figures.cosine_figure(seen), "Cosines between signatures") if len(seen.names) > 1 else None,
        "overlay": (figures.unseen_figure(seen), "Measured, base model and extended model") if seen.unseen else None,
        "remainder": (figures.remainder_figure(seen), "Gaussian process of the residual") if seen.remainder else None,
        "port": (figures.signal_figure(seen.port), "Signal at the port of the missing effect") if seen.port else None,
    }
    return {name: None if picture is None else embed(*picture) for name, picture in drawn.items()}
