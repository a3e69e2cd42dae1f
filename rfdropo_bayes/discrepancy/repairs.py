"""Repairs of errors of a stepwise search.

`paying_pair`, if the best step leaves more than twice the noise's variance: compliance and pretension of cables pay
    only together. `optimised_again`, before a step joins: a candidate must not be named for an effect of base
    parameters, or for continuing an optimisation that stopped early. `simplified`, after a further step: a mixture of
    two causes may be named before either. A first lag may vanish after a delay and another lag are found; a gain of
    each cable may be a gain of all cables after a rotation of the camera is found.

Two more concern single refits, see `ExtensionSearch`: all sizes of an amplitude are tried, as time shifts have an
optimum at every jump of a command; and a misspecified model is also optimised from a distant start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rfdropo_bayes.discrepancy.candidates import probe_all, start_together
from rfdropo_bayes.discrepancy.extension import DISCRETISATION, SHARES, TOLD_APART, Added, ExtensionSearch
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, best_between, heights, optimise
from rfdropo_bayes.discrepancy.inadequacy import misspecified
from rfdropo_bayes.discrepancy.score import joint_statistic, project_out, span
from rfdropo_bayes.discrepancy.score_tests import ScoreRow, ScoreTests, run_score_tests
from rfdropo_bayes.discrepancy.unknown_size import gram_evidence

PAIRS = 3  # that are refitted


def paying_pair(search: ExtensionSearch, tests: ScoreTests, named: Sequence[str], single: Added | None) -> list[Added]:
    """Two mechanisms at once, if the best leaves most of a large misfit; empty if they do not pay.

    Pairs are ranked by the evidence of their linear effects, as single candidates are, and the leading pairs are
    refitted.

    Args:
        search: search beside the present model.
        tests: its score tests.
        named: mechanisms in it.
        single: the best single mechanism; None without it.
    """
    fit, last, target = tests.fit, single.fit if single else tests.fit, search.target
    taken = float(fit.residual @ fit.residual - last.residual @ last.residual)
    if not misspecified(single.fit_target if single else target, last.x):
        return []
    rows = {row.name: row for row in tests.rows if row.probe is not None and row.name != DISCRETISATION}
    heads = sorted(rows.values(), key=lambda row: -row.score)[: search.rules.members]
    drops = {
        tuple(sorted((a.name, b.name))): joint_statistic(a.probe.mark, b.probe.mark, fit.residual)
        for a in heads
        for b in rows.values()
        if a.name != b.name and a.probe and b.probe
    }
    worth = search.rules.evidence + np.log(len(search.candidates))
    evidence = _linear_evidence(target, fit, rows, [p for p in drops if drops[p] > taken + 2.0 * worth])
    leading = sorted(evidence, key=lambda names: -evidence[names])[:PAIRS]
    fits = {}
    for names in leading:
        probes = [probe for name in names if (probe := rows[name].probe)]
        constant = [index for probe in probes for index in probe.point]
        added = np.concatenate([c.indices for c in search.candidates if c.name in names])
        start = best_between(target, fit.x, start_together(fit, probes), constant, SHARES)
        fits[names] = optimise(target, start, np.array([*fit.free, *np.setdiff1d(added, fit.free)]))
        gained = search.gain(fit, fits[names])
        search.report(f"refit with {' and '.join(names)}: log Bayes factor {gained:.1f}")
    if not fits:
        return []
    gains = {names: search.gain(fit, each) for names, each in fits.items()}
    best = max(fits, key=lambda names: gains[names])
    if gains[best] < worth + (single.log_bayes_factor if single else 0.0):
        return []
    alone = {name: search.refit(fit, rows[name]) for name in best}
    first, second = sorted(best, key=lambda name: -search.gain(fit, alone[name]))
    if any(search.gain(alone[name], fits[best]) < search.rules.evidence for name in best):
        return []
    between = search.score_tests(alone[first], [*named, first])
    own, further = search.gain(fit, alone[first]), search.gain(alone[first], fits[best])
    return [
        Added(first, (first,), tests, alone[first], own, single.refits if single else {}, target),
        Added(second, (second,), between, fits[best], further, {}, target),
    ]


def _linear_evidence(
    target: FitTarget, fit: Fit, rows: Mapping[str, ScoreRow], pairs: Sequence[tuple[str, ...]]
) -> dict[tuple[str, ...], float]:
    """Evidence of the linear effects of pairs, see `unknown_size`."""
    names = sorted({name for pair in pairs for name in pair})
    probes = {name: probe for name in names if (probe := rows[name].probe)}
    usual = target.forward.coordinates.prior_sd
    effects = [p.columns * (usual[list(p.amplitudes)] if p.amplitudes else 1.0) for p in probes.values()]
    if not effects:
        return {}
    effect = project_out(span(fit.jacobian), np.concatenate(effects, axis=1))
    gram, moment = effect.T @ effect, effect.T @ fit.residual
    ends = np.cumsum([0, *(each.shape[1] for each in effects)])
    place = {name: np.arange(*ends[k : k + 2]) for k, name in enumerate(probes)}
    own = {pair: np.concatenate([place[name] for name in pair]) for pair in pairs}
    return {pair: gram_evidence(gram[np.ix_(at, at)], moment[at]) for pair, at in own.items()}


def optimised_again(search: ExtensionSearch, step: Added) -> Fit | None:
    """The model before a step, optimised again from the step's result; None if that is no better."""
    before, target = step.before.fit, search.target
    free, added = step.fit.free, np.setdiff1d(step.fit.free, before.free)
    emptied = step.fit.x.copy()
    emptied[added] = before.x[added]
    # An effect that base parameters can also explain belongs to them, such as a gain of all cables and the radius of
    # their drums. Otherwise it would be credited to the candidate.
    place = {index: k for k, index in enumerate(free)}
    own, others = ([place[index] for index in chosen] for chosen in (before.free, added))
    done = step.fit.jacobian[:, others] @ (step.fit.x[added] - before.x[added])
    imitated = emptied.copy()
    imitated[before.free] += np.linalg.lstsq(step.fit.jacobian[:, own], done, rcond=1e-6)[0]
    starts = np.clip(np.stack([emptied, imitated]), *target.forward.coordinates.bounds)
    again = optimise(target, starts[int(np.argmax(heights(target, starts, "without")))], before.free)
    return again if again.log_evidence > before.log_evidence + 1.0 else None


