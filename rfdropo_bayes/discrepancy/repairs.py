"""What a search that takes one step after the other does not see by itself.

`paying_pair`, where the best step leaves more than twice the noise's variance: compliance and pretension of cables pay
    only together.
`climbed_again`, before a step joins: a candidate must not be named for what base parameters can do, or for having moved
    a climb on that had stopped early.
`without_needless`, after a further step: of a lag found first, and a delay and another lag found later, the first comes
    down to nothing; what two causes together look like may be named before either of them.

Two more concern single refits, see `ExtensionSearch`: all sizes of an amplitude are looked through, as shifts in time
have a summit at every jump of a command; and a model that stays far off is climbed from afar, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.discrepancy.candidates import start_together
from rfdropo_bayes.discrepancy.extension import DISCRETISATION, SHARES, TOLD_APART, WIDER, Added, ExtensionSearch
from rfdropo_bayes.discrepancy.fit import Fit, best_between, climb, heights
from rfdropo_bayes.discrepancy.inadequacy import far_off
from rfdropo_bayes.discrepancy.score import joint_statistic
from rfdropo_bayes.discrepancy.screen import Screen, ScreenRow

PAIRS = 3  # that are refitted


def paying_pair(search: ExtensionSearch, found: Screen, named: Sequence[str], single: Added | None) -> list[Added]:
    """Two mechanisms at once, where the best one leaves most of a large misfit; none where they do not pay.

    Pairs are ranked by what the linear model says of them, and the leading ones are refitted.

    Args:
        search: of the present model.
        found: its screen.
        named: mechanisms in it.
        single: the best single one; None without one.
    """
    if search.room(len(named)) < 2:
        return []
    fit, last, target = found.fit, single.fit if single else found.fit, search.target
    taken = float(fit.residual @ fit.residual - last.residual @ last.residual)
    if not far_off(single.judge if single else target, last.x):
        return []
    rows = {row.name: row for row in found.rows if row.probe is not None and row.name != DISCRETISATION}
    heads = sorted(rows.values(), key=lambda row: -row.lm)[: search.rules.members]
    drops = {
        tuple(sorted((a.name, b.name))): joint_statistic(a.probe.mark, b.probe.mark, fit.residual)
        for a in heads
        for b in rows.values()
        if a.name != b.name and a.probe and b.probe
    }
    worth = search.rules.evidence + np.log(len(search.candidates))
    leading = sorted((p for p in drops if drops[p] > taken + 2.0 * worth), key=lambda p: -drops[p])[:PAIRS]
    fits = {}
    for names in leading:
        fits[names] = _refit_pair(search, fit, [rows[name] for name in names])
        gained = fits[names].log_evidence - fit.log_evidence
        search.report(f"refit with {' and '.join(names)}: log Bayes factor {gained:.1f}")
    if not fits:
        return []
    best = max(fits, key=lambda names: fits[names].log_evidence - WIDER * len(fits[names].free))
    enough = search.surpasses(fits[best], single.fit, worth) if single else True
    if not enough or fits[best].log_evidence < fit.log_evidence + worth:
        return []
    alone = {name: search.refit(fit, rows[name]) for name in best}
    first, second = sorted(best, key=lambda name: -alone[name].log_evidence)
    between = search.screened(alone[first], [*named, first])
    gains = [alone[first].log_evidence - fit.log_evidence, fits[best].log_evidence - alone[first].log_evidence]
    return [
        Added(first, (first,), found, alone[first], gains[0], single.refits if single else {}, target),
        Added(second, (second,), between, fits[best], gains[1], {}, target),
    ]


def _refit_pair(search: ExtensionSearch, fit: Fit, rows: Sequence[ScreenRow]) -> Fit:
    """The model of a fit with two candidates in it."""
    probes = [row.probe for row in rows if row.probe is not None]
    chosen = [c.indices for c in search.candidates if c.name in [row.name for row in rows]]
    held = [index for probe in probes for index in probe.point]
    start = best_between(search.target, fit.x, start_together(fit, probes), held, SHARES)
    return climb(search.target, start, np.array([*fit.free, *np.setdiff1d(np.concatenate(chosen), fit.free)]))


def climbed_again(search: ExtensionSearch, step: Added) -> Fit | None:
    """The model before a step, climbed from where the step led; None where that is no better."""
    before, target = step.before.fit, search.target
    free, added = step.fit.free, np.setdiff1d(step.fit.free, before.free)
    emptied = step.fit.x.copy()
    emptied[added] = before.x[added]
    # What base parameters can do, too, is theirs: a gain of all cables, beside the radius of their drums. Else it
    # would be credited to the candidate.
    place = {index: k for k, index in enumerate(free)}
    own, others = ([place[index] for index in chosen] for chosen in (before.free, added))
    done = step.fit.jacobian[:, others] @ (step.fit.x[added] - before.x[added])
    imitated = emptied.copy()
    imitated[before.free] += np.linalg.lstsq(step.fit.jacobian[:, own], done, rcond=1e-6)[0]
    starts = np.clip(np.stack([emptied, imitated]), *target.forward.coordinates.bounds)
    again = climb(target, starts[int(np.argmax(heights(target, starts, "without")))], before.free)
    return again if again.log_evidence > before.log_evidence + 1.0 else None


def without_needless(search: ExtensionSearch, base: Fit, steps: Sequence[Added]) -> tuple[Added, ...]:
    """Steps less those without whose parameters the last model has as much evidence."""
    if len(steps) < 2:
        return tuple(steps)
    last, null = steps[-1], search.target.forward.coordinates.null
    for index in range(len(steps) - 1):
        if steps[index].name == DISCRETISATION:
            continue
        before = steps[index - 1].fit if index else base
        gone = np.setdiff1d(steps[index].fit.free, before.free)
        emptied = last.fit.x.copy()
        emptied[gone] = null[gone]
        if _nats_to(last.fit, emptied, gone) > TOLD_APART:
            continue
        if climb(last.judge, emptied, np.setdiff1d(last.fit.free, gone)).log_evidence >= last.fit.log_evidence:
            search.report(f"{steps[index].name} is no longer needed")
            return without_needless(search, base, without(search, steps, index, base))
    return tuple(steps)


def without(search: ExtensionSearch, steps: Sequence[Added], index: int, base: Fit) -> tuple[Added, ...]:
    """Steps less one of them that has parameters, the later ones refitted without it."""
    candidate, null = search.candidate(steps[index].name), search.target.forward.coordinates.null
    assert candidate is not None
    gone = np.setdiff1d(candidate.indices, steps[index - 1].fit.free if index else base.free)
    found, judges = list(steps[:index]), [step.judge for step in steps[: index + 1]]
    for step in steps[index + 1 :]:
        before, start = found[-1].fit if found else base, step.fit.x.copy()
        start[gone] = null[gone]
        fit = climb(step.judge, start, np.setdiff1d(step.fit.free, gone))
        under = climb(step.judge.on(judges[-1].forward), before.x, before.free)
        judges.append(step.judge)
        found.append(replace(step, fit=fit, log_bayes_factor=fit.log_evidence - under.log_evidence))
    return tuple(found)


def _nats_to(fit: Fit, point: Float[np.ndarray, " d"], moved: Int[np.ndarray, " moved"]) -> float:
    """What a fit's normal approximation says that a model loses at best where some coordinates are held at a point."""
    place = [int(np.flatnonzero(fit.free == index)[0]) for index in moved]
    apart = fit.x[moved] - point[moved]
    return 0.5 * float(apart @ np.linalg.solve(fit.covariance[np.ix_(place, place)], apart))
