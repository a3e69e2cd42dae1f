"""Is this posterior safe to randomise a simulator over, and if not, why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rfdropo_bayes.posteriors import PosteriorRecord, contradiction, contradicts
from rfdropo_bayes.report.headline import best_baseline

BAND = "0.9"
OVERCONFIDENT, VAGUE = 0.8, 0.97  # share of measurements in the 90 % band
FEW_DRAWS = 100.0  # effective ones
UNMIXED = 1.1  # R-hat
LOST = 0.05  # share of rollouts without weight
# In the warnings of samplers and climbs that a budget cut off, of particles that did not move, and of RF-DROPO.
UNFINISHED = ("ran out", "left the particles", "sits on its smallest value")

WORDS = {
    "safe": "Safe to randomise over",
    "with care": "Randomise over it with care",
    "unsafe": "Not safe to randomise over",
}


@dataclass(frozen=True)
class Safety:
    """The answer and its grounds.

    Attributes:
        verdict: "safe", "with care" or "unsafe".
        sentence: the same in words.
        reasons: against, worst first.
        advice: what to observe when drawing.
    """

    verdict: str
    sentence: str
    reasons: list[str]
    advice: list[str]

    def as_dict(self) -> dict[str, Any]:
        """For summary.json."""
        return asdict(self)


def judge(record: PosteriorRecord, summary: Mapping[str, Any]) -> Safety:
    """Judge a posterior by the numbers of its summary (without its key "randomisation")."""
    grave = [*_prediction(summary), *_sampling(summary), *_conflicts(record)]
    slight = _reservations(summary)
    verdict = "unsafe" if grave else "with care" if slight else "safe"
    reasons = grave + slight
    why = f": {'; '.join(reasons)}." if reasons else ": bands, sampler, bounds and prior give no reason against it."
    return Safety(verdict, WORDS[verdict] + why, reasons, _advice(summary))


def _prediction(summary: Mapping[str, Any]) -> list[str]:
    """Bands that are too narrow, or a simulator that predicts no better than something without one."""
    found = []
    share = summary["coverage"].get(BAND)
    if share is not None and share < OVERCONFIDENT:
        found.append(f"its 90 % bands hold only {100 * share:.0f} % of the measurements, so it is over-confident")
    own, best = list(summary["rmse"]["test"].values()), best_baseline(summary, "test")
    if own and own[-1] is not None and best is not None and own[-1] >= best[1]:
        found.append(f"the simulator predicts no better than one without physics ({best[0]}: {best[1]:.3g} mm)")
    return found


def _sampling(summary: Mapping[str, Any]) -> list[str]:
    """A sampler that did not arrive."""
    found = []
    rows = {name: row for name, row in summary["parameters"].items() if not row.get("derived")}
    few = [name for name, row in rows.items() if (row.get("ess_bulk") or np.inf) < FEW_DRAWS]
    if few and summary["method"] != "rfdropo":
        found.append(f"fewer than {FEW_DRAWS:.0f} effective draws of {', '.join(few)}")
    apart = [name for name, row in rows.items() if (row.get("r_hat") or 1.0) > UNMIXED]
    if apart:
        found.append(f"independent runs disagree about {', '.join(apart)}")
    found += unfinished(summary["warnings"])
    total = sum(summary["excluded"].values())
    if summary["evaluations"] and total > LOST * summary["evaluations"]:
        found.append(f"{100 * total / summary['evaluations']:.0f} % of the rollouts failed")
    return found


def unfinished(warnings: Sequence[str]) -> list[str]:
    """Those of a method's warnings that say that it did not arrive at its posterior."""
    return [sentence for sentence in warnings if any(words in sentence for words in UNFINISHED)]


def _conflicts(record: PosteriorRecord) -> list[str]:
    """Parameters whose posterior lies where the prior hardly is: the data contradict the prior, or the model."""
    known = [info.name for info in record.free if info.name in record.prior]
    names = [name for name in known if contradicts(record.flat(name), record.prior[name])]
    return [contradiction(names)] if names else []


def _reservations(summary: Mapping[str, Any]) -> list[str]:
    found = []
    edge = [name for name, row in summary["parameters"].items() if row["at_bound"]]
    if edge:
        found.append(
            f"{', '.join(edge)} {'sits' if len(edge) == 1 else 'sit'} on a hard bound or at an end of the prior, "
            "which decided and not the data"
        )
    share = summary["coverage"].get(BAND)
    if share is not None and share > VAGUE:
        found.append(f"its 90 % bands hold {100 * share:.0f} % of the measurements: wider than need be")
    if not summary["rmse"]["test"]:
        found.append("no recording was kept back to test it on")
    return found


def _advice(summary: Mapping[str, Any]) -> list[str]:
    advice = []
    if any(len(row["powers"]) > 1 for row in summary["identifiability"]):
        advice.append(
            "Draw whole parameter sets from posterior.nc: parameters drawn one by one lose the ratios that the data "
            "determine"
        )
    free = [row["sentence"] for row in summary["identifiability"] if row["verdict"] == "free"]
    if free:
        advice.append(f"As wide as the prior: {'; '.join(free)}")
    if summary["phi"]:
        advice.append("phi is a point estimate for domain randomisation: its spread is no statement of uncertainty")
    return advice
