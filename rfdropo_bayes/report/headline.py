"""The result of a run in a few plain sentences, from the numbers of summary.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

FEW_DRAWS = 100  # effective draws that central intervals need


def headline(summary: Mapping[str, Any]) -> list[str]:
    """Fitted data, error, best baseline, parameters at a bound, and number of failed rollouts."""
    return [
        sentence
        for sentence in (
            _fitted(summary),
            _errors(summary),
            _against(summary),
            (summary.get("unseen_sessions") or {}).get("sentence", ""),
            _objects(summary),
            _bounds(summary),
            _excluded(summary),
        )
        if sentence
    ]


def _fitted(summary: Mapping[str, Any]) -> str:
    free = [name for name, row in summary["parameters"].items() if not row.get("derived")]
    recordings = [r for r in summary["recordings"] if r["split"] == "fit"]
    seconds = sum(r["seconds"] for r in recordings)
    synthetic = " synthetic" if recordings and all(r["synthetic"] for r in recordings) else ""
    data = (
        f"{_count(len(recordings), synthetic.strip() + ' recording' if synthetic else 'recording')} ({seconds:.3g} s)"
    )
    effective = summary["effective_draws"]
    worth = "" if effective is None else f"; its draws are worth {effective:.0f} independent draws"
    few = "" if effective is None or effective >= FEW_DRAWS else f", fewer than the {FEW_DRAWS} that intervals need"
    return (
        f"{_count(len(free), 'parameter')} of {summary['robot']} were inferred from {data} with {summary['method']}"
        f"{worth}{few}."
    )


def _errors(summary: Mapping[str, Any]) -> str:
    parts = []
    for role, words in (("fit", "where it was fitted"), ("test", "on test recordings that no fit saw")):
        figures = summary["errors"].get(role)
        if figures and figures["over_time"]:
            marker, value = list(figures["over_time"].items())[-1]
            if value is not None:
                split = ""
                if figures["moving"] is not None:
                    split = f" (moving part {figures['moving']:.3g} mm, final pose {figures['final']:.3g} mm)"
                parts.append(f"{value:.3g} mm {words}{_repeats(summary) if role == 'test' else ''}{split}")
    if not parts:
        return ""
    tail = "" if summary["rmse"]["test"] else " There are no test recordings: its predictions are untested."
    return f"In root mean square over time, its last marker ({marker}) is off by {', and by '.join(parts)}.{tail}"


def _repeats(summary: Mapping[str, Any]) -> str:
    """Phrase with the number of test recordings that repeat fitted commands; empty if none does."""
    repeated = len(summary.get("fitted_commands") or ())
    tested = sum(recording["split"] == "test" for recording in summary["recordings"])
    return f", of which {repeated} of {tested} repeat fitted commands" if repeated else ""


def best_baseline(summary: Mapping[str, Any], role: str, marker: str | None = None) -> tuple[str, float] | None:
    """Title and error of the best predictor without a model of the robot, of the given or the last marker; None if
    none was scored.
    """
    scored = []
    for row in summary["baselines"].values():
        errors = (row[role] or {"over_time": {}})["over_time"]
        value = errors.get(marker) if marker else next(reversed(list(errors.values())), None)
        if value is not None:
            scored.append((row["title"], value))
    return min(scored, key=lambda pair: pair[1]) if scored else None


def _against(summary: Mapping[str, Any]) -> str:
    own = list(summary["rmse"]["test"].values())
    best = best_baseline(summary, "test")
    if not own or own[-1] is None or best is None:
        return ""
    title, error = best
    verdict = "the simulator does better" if own[-1] < error else "the simulator does no better"
    floor = summary.get("noise_floor_mm")
    repeats = f"; repeats of one experiment differ by {list(floor.values())[-1]:.3g} mm" if floor else ""
    return f"The best predictor without a simulator ({title}) is off by {error:.3g} mm there: {verdict}{repeats}."


def _objects(summary: Mapping[str, Any]) -> str:
    scores = list((summary.get("objects") or {}).values())
    if not scores:
        return ""
    own, constant = (sum(s[key] for s in scores) / len(scores) for key in ("energy_score_mm", "held_mm"))
    repeats = [s["repeats_mm"] for s in scores if s["repeats_mm"] is not None]
    against = f", {sum(repeats) / len(repeats):.3g} mm for who has seen its other repeats" if repeats else ""
    return (
        f"The final position of the object has an energy score of {own:.3g} mm in test recordings, the mean of "
        f"{len(scores)}; {constant:.3g} mm for who says that it stays{against}."
    )


def _bounds(summary: Mapping[str, Any]) -> str:
    names = [name for name, row in summary["parameters"].items() if row["at_bound"]]
    if not names:
        return "No parameter is piled up at a hard bound or an end of its prior."
    verb = "sits" if len(names) == 1 else "sit"
    return f"Careful: {', '.join(names)} {verb} on a hard bound or at an end of the prior, which decides, not the data."


def _excluded(summary: Mapping[str, Any]) -> str:
    total = sum(summary["excluded"].values())
    if not total:
        return "No rollout had to be left out."
    reasons = ", ".join(f"{count} {name}" for name, count in sorted(summary["excluded"].items()))
    of = f" of {summary['evaluations']}" if summary["evaluations"] else ""
    return f"{total}{of} simulations got no weight ({reasons})."


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