def simplified(search: ExtensionSearch, base: Fit, steps: Sequence[Added]) -> tuple[Added, ...]:
    """Steps without redundant steps, whose evidence beside all others is below `Rules.evidence`, and with a simpler
    candidate in the place of a step if its evidence is larger.

    A candidate is simpler if it has fewer parameters. It was refitted in the same step, before the later steps took
    their part of the effect. If its evidence is nearly as large, it joins the class of the step.
    """
    if len(steps) < 2:
        return tuple(steps)
    last, null = steps[-1], search.target.forward.coordinates.null
    for index in range(len(steps) - 1):
        step = steps[index]
        if step.name == DISCRETISATION:
            continue
        before = steps[index - 1].fit if index else base
        gone = np.setdiff1d(step.fit.free, before.free)
        names = {each.name for each in steps}
        simpler = [
            c
            for c in search.candidates
            if c.name in step.refits and c.name not in names and len(np.setdiff1d(c.indices, before.free)) < len(gone)
        ]
        emptied = last.fit.x.copy()
        emptied[gone] = null[gone]
        kept = np.setdiff1d(last.fit.free, gone)
        if not simpler and search.at_stake(last.fit, kept) > TOLD_APART:
            continue
        empty = optimise(last.fit_target, emptied, kept)
        own, rules = search.gain(empty, last.fit), search.rules
        if own < rules.evidence:
            search.report(f"{step.name} is no longer needed")
            return simplified(search, base, without(search, steps, index, base))
        if simpler:
            search.report(f"in the place of {step.name}: refitting {', '.join(c.name for c in simpler)}")
        probes = probe_all(search.target, empty, simpler)
        tests = run_score_tests(
            search.target, empty, probes, [c.name for c in simpler], [search.seed, index], search.rules.bootstraps
        )
        fits = {row.name: search.refit(empty, row) for row in tests.rows if row.probe is not None}
        gains = {name: search.gain(empty, fit) for name, fit in fits.items()}
        best = max(gains, key=lambda name: gains[name], default=None)
        if best is None:
            continue
        tied = [name for name in gains if gains[name] > max(own, gains[best]) - rules.evidence]
        if gains[best] > own:
            search.report(f"{best} takes the place of {step.name}")
            members = (best, *(name for name in tied if name != best))
            members += (step.name,) if own > gains[best] - rules.evidence else ()
            simple = Added(best, members, tests, fits[best], gains[best], gains, last.fit_target)
            return simplified(search, base, (*without(search, steps, index, base), simple))
        if further := [name for name in tied if name not in step.members]:
            tied_step = replace(step, members=(*step.members, *further))
            steps = (*steps[:index], tied_step, *steps[index + 1 :])
    return tuple(steps)


def without(search: ExtensionSearch, steps: Sequence[Added], index: int, base: Fit) -> tuple[Added, ...]:
    """Steps without one step with parameters; later steps are refitted without it."""
    candidate, null = search.candidate(steps[index].name), search.target.forward.coordinates.null
    assert candidate is not None
    gone = np.setdiff1d(candidate.indices, steps[index - 1].fit.free if index else base.free)
    kept, fit_targets = list(steps[:index]), [step.fit_target for step in steps[: index + 1]]
    # The next step now follows the model before the dropped step, with the tests and refits beside that model. A step
    # that had taken the place of another was tested beside its rivals alone.
    dropped, following = steps[index], list(steps[index + 1 :][:1])
    if following and following[0].name in {row.name for row in dropped.before.rows}:
        following = [replace(following[0], before=dropped.before, refits=dropped.refits)]
    elif following:
        again = search.score_tests(kept[-1].fit if kept else base, [step.name for step in kept])
        following = [replace(following[0], before=again)]
    for step in [*following, *steps[index + 2 :]]:
        before, start = kept[-1].fit if kept else base, step.fit.x.copy()
        start[gone] = null[gone]
        fit = optimise(step.fit_target, start, np.setdiff1d(step.fit.free, gone))
        under = optimise(step.fit_target.on(fit_targets[-1].forward), before.x, before.free)
        fit_targets.append(step.fit_target)
        kept.append(replace(step, fit=fit, log_bayes_factor=search.gain(under, fit)))
    return tuple(kept)
