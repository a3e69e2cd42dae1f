"""The audit in a sentence that a lab can act on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rfdropo_bayes.bayes.noise.autoregression import INNOVATIONS, REPEATS, STATED
from rfdropo_bayes.discrepancy.candidates import spoken
from rfdropo_bayes.discrepancy.deadline import INTERRUPT
from rfdropo_bayes.discrepancy.extension import DISCRETISATION, TOLD_APART
from rfdropo_bayes.discrepancy.gain import Gain, noise_distance
from rfdropo_bayes.discrepancy.law_words import law_sentence, ports_sentence
from rfdropo_bayes.discrepancy.omnibus import POSE
from rfdropo_bayes.discrepancy.pipeline import Answer
from rfdropo_bayes.discrepancy.prequential import BEGINNING, begins_wrong, prequential
from rfdropo_bayes.discrepancy.prior_ends import in_words
from rfdropo_bayes.discrepancy.score_tests import p_in_words
from rfdropo_bayes.discrepancy.verdict import EXPLAINED, NEGLIGIBLE, NO_DISCREPANCY, NO_VERDICT, UNEXPLAINED, unclear

MOST_EXCLUDED = 3
MOST_SIZES = 4


def sentence(answer: Answer, findings: Sequence[dict[str, Any]]) -> str:
    """Findings, explained share of the discrepancy, excluded causes, and residual."""
    words = (
        _words(answer, findings)
        + ports_sentence(answer)
        + _compared(answer, findings)
        + _unfitted_alone(answer)
        + _suspicion(answer)
        + _shifted(answer)
        + (in_words(answer.priors) if answer.steps else "")
        + _numerical(answer)
        + _beginning(answer)
        + _left_out(answer)
        + _stopped(answer)
    )
    return words[0].upper() + words[1:]


def _compared(answer: Answer, findings: Sequence[dict[str, Any]]) -> str:
    """Common part of two compared groups of recordings."""
    groups = answer.problem.compared
    if groups is None or answer.verdict == NO_VERDICT:
        return ""
    names = " and ".join(groups.names)
    left_out = f" {len(groups.left_out)} recordings of neither are left out." if groups.left_out else ""
    both = [finding["mechanism"].replace("_", " ") for finding in findings if not finding["group"]]
    lacking = f" {' and '.join(both)} {'is' if len(both) == 1 else 'are'} the same in both." if both else ""
    if len(both) == len(findings):
        return f"{lacking} No parameter and no mechanism is found to differ between {names}.{left_out}"
    return f"{lacking} All else is shared by {names}.{left_out}"


def _left_out(answer: Answer) -> str:
    count = len(answer.problem.left_out)
    does = "candidate does" if count == 1 else "candidates do"
    return f" Left out: {count} {does} not run on this body, engine or data." if count else ""


def _stopped(answer: Answer) -> str:
    """Note on a stopped audit: the reason, and the unfinished parts."""
    cost = answer.cost
    if not cost.stopped:
        return ""
    not_done = f" Not done: {'; '.join(map(spoken, cost.unfinished))}." if cost.unfinished else ""
    if cost.stopped == INTERRUPT:
        return f" The audit was stopped after {cost.seconds:.0f} s: these are its results so far.{not_done}"
    minutes = answer.problem.rules.minutes
    return (
        f" The time was up after {minutes:g} minutes ([audit] minutes), before every question was asked: raise it and "
        f"go on with --resume.{not_done}"
    )


def _unfitted_alone(answer: Answer) -> str:
    """Note if the base model could be fitted only with the missing effects."""
    if answer.base.converged or not answer.steps:
        return ""
    return (
        " The fit of the base model alone has not converged: a better fit may leave smaller residuals, "
        "and the findings then explain less."
    )


def _suspicion(answer: Answer) -> str:
    noise = answer.suspected
    if noise is None:
        return ""
    stated, other = (1e3 * noise_distance(n.first) for n in (answer.target.noise, noise))
    memory = f", {noise.first.autocorrelation[1]:.2f} of it kept from row to row," if noise.first.order else ""
    return (
        f" But noise of {other:.2g} mm{memory} instead of the {stated:.2g} mm stated would leave no discrepancy: "
        "check [noise], or repeat one command sequence three times."
    )


def _shifted(answer: Answer) -> str:
    if answer.shift is None:
        return ""
    return (
        f" Repeats differ by constants of {1e3 * answer.shift:.2g} mm, which pass for noise here: a frame or a "
        "start that was not the same each time? Let camera_offset differ in [model.per_recording]."
    )


def _numerical(answer: Answer) -> str:
    """Note on a simulation that changes by more than the noise with half the time step, or whose error is corrected."""
    error, noise = answer.numerical, noise_distance(answer.target.noise.first)
    if error is not None and error <= noise and answer.target.forward.correction:
        return (
            f" The data show the simulation's own error ({1e3 * error:.2g} mm by half the time step and a finer mesh, "
            f"noise {1e3 * noise:.2g} mm); the findings are without it."
        )
    if error is None or error <= noise:
        return ""
    return (
        f" Half the time step and a finer mesh move the last model's markers by {1e3 * error:.2g} mm, the "
        f"noise by {1e3 * noise:.2g} mm: the findings may reflect an error of the simulation; shorten "
        "[simulator] time_step."
    )


def _beginning(answer: Answer) -> str:
    """Question to the user if the base model fails in the first block of rows only."""
    if answer.verdict == NO_DISCREPANCY or not answer.converged:
        return ""
    scores = prequential(answer.target, answer.base)
    return f" {BEGINNING}" if begins_wrong(scores, answer.problem.rules.level) else ""


def _words(answer: Answer, findings: Sequence[dict[str, Any]]) -> str:
    if not answer.fitted:
        return f"No verdict: the fit of the base model is not done; so far it leaves {_base_error(answer)}."
    if answer.law is not None:
        return _described(answer, findings)
    if answer.verdict == NEGLIGIBLE:
        return _small(answer)
    if not answer.converged:
        return _unconverged(answer, findings)
    if answer.verdict == NO_DISCREPANCY:
        refined = answer.test_series[0].refined
        finer = " on a mesh and time step twice as fine, which differ too little to be named" if refined else ""
        return (
            "No discrepancy: the base model's residuals are consistent with noise in these data (joint "
            f"test p {_p(answer)}{finer}{_assumption(answer)}).{_invisible(answer)}"
        )
    if not findings and answer.test_series[0].omnibus.p > answer.problem.rules.level:
        distance = 1e3 * noise_distance(answer.target.noise.first)
        return (
            f"The base model's residuals, {distance:.2g} mm, change too slowly to be measurement noise, "
            "but without repeats they cannot be distinguished from noise, and no candidate is "
            f"significant (joint test p {_p(answer)})."
        )
    if not findings and answer.verdict == NO_VERDICT:
        wrong = f"Something is wrong with the base model (joint test p {_p(answer)})"
        return f"{wrong}; {_leading(answer)}."
    if not findings:
        tail = f"the residual has a standard deviation of {1e3 * answer.remainder.amplitude:.2g} mm"
        asked = "no candidate of the library explains it" if answer.problem.candidates else "no candidate was asked"
        return f"Something is wrong with the base model, and {asked}: {tail}."
    named = " and ".join(_named(finding) for finding in findings)
    gain = answer.validation.gain
    if gain is None:
        return f"{named}; how much it explains could not be measured."
    low, high = (100.0 * min(max(x, 0.0), 1.0) for x in gain.interval)
    share = f"{gain.share} of the discrepancy"
    if unclear(answer.problem.rules, gain):
        verb, likelier = "is" if len(findings) == 1 else "are", "" if gain.elpd_difference > 0.0 else "no "
        head = (
            f"{named} {verb} named, but unseen recordings do not determine the explained share of the "
            f"discrepancy ([{low:.0f}, {high:.0f}] %); they are {likelier}likelier with it"
        )
    elif gain.worse:
        worse = "unseen recordings are predicted worse"
        head = f"Unexplained: with the best of the library, {named}, {worse} ({_errors(gain)})"
    elif answer.verdict == NO_VERDICT:
        head = f"No verdict: the best so far, {named}, explains {share}"
    elif answer.verdict == UNEXPLAINED:
        head = f"Unexplained: the best of the library, {named}, explains only {share}"
    elif answer.verdict in (EXPLAINED, "equivalent"):
        head = f"{named} explain{'s' if len(findings) == 1 else ''} {share}"
    elif answer.test_series[-1].omnibus.p > answer.problem.rules.extended_passes:
        head = f"The best of the library, {named}, explains {share}; the rest may be noise, but that is not certain"
    else:
        head = f"The best of the library, {named}, explains {share}, but {_pattern(answer)}"
    return f"{head}{_excluded(answer)}; {_remains(answer)}{_assumption(answer)}.{_adoption(answer)}"


def _described(answer: Answer, findings: Sequence[dict[str, Any]]) -> str:
    """The law, after the mechanisms beside it if these explain more."""
    gain = answer.validation.gain
    if gain is None or answer.law_leads:
        return law_sentence(answer, first=True)
    names, verb = " and ".join(map(_named, findings)), "explains" if len(findings) == 1 else "explain"
    larger = f"{names} {verb} {gain.share} of the discrepancy in unseen recordings ({_errors(gain)})"
    return f"{larger}. {law_sentence(answer, first=False)}"


def _base_error(answer: Answer) -> str:
    """Root mean square distance between markers and the base model."""
    target, own = answer.target, answer.target.measurements.columns[0]
    errors = target.errors(answer.base.x)[..., own][target.measurements.valid[..., own]]
    return f"{1e3 * float(np.sqrt(3.0 * np.mean(errors**2))):.3g} mm"


def _leading(answer: Answer) -> str:
    """The candidates that stand out so far: refitted candidates with their Bayes factors, or else the leading rows of
    the score tests.
    """
    refits = sorted(answer.refits.items(), key=lambda entry: -entry[1])[:MOST_EXCLUDED]
    if refits:
        brings = ", ".join(f"{spoken(name)} {gained:.0f} nats" for name, gained in refits)
        return f"no refitted candidate has the required evidence ({brings})"
    seen = [row for row in answer.test_series[0].rows if row.adjusted_p <= answer.problem.rules.level]
    if not answer.test_series[0].rows:
        return "no candidate was tested"
    if not seen:
        return "no candidate is significant"
    return f"significant: {', '.join(spoken(row.name) for row in seen[:MOST_EXCLUDED])}; none was refitted to the end"


def _unconverged(answer: Answer, findings: Sequence[dict[str, Any]]) -> str:
    """Note if the last fit has not converged."""
    residual = answer.extended.residual
    squares = (
        f"sum of squares {residual @ residual:.3g} for {np.count_nonzero(residual)} values, and better points beside it"
    )
    remedy = "Start from a calibration with --from, narrow the priors, or shorten [simulator] time_step."
    if not findings:
        leading = f" {_leading(answer).capitalize()}." if answer.test_series[0].rows else ""
        return f"No verdict: the fit of the base model has not converged ({squares}).{leading} {remedy}"
    named = " and ".join(_named(finding) for finding in findings)
    gain = answer.validation.gain
    worth = "" if gain is None else f"; unseen recordings are missed by {_errors(gain)}"
    return f"{named} is the best so far{worth}, but the fit with it has not converged ({squares}). {remedy}"


def _errors(gain: Gain) -> str:
    return f"{1e3 * gain.rmse_base:.3g} mm without, {1e3 * gain.rmse_extended:.3g} mm with it"


def _small(answer: Answer) -> str:
    """Note on a significant discrepancy that is too small to matter."""
    size, noise = answer.remainder.amplitude * np.sqrt(3.0), noise_distance(answer.target.noise.first)
    limit, numerical = answer.problem.rules.matters, answer.numerical
    beside = f"the noise is {1e3 * noise:.2g} mm"
    if numerical is not None:
        beside += f", and half the time step and a finer mesh move the markers by {1e3 * numerical:.2g} mm"
    if limit is not None:
        beside += f"; [audit] matters_mm is {1e3 * limit:g}"
    return (
        f"Negligible: a discrepancy of {1e3 * size:.2g} mm is sure (joint test p {_p(answer)}), for repeats are many, "
        f"but {beside}. Nothing need be done."
    )


def _invisible(answer: Answer) -> str:
    """Candidates that remain possible because the measurements cannot show them."""
    names = [
        row.name.replace("_", " ")
        for row in answer.test_series[0].rows
        if row.probe is None and row.name != DISCRETISATION and not answer.problem.group_of(row.name)
    ]
    if not names:
        return ""
    which = ", ".join(names[:MOST_EXCLUDED]) + (" ..." if len(names) > MOST_EXCLUDED else "")
    data = " and ".join(name.replace("_", " ") for name in answer.target.measurements.names_of_channels)
    return f" The measured data ({data}) cannot show {which}."


def _p(answer: Answer) -> str:
    return p_in_words(answer.test_series[0].omnibus.p, answer.problem.rules.bootstraps)


def _adoption(answer: Answer) -> str:
    """Note on the adopted findings."""
    gain = answer.validation.gain
    if not answer.adopted and gain is not None and gain.opposed and not gain.worse:
        worst, recording = min(gain.against.items(), key=lambda item: item[1].elpd)
        errors = f"{1e3 * recording.rmse_base:.3g} mm without, {1e3 * recording.rmse_extended:.3g} mm with it"
        return f" {worst} is clearly less likely with this ({errors}): extended.toml keeps the base model."
    if not answer.adopted:
        return " Unseen recordings do not clearly support this: extended.toml keeps the base model."
    if answer.unsupported:
        names = " and ".join(map(spoken, answer.unsupported))
        return f" The fitted recordings also asked for {names}, which unseen recordings do not support: not adopted."
    return ""


def _named(finding: dict[str, Any]) -> str:
    name = finding["mechanism"].replace("_", " ") + (f" in {finding['group']}" if finding["group"] else "")
    if finding["mechanism"] == DISCRETISATION:
        return "the coarse mesh or time step"
    given = finding["parameters"]
    measured = {row["parameter"]: row for row in finding["relative"].values()}
    # If cables leave the common scale of forces and stiffness free, a ratio to Young's modulus is surer than its parts.
    ratios = {name: row for name, row in measured.items() if row["power"]}
    of_ratio = {
        name: given[name] | {key: row[key] * row["young_modulus"] ** row["power"] for key in ("mean", "sd")}
        for name, row in ratios.items()
    }
    rows = given | measured | of_ratio
    surest = sorted(given, key=lambda name: -abs(rows[name]["mean"]) / max(rows[name]["sd"], 1e-300))[:MOST_SIZES]
    sizes = ", ".join(_size(rows[name]) for name in given if name in surest)
    if set(surest) & set(ratios):
        modulus = next(iter(ratios.values()))["young_modulus"]
        sizes += f" for a Young's modulus of {modulus / 1e6:.3g} MPa, as the data show the ratio"
    others = [spoken(other) for other in finding["equivalence_class"][1:]]
    alike = f" (indistinguishable from {', '.join(others)} in these data)" if others else ""
    return f"{name} ({sizes}){alike}"


def _size(row: dict[str, Any]) -> str:
    unit = "" if row["unit"] == "-" else f" {row['unit']}"
    return f"{spoken(row['title'])} {row['mean']:.3g} \u00b1 {row['sd']:.2g}{unit}"


def _excluded(answer: Answer) -> str:
    """Candidates that were refitted in the first step and are much less likely."""
    step = answer.steps[0]
    worse = [
        spoken(name)
        for name, value in step.refits.items()
        if name not in step.members
        and value < step.refits.get(step.name, step.log_bayes_factor) - TOLD_APART
        and all(name != other.name for other in answer.steps)
    ]
    return f"; {', '.join(worse[:MOST_EXCLUDED])} excluded" if worse else ""


def _only_noise(answer: Answer) -> bool:
    """Whether unseen recordings are missed by no more than repeats differ by."""
    noise, gain = answer.target.noise, answer.validation.gain
    return noise.source == REPEATS and gain is not None and noise_distance(noise.first) >= gain.rmse_extended


def _pattern(answer: Answer) -> str:
    """Clause about an extended model that fails the joint test."""
    rules, omnibus = answer.problem.rules, answer.test_series[-1].omnibus
    last, single = omnibus.p, omnibus.single
    follows = (
        " of a shift, a drift or the pose"
        if single[POSE] < min(p for name, p in single.items() if name != POSE)
        else ""
    )
    words = f"the fitted recordings keep a pattern{follows} (joint test p {p_in_words(last, rules.bootstraps)})"
    if last > rules.level or _only_noise(answer):
        return words
    gain, numerical = answer.validation.gain, answer.numerical
    if answer.target.noise.source == REPEATS and gain is not None and numerical is not None:
        beyond = gain.rmse_extended**2 - noise_distance(answer.target.noise.first) ** 2
        if beyond <= numerical**2:
            return f"{words}, no larger than the error of time step and elements ({1e3 * numerical:.2g} mm)"
    return f"{words}: something else is at work"


def _remains(answer: Answer) -> str:
    assert answer.validation.gain is not None
    remain = f"{1e3 * answer.validation.gain.rmse_extended:.2g} mm remain"
    if _only_noise(answer):
        return f"{remain}, no more than repeats differ by"
    if answer.target.noise.source != REPEATS:
        return remain
    return f"{remain}, {1e3 * noise_distance(answer.target.noise.first):.2g} mm of it noise"


def _assumption(answer: Answer) -> str:
    source = answer.target.noise.source
    if source == REPEATS:
        return ""
    if source == STATED:
        return "; the noise is as stated in the experiment file"
    taken = "an autoregression fitted to the residuals themselves"
    if source == INNOVATIONS:
        taken = "that part of the residuals which the rows before do not predict"
    words = f"; without repeats the noise is an assumption, {taken}"
    if apart := answer.target.measurements.apart:
        which = ", ".join(apart[:MOST_EXCLUDED]) + (" ..." if len(apart) > MOST_EXCLUDED else "")
        words += (
            f" (the same commands were repeated in {which}, but rows or clocks differ: [data] resample brings "
            "recordings onto one clock)"
        )
    return words
