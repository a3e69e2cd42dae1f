"""Ports and laws in words and as plain values: text of an unknown cause in an audit's sentence and audit.json."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rfdropo_bayes.discrepancy.described import Described, coefficients
from rfdropo_bayes.discrepancy.gain import noise_distance
from rfdropo_bayes.discrepancy.inadequacy import POOR
from rfdropo_bayes.discrepancy.law_search import Refit, in_words
from rfdropo_bayes.discrepancy.pipeline import Answer
from rfdropo_bayes.discrepancy.prequential import span_in_words

MILLIMETRES = 1e3
MOST_TIES = 3


def channels_of(answer: Answer) -> tuple[str, ...]:
    """Names of the commands."""
    simulator: Any = answer.problem.lanes.simulator
    return tuple(simulator.channel_names)


def law_record(answer: Answer) -> dict[str, Any] | None:
    """The law that was found, whether it holds or not; None without a law."""
    described = answer.described
    if described is None or described.last is None:
        return None
    gain, names = described.gain, channels_of(answer)
    return {
        "port": described.search.terms[0].term.port.name,
        "formula": formula(described.search.terms, names),
        "terms": coefficients(described, answer.problem.seed),
        "holds": described.holds,
        "beside": list(described.beside),
        "stands_in": list(described.stand_ins),
        "ties": [
            {
                "port": tie.term.port.name,
                "group": tie.term.scope.group,
                "feature": tie.feature.formula(names),
                "score": tie.score,
            }
            for tie in described.search.ties
        ],
        "log_evidence_left": None if described.search.after is None else described.search.after.log_evidence,
        "rmse_before_mm": None if gain is None else MILLIMETRES * gain.rmse_base,
        "rmse_after_mm": None if gain is None else MILLIMETRES * gain.rmse_extended,
        "explained_fraction": None if gain is None else gain.explained,
        "explained_fraction_interval": None if gain is None else list(gain.interval),
        "elpd_difference": None if gain is None else gain.elpd_difference,
        "by_trajectory": None if gain is None else gain.by_trajectory,
    }


def ports_record(answer: Answer) -> dict[str, Any] | None:
    """Every port with its evidence; None if not requested."""
    described = answer.described
    if described is None:
        return None
    return {
        "ports": [
            {
                "port": row.port.name,
                "log_evidence": row.log_evidence,
                "adjusted_p": row.adjusted_p,
                "amplitude": row.amplitude,
                "unit": row.port.unit,
                "memory_s": row.memory,
                "explained_share": row.share,
            }
            for row in described.search.ports
        ],
        "left_out": dict(described.search.map.left_out),
        "time_s": described.search.centre.tolist(),
        "null_quantile_nats": described.search.null_quantile,
    }


def formula(terms: Sequence[Refit], names: Sequence[str]) -> str:
    """A law as a formula, without its coefficients' values."""
    parts: dict[str, list[str]] = {}
    for refit in terms:
        own = parts.setdefault(refit.term.port.words, [])
        number = sum(map(len, parts.values())) + 1
        own.append(f"c{number} {refit.feature.formula(names)}{in_words(refit.term.scope)}")
    return "; ".join(f"w({port}) = {' + '.join(own)}" for port, own in parts.items())


def law_sentence(answer: Answer, *, first: bool) -> str:
    """Port, time, law, gain, and check at the robot; ``first`` without an earlier sentence about mechanisms."""
    described = answer.law
    assert described is not None
    assert described.gain is not None
    gain, names = described.gain, channels_of(answer)
    rows = coefficients(described, answer.problem.seed)
    laws = " and ".join(_one(refit, row, names) for refit, row in zip(described.search.terms, rows, strict=True))
    errors = f"{MILLIMETRES * gain.rmse_base:.3g} mm without it, {MILLIMETRES * gain.rmse_extended:.3g} mm with it"
    noise = MILLIMETRES * noise_distance(answer.target.noise.first)
    unknown = "no mechanism of the library describes" if answer.problem.candidates else "the model lacks"
    acts, of = ("An effect acts", "of the discrepancy") if first else ("A smaller effect acts", "of what is left")
    head = f"{acts} that {unknown}: {laws}{_when(described, answer.problem.timed)}"
    worth = f"it explains {gain.share} {of} in unseen recordings ({errors}, {noise:.2g} mm of it noise)"
    looks = "; ".join(dict.fromkeys(refit.term.port.look for refit in described.search.terms))
    beside = _beside(described) if first else ""
    return f"{head}; {worth}.{_stand_ins(described)}{beside}{_ties(described, names)} Look at {looks}."


def _one(refit: Refit, row: dict[str, Any], names: Sequence[str]) -> str:
    feature, unit = refit.feature, "" if row["unit"] == "-" else f" {row['unit']}"
    size = f"{row['mean']:.3g} \u00b1 {row['sd']:.2g}{unit}"
    size_and_formula = f"{size} times {feature.formula(names)}{_shape(row)}"
    return (
        f"at {refit.term.port.words}{in_words(refit.term.scope)} it changes {feature.words(names)} ({size_and_formula})"
    )


