"""Whether a posterior is safe to randomise a simulator over, with reasons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rfdropo_bayes.cautions import grave, read_cautions
from rfdropo_bayes.posteriors import PosteriorRecord, contradiction, contradicts
from rfdropo_bayes.report.headline import FEW_DRAWS, best_baseline

BAND = "0.9"
TIP = "tip"  # a marker of this name needs no other words
OVERCONFIDENT, VAGUE = 0.8, 0.97  # share of measurements in the 90 % band
CHOSEN = ("rfdropo", "adapt")  # methods with a requested number of draws, and no chain
NAMED = 3  # parameters that a sentence names
UNMIXED = 1.1  # R-hat
HALF = 0.5  # of a variance: beyond it, most of an error is systematic
LOST = 0.05  # share of rollouts without weight

WORDS = {
    "safe": "Safe to randomise over",
    "with care": "Randomise over it with care",
    "unsafe": "Not safe to randomise over",
}


@dataclass(frozen=True)
class Safety:
    """The verdict and its reasons."""

    verdict: str  # "safe", "with care" or "unsafe"
    sentence: str  # the same in words
    reasons: list[str]  # reasons against it, worst first
    advice: list[str]  # recommendations for drawing

    def as_dict(self) -> dict[str, Any]:
        """For summary.json."""
        return asdict(self)


def rate_safety(record: PosteriorRecord, summary: Mapping[str, Any]) -> Safety:
    """Rate a posterior by the numbers of its summary (without its key "randomisation")."""
    against = [*_bands(summary), *_against_baselines(summary), *_sampling(summary), *_conflicts(record)]
    slight = [*_systematic(summary), *_reservations(summary)]
    verdict = "unsafe" if against else "with care" if slight else "safe"
    reasons = against + slight
    nothing = "bands, residuals, errors, sampler, bounds and prior give no reason against it"
    why = f": {'; '.join(reasons) or nothing}."
    return Safety(verdict, WORDS[verdict] + why, reasons, _advice(summary))


def _bands(summary: Mapping[str, Any]) -> list[str]:
    """Bands that are too narrow, over all or at a marker; residuals that the noise model takes for independent."""
    reasons = []
    share = summary["coverage"].get(BAND)
    if share is not None and share < OVERCONFIDENT:
        reasons.append(f"its 90 % bands hold only {100 * share:.0f} % of the measurements, so it is over-confident")
    role = _role(summary)
    rows = summary["coverage_by_role"][role]
    shares = {marker: row.get(BAND) for marker, row in rows.items()}
    narrow = {marker: share for marker, share in shares.items() if share is not None and share < OVERCONFIDENT}
    if narrow:
        places = ", ".join(f"{100 * share:.0f} % at {_place(marker, shares)}" for marker, share in narrow.items())
        reasons.append(f"its 90 % bands of the {role} recordings hold only {places}")
    checks = summary["residuals"]
    correlated = {name: row for name, row in checks.items() if row["correlated"]}
    if correlated:
        worst = max(row["narrowing"] for row in correlated.values())
        reasons.append(
            f"its noise model leaves residuals correlated, and intervals too narrow by up to {worst:.2g} times"
        )
    return reasons


def _against_baselines(summary: Mapping[str, Any]) -> list[str]:
    """A simulator that predicts the last marker no better than a predictor without physics."""
    own, best = list(summary["rmse"]["test"].values()), best_baseline(summary, "test")
    if own and own[-1] is not None and best is not None and own[-1] >= best[1]:
        return [f"the simulator predicts no better than a predictor without physics ({best[0]}: {best[1]:.3g} mm)"]
    return []


def _role(summary: Mapping[str, Any]) -> str:
    return "test" if summary["rmse"]["test"] else "fit"


def _place(marker: str, markers: Mapping[str, Any]) -> str:
    if marker != list(markers)[-1]:
        return marker
    return "the tip" if marker == TIP else f"the tip ({marker})"


def _systematic(summary: Mapping[str, Any]) -> list[str]:
    """Errors that no noise explains: beside the noise floor, fitted recordings and the best baseline, and from row to
    row.
    """
    reasons, role = [], _role(summary)
    errors = {marker: error for marker, error in summary["rmse"][role].items() if error}
    floor = summary["noise_floor_mm"] or {}
    above = {m: error for m, error in errors.items() if floor.get(m) and HALF * error**2 > floor[m] ** 2}
    if above:
        worst = max(above, key=lambda marker: above[marker] / floor[marker])
        reasons.append(
            f"the simulator is off by {above[worst]:.3g} mm at {_place(worst, errors)}, where repeats differ by "
            f"{floor[worst]:.3g} mm: most of the error is the simulator's"
        )
    lasting = {m: r for m, r in summary["error_correlation"][role].items() if r is not None and r > HALF}
    if lasting:
        places = ", ".join(f"{r:.2f} at {_place(m, summary['error_correlation'][role])}" for m, r in lasting.items())
        reasons.append(
            f"errors of the {role} recordings last from row to row (correlation {places}): something systematic is "
            "missing from the simulator, and randomising its parameters does not put it there"
        )
    if role == "fit":
        return reasons
    return [*reasons, *_beyond_fitted(summary, errors), *_near_baselines(summary, errors)]


def _beyond_fitted(summary: Mapping[str, Any], errors: Mapping[str, float]) -> list[str]:
    """Markers whose error in recordings that no fit saw is mostly not that of the fitted recordings."""
    fitted = summary["rmse"]["fit"]
    pairs = {m: (error, fitted[m]) for m, error in errors.items() if fitted.get(m) and HALF * error**2 > fitted[m] ** 2}
    if not pairs:
        return []
    worst = max(pairs, key=lambda marker: pairs[marker][0] / pairs[marker][1])
    error, own = pairs[worst]
    return [
        f"test recordings are off by {error:.3g} mm at {_place(worst, errors)}, fitted recordings by {own:.3g} mm: "
        "what was fitted does not hold for them"
    ]


def _near_baselines(summary: Mapping[str, Any], errors: Mapping[str, float]) -> list[str]:
    """Markers whose error, without its noise, is most of the best baseline's. Noise is the spread between repeats or,
    without repeats, the uncorrelated share of the squared error. A correlation below two standard errors counts as
    zero, unless it is above a half.
    """
    floor, correlation, places = summary["noise_floor_mm"] or {}, summary["error_correlation"]["test"], []
    rows = sum(row["rows"] for row in summary["recordings"] if row["split"] == "test")
    chance = min(HALF, 2.0 / np.sqrt(max(rows, 1)))
    for marker, error in errors.items():
        best, lasting = best_baseline(summary, "test", marker), correlation[marker] or 0.0
        noise = floor[marker] ** 2 if floor.get(marker) else error**2 * (1.0 - (lasting if lasting > chance else 0.0))
        if best is not None and error**2 - noise > HALF * max(best[1] ** 2 - noise, 0.0):
            places.append(f"{error:.3g} mm against {best[1]:.3g} mm at {_place(marker, errors)}")
    what = "less the noise, its squared error is more than half of that of the best predictor without physics"
    return [f"{what} ({', '.join(places)})"] if places else []


def _sampling(summary: Mapping[str, Any]) -> list[str]:
    """A sampler that did not arrive."""
    reasons = []
    rows = {name: row for name, row in summary["parameters"].items() if not row.get("derived")}
    few = [name for name, row in rows.items() if (row.get("ess_bulk") or np.inf) < FEW_DRAWS]
    if few and summary["method"] not in CHOSEN:
        named = ", ".join(few[:NAMED]) + (f" and {len(few) - NAMED} more" if len(few) > NAMED else "")
        reasons.append(f"fewer than {FEW_DRAWS} effective draws of {named}")
    apart = [name for name, row in rows.items() if (row.get("r_hat") or 1.0) > UNMIXED]
    if apart:
        reasons.append(f"independent runs disagree about {', '.join(apart)}")
    reasons += [caution.sentence for caution in grave(read_cautions(summary["cautions"]))]
    total = sum(summary["excluded"].values())
    if summary["evaluations"] and total > LOST * summary["evaluations"]:
        reasons.append(f"{100 * total / summary['evaluations']:.0f} % of the rollouts failed")
    return reasons


def _conflicts(record: PosteriorRecord) -> list[str]:
    """Parameters whose posterior has little prior mass: the data contradict the prior, or the model."""
    known = [info.name for info in record.free if info.name in record.prior]
    names = [name for name in known if contradicts(record.flat(name), record.prior[name])]
    return [contradiction(names)] if names else []


def _reservations(summary: Mapping[str, Any]) -> list[str]:
    reasons = []
    edge = [name for name, row in summary["parameters"].items() if row["at_bound"]]
    if edge:
        reasons.append(
            f"{', '.join(edge)} {'sits' if len(edge) == 1 else 'sit'} on a hard bound or at an end of the prior, "
            "which decided and not the data"
        )
    share = summary["coverage"].get(BAND)
    if share is not None and share > VAGUE:
        reasons.append(f"its 90 % bands hold {100 * share:.0f} % of the measurements: wider than need be")
    if not summary["rmse"]["test"]:
        reasons.append("no recording was kept back to test it on")
    return reasons


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