def _shape(row: dict[str, Any]) -> str:
    """Size and deviation of an inferred shape, in words."""
    if row["shape_sd"] is None:
        return ""
    name = "half a width" if row["shape_unit"] != "s" else "a time constant"
    return f", with {name} of {row['shape']:.3g} \u00b1 {row['shape_sd']:.2g} {row['shape_unit']}"


def _when(described: Described, timed: bool) -> str:
    """When the signals at the members of the law's port are largest."""
    term = described.search.terms[0].term
    members = described.search.map.members(term.port)
    size = np.sqrt(np.mean([row.mean**2 for row in described.search.ports if row.port in members], axis=(0, 1)))
    large = described.search.centre[size > 0.7 * size.max()]
    return f", most {span_in_words(large.min(), large.max(), timed)}"


def _stand_ins(described: Described) -> str:
    if not described.stand_ins:
        return ""
    names = " and ".join(name.replace("_", " ") for name in described.stand_ins)
    verb = "is a stand-in" if len(described.stand_ins) == 1 else "are stand-ins"
    why = "do not ask for more than the law" if described.steps else "are clearly likelier with the law"
    return f" {names[0].upper()}{names[1:]} of the library {verb} for it, and not adopted: unseen recordings {why}."


def _beside(described: Described) -> str:
    if not described.beside:
        return ""
    names = " and ".join(name.replace("_", " ") for name in described.beside)
    return f" Beside it, {names} of the library {'is' if len(described.beside) == 1 else 'are'} in the model."


def _ties(described: Described, names: Sequence[str]) -> str:
    own = {refit.term.place for refit in described.search.terms}
    ties = [tie for tie in described.search.ties if tie.term.place not in own][:MOST_TIES]
    if not ties:
        return ""
    listed = ", ".join(
        f"{tie.feature.formula(names)} at {tie.term.port.words}{in_words(tie.term.scope)}" for tie in ties
    )
    return f" Indistinguishable from it in these data: {listed}."


def ports_sentence(answer: Answer) -> str:
    """Ports with an effect, in an audit without a supported law."""
    described = answer.described
    if described is None or described.holds:
        return ""
    rows = described.search.significant(answer.problem.rules.level)
    if not rows:
        return ""
    residual = answer.extended.residual
    if residual @ residual > POOR * np.count_nonzero(
        residual
    ):  # the noise is as large as the residuals, and shrinks the signal
        return f" Of all ports, a signal at {rows[0].port.words} explains most of it; {_no_law(answer)}."
    size = f"{rows[0].amplitude:.2g}" + ("" if rows[0].port.unit == "-" else f" {rows[0].port.unit}")
    others = ", ".join(row.port.words for row in rows[1 : 1 + MOST_TIES])
    beside = f" ({others} explain less)" if others else ""
    return f" A signal at {rows[0].port.words}, of {size}, explains most of it{beside}; {_no_law(answer)}."


def _no_law(answer: Answer) -> str:
    """Statement that no law is supported; for a law of the fitted recordings, its errors on unseen recordings."""
    described = answer.described
    assert described is not None
    if described.last is None or described.gain is None:
        return "no law of it holds"
    rows = coefficients(described, answer.problem.seed)
    terms = zip(described.search.terms, rows, strict=True)
    laws = " and ".join(_one(refit, row, channels_of(answer)) for refit, row in terms)
    gain = described.gain
    errors = f"{MILLIMETRES * gain.rmse_base:.3g} mm without it, {MILLIMETRES * gain.rmse_extended:.3g} mm with it"
    return (
        "no law of it is supported. The fitted recordings ask for a law that unseen recordings do not "
        f"support ({errors}): {laws}"
    )


def law_tables(answer: Answer) -> list[dict[str, Any]]:
    """The law as entries of [[model.laws]], in priors no narrower than the sizes that were found."""
    described = answer.law
    if described is None or described.sizes is None:
        return []
    names, fit = channels_of(answer), described.sizes[0]
    coordinates = described.sizes[1].forward.coordinates
    tables: dict[str, list[dict[str, Any]]] = {}
    for refit in described.search.terms:
        feature, spec = refit.feature, refit.term.spec
        size = abs(float(fit.x[coordinates.names.index(spec.name)]))
        entry: dict[str, Any] = {"coefficient": spec.name, "feature": feature.kind}
        if feature.channels:
            entry["motion" if feature.of_motion else "commands"] = feature.commands(names)
        if feature.shape is not None:
            entry["shape"] = float(f"{feature.shape:.6g}")
        if refit.term.shape is not None:
            entry["shape_parameter"] = refit.term.shape.name
        entry["scale"] = float(f"{spec.prior['scale'] * max(size, 1.0):.3g}")
        tables.setdefault(refit.term.port.name, []).append(entry)
    return [{"port": port, "terms": terms} for port, terms in tables.items()]
