"""Naming causes: the leading classes are refitted, the best joins the model, and the next screen follows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.discrepancy.candidates import (
    Candidate,
    Probe,
    discretisation_probe,
    fixed_drop,
    lead,
    probe_all,
    screening_rollouts,
    start_together,
)
from rfdropo_bayes.discrepancy.deadline import OutOfTime, about
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, best_between, climb, climb_rollouts, heights
from rfdropo_bayes.discrepancy.forward import Forward
from rfdropo_bayes.discrepancy.gain import noise_distance
from rfdropo_bayes.discrepancy.inadequacy import as_measured, far_off, fit_with_noise
from rfdropo_bayes.discrepancy.omnibus import Omnibus
from rfdropo_bayes.discrepancy.score import joint_statistic, likeness, project_out, span
from rfdropo_bayes.discrepancy.screen import Screen, ScreenRow, p_in_words, screen

DISCRETISATION = "discretisation"
SHARES = np.array([1.0, 0.5, 0.2, 0.05])
SCANNED = tuple((k + 0.5) / 32 for k in range(32))
"""Quantiles of the prior of a candidate's size among which a climb's start is looked for. Of a delay of 70 ms under
a noise of 0.3 mm the summit is 8 ms wide; 32 quantiles are 5 ms apart there, 16 would be 9 ms."""
TOLD_APART = 10.0  # nats: a candidate that is so much worse, once refitted, is excluded, and of no class with the best
PAIRS = 3  # that are refitted
# Nats of evidence that a parameter which the data fix costs under a prior twice as wide. Widths are chosen by hand: a
# family of many parameters must not owe its place to that choice.
WIDER = float(np.log(2.0))


@dataclass(frozen=True)
class Rules:
    """Numbers the verdict depends on, fixed in advance.

    Attributes:
        family: probability that the screen names anything where nothing is wrong.
        class_cosine: signatures more alike than this are one class.
        classes: leading classes that are refitted; members: candidates refitted in all.
        effects: most mechanisms that are added to a model that is not far off.
        evidence: log Bayes factor a mechanism must bring to be added; one after the first must bring the logarithm of
            the number of candidates more, since with so many to choose from a few together imitate most things. One
            that brings so much less than the best is no longer its equal.
        bootstraps: simulated data sets behind every p-value.
        minutes: for the whole audit; when they are up it finishes with what it knows.
        base_passes, extended_passes: p-values of the joint test from which a model is let pass.
        explained, significant: shares of the discrepancy for "explained" and for "partly explained".
        matters: distance of a marker [m] below which a discrepancy does not; None where nobody says.
    """

    family: float = 0.02
    class_cosine: float = 0.95
    classes: int = 4
    members: int = 8
    effects: int = 3
    evidence: float = 3.0
    bootstraps: int = 999
    minutes: float = 30.0
    base_passes: float = 0.01
    extended_passes: float = 0.05
    explained: float = 0.8
    significant: float = 0.2
    matters: float | None = None


@dataclass(frozen=True)
class Added:
    """One mechanism that joined the model.

    Attributes:
        name: of the mechanism.
        members: its equivalence class, itself first: what looks the same and explains as much, and what has as much
            evidence once it is refitted, but for `Rules.evidence`.
        before: the screen of the model without it.
        fit: of the model with it.
        log_bayes_factor: of the model with against that without it, by Laplace.
        refits: log Bayes factors of all candidates that were refitted at this step.
        judge: the target under which the fit was found, see `inadequacy`. From the step `DISCRETISATION` on it has the
            finer simulator.
    """

    name: str
    members: tuple[str, ...]
    before: Screen
    fit: Fit
    log_bayes_factor: float
    refits: dict[str, float]
    judge: FitTarget


@dataclass
class ExtensionSearch:
    """The search over extensions of the base model: which of the candidates does it lack?

    Attributes:
        target: data, noise and simulator; every candidate is in the simulator, at its null value. Its noise
            is that under which the present model is judged, see `inadequacy`; its simulator that of the present model.
        candidates: that may be named.
        rules: see `Rules`.
        seed: of all bootstraps.
        finer: the simulator on a finer mesh and time step, for the candidate `DISCRETISATION`; None without it.
        report: called with a line of words as the search goes on.
    """

    target: FitTarget
    candidates: Sequence[Candidate]
    rules: Rules
    seed: int
    finer: Forward | None = None
    report: Callable[[str], None] = lambda line: None

    def screened(self, fit: Fit, without: Sequence[str] = ()) -> tuple[Screen, list[Probe]]:
        """Test a fit and screen the candidates that are not in it.

        An error of the mesh or time step that is too small to be named is no discrepancy either: where the residuals
        of the finer simulator pass more easily, it is they that count. Too small is one that the screen does not see,
        or that moves the markers by no more than the noise: see `_below_the_noise`.
        """
        # Of a family of parameters, some may be in the model by themselves.
        left = [replace(c, indices=tuple(i for i in c.indices if i not in fit.free)) for c in self.candidates]
        free = [
            c
            for c, whole in zip(left, self.candidates, strict=True)
            if c.name not in without and (c.indices or not whole.indices)
        ]
        names = [c.name for c in free]
        finer = None
        clock, forward = self.target.forward.deadline, self.target.forward
        count = screening_rollouts(self.target, free)
        self.report(f"screening {len(free)} candidates: {count} rollouts, {about(count * forward.pace)}")
        with clock.stage("screening"):
            probes = probe_all(self.target, fit, free)
        if self.finer is not None and DISCRETISATION not in without:
            refined = replace(self.target, forward=self.finer)
            with clock.stage("finer mesh"):
                finer = refined.recall("finer", [fit.x], lambda: {"left": refined.residual(fit.x[None])[0]})["left"]
            probes.append(discretisation_probe(fit, DISCRETISATION, finer, span(fit.jacobian)))
            names.append(DISCRETISATION)
        with clock.stage("joint test"):
            found = screen(self.target, fit, probes, names, [self.seed, len(without)], self.rules.bootstraps, finer)
            if self.target.known is not None:  # whether anything is wrong, the noise of the measurement says
                return replace(found, omnibus=self._tested(fit, len(without)), finer=None), probes
            if found.finer is None:
                return found, probes
            seen = found.row(DISCRETISATION).adjusted_p <= self.rules.family
            if seen and self._below_the_noise(fit):
                exact = _without_numerical_error(fit, probes[-1])
                again = screen(self.target, fit, probes, names, [self.seed, len(without)], self.rules.bootstraps, exact)
                found, seen = replace(found, finer=again.finer), False
        if not seen and found.finer is not None:
            found = replace(found, omnibus=max(found.omnibus, found.finer, key=lambda test: test.p))
        return found, probes

    def _below_the_noise(self, fit: Fit) -> bool:
        """Whether a finer mesh and time step move the markers by no more than the noise of one measurement.

        Many rows and repeats make any such shift significant, and no data set with this noise is worth a finer mesh.
        """
        if self.finer is None:
            return False
        shift = numerical_shift(self.target, self.finer, fit)
        return shift is not None and shift <= noise_distance(self.target.measured.noise.first)

    def tested(self, fit: Fit, number: int) -> Screen:
        """The joint test of a model, which screens no candidates and takes no rollouts."""
        found = screen(self.target, fit, [], [], [self.seed, number], self.rules.bootstraps)
        return replace(found, omnibus=self._tested(fit, number))

    def _tested(self, fit: Fit, number: int) -> Omnibus:
        """The joint test of a fit under the noise of the measurement."""
        known = self.target.measured
        measured = as_measured(self.target, fit)
        return screen(known, measured, [], [], [self.seed, number], self.rules.bootstraps).omnibus

    def name_causes(self, base: Fit) -> tuple[Fit, list[Added], Screen]:
        """Forward-stepwise extension: the base model, the steps taken, and the screen of the final model.

        The base model is another one where a candidate has led to a better optimum of it. When the time is up: the
        steps so far, and a joint test without candidates.
        """
        bases, steps = [base], list[Added]()
        try:
            found = self._name_causes(bases, steps)
        except OutOfTime:
            found = self.tested(steps[-1].fit if steps else bases[-1], len(steps))
        return bases[-1], without_each_other(steps), found

    def _name_causes(self, bases: list[Fit], steps: list[Added]) -> Screen:
        """Append steps until no more are called for, and better base models; the screen of the final model."""
        fit = bases[-1]
        renewed: set[int] = set()  # numbers of steps at which the model was climbed again: once at each
        while True:
            named = [step.name for step in steps]
            if steps:
                self.target, fit = fit_with_noise(self.target.measured, fit.x, fit.free)
                steps[-1] = replace(steps[-1], fit=fit, judge=self.target)
            found, _ = self.screened(fit, named)
            if not steps and found.omnibus.p > self.rules.base_passes:
                return found
            p = p_in_words(found.omnibus.p, self.rules.bootstraps)
            self.report(f"joint test p {p}; first: {found.rows[0].name if found.rows else 'none'}")
            if self._room(steps) < 1 or found.omnibus.p > self.rules.extended_passes:
                return found
            with self.target.forward.deadline.stage("refits"):
                step = self._extend(found, named)
                pair = list[Added]()
                with suppress(OutOfTime):
                    pair = self._pair(found, named, step) if self._room(steps) > 1 else []
            if pair:
                steps += pair
                with self.target.forward.deadline.stage("refits"):
                    steps[:] = self._without_needless(bases[-1], steps)
                fit = steps[-1].fit
                continue
            if step is None:
                return found
            better = None
            if len(steps) not in renewed:
                with self.target.forward.deadline.stage("refits"), suppress(OutOfTime):
                    better = self._climbed_again(step)
            if better is not None:
                renewed.add(len(steps))
                self.report(f"without {step.name}, a better optimum than before: the question once more")
                if steps:
                    gained = better.log_evidence - fit.log_evidence
                    steps[-1] = replace(steps[-1], fit=better, log_bayes_factor=steps[-1].log_bayes_factor + gained)
                else:
                    bases.append(better)
                fit = better
                continue
            steps.append(step)
            self.target, fit = step.judge, step.fit
            if len(steps) > 1:
                with self.target.forward.deadline.stage("refits"):
                    steps[:] = self._without_needless(bases[-1], self._reconsider(bases[-1], steps))
                fit = steps[-1].fit

    def _room(self, steps: Sequence[Added]) -> int:
        """How many mechanisms may still be added: a model that is far off lacks more than a few, and rows that count
        as few keep out what only imitates them."""
        return len(self.candidates) if self.target.known is not None else self.rules.effects - len(steps)

    def _extend(self, found: Screen, named: Sequence[str]) -> Added | None:
        """Refit the leading classes and add the best of them, if it is worth it."""
        significant = [row for row in found.rows if row.adjusted_p <= self.rules.family and row.probe is not None]
        if any(row.name == DISCRETISATION for row in significant) and self._below_the_noise(found.fit):
            significant = [row for row in significant if row.name != DISCRETISATION]
        refits: dict[str, float] = {}
        fits: dict[str, Fit] = {}
        leads = {row.name: self._lead(found.fit, row) for row in significant}
        # When the time is up, the refits that are done decide.
        with suppress(OutOfTime):
            leading = self._leading(significant, {name: drop for name, (drop, _) in leads.items()}, found.fit)
            if leading:
                count = len(leading) * climb_rollouts(self.target, len(found.fit.free) + 1)
                seconds = count * self.target.forward.pace
                self.report(f"refitting {len(leading)} leading candidates: up to {count} rollouts, {about(seconds)}")
            for row in leading:
                fits[row.name] = self._refit(found.fit, row, leads[row.name][1])
                refits[row.name] = fits[row.name].log_evidence - found.fit.log_evidence
                self.report(f"refit with {row.name}: log Bayes factor {refits[row.name]:.1f}")
            for name in sorted(refits, key=lambda name: -refits[name])[: self.rules.classes]:
                fits[name] = self._from_afar(name, fits[name])
                refits[name] = fits[name].log_evidence - found.fit.log_evidence
        further = np.log(len(self.candidates)) if named else 0.0
        worth = [name for name, gained in refits.items() if gained >= self.rules.evidence + further]
        if not worth:
            return None
        best = max(worth, key=lambda name: refits[name] - WIDER * len(fits[name].free))
        enough = self.rules.class_cosine**2 * leads[best][0]
        able = [row for row in significant if leads[row.name][0] > enough]
        # What looks the same near null may be another thing at the size that it has.
        able = [row for row in able if refits.get(row.name, np.inf) > refits[best] - TOLD_APART]
        members = self._class_of(found.row(best), able)
        # What brings nearly as much, whatever it looks like, is no less likely a cause.
        members += tuple(n for n in worth if n not in members and refits[n] > refits[best] - self.rules.evidence)
        judge = self.target.on(self.finer) if best == DISCRETISATION and self.finer else self.target
        return Added(best, members, found, fits[best], refits[best], refits, judge)

    def _pair(self, found: Screen, named: Sequence[str], single: Added | None) -> list[Added]:
        """Two mechanisms at once, where the best one leaves most of a large misfit; none where they do not pay.

        Of compliance and pretension of cables neither does much without the other. Pairs are ranked by what the linear
        model says of them, and the leading ones are refitted.
        """
        fit, last = found.fit, single.fit if single else found.fit
        taken = float(fit.residual @ fit.residual - last.residual @ last.residual)
        if not far_off(single.judge if single else self.target, last.x):
            return []
        rows = {row.name: row for row in found.rows if row.probe is not None and row.name != DISCRETISATION}
        heads = sorted(rows.values(), key=lambda row: -row.lm)[: self.rules.members]
        drops = {
            tuple(sorted((a.name, b.name))): joint_statistic(a.probe.mark, b.probe.mark, fit.residual)
            for a in heads
            for b in rows.values()
            if a.name != b.name and a.probe and b.probe
        }
        worth = self.rules.evidence + np.log(len(self.candidates))
        leading = sorted((p for p in drops if drops[p] > taken + 2.0 * worth), key=lambda p: -drops[p])[:PAIRS]
        fits = {}
        with suppress(OutOfTime):
            for names in leading:
                fits[names] = self._refit_pair(fit, [rows[name] for name in names])
                gained = fits[names].log_evidence - fit.log_evidence
                self.report(f"refit with {' and '.join(names)}: log Bayes factor {gained:.1f}")
        if not fits:
            return []
        best = max(fits, key=lambda names: fits[names].log_evidence - WIDER * len(fits[names].free))
        enough = self._surpasses(fits[best], single.fit, worth) if single else True
        if not enough or fits[best].log_evidence < fit.log_evidence + worth:
            return []
        alone = {name: self.refit(fit, rows[name]) for name in best}
        first, second = sorted(best, key=lambda name: -alone[name].log_evidence)
        between, _ = self.screened(alone[first], [*named, first])
        gains = [alone[first].log_evidence - fit.log_evidence, fits[best].log_evidence - alone[first].log_evidence]
        return [
            Added(first, (first,), found, alone[first], gains[0], single.refits if single else {}, self.target),
            Added(second, (second,), between, fits[best], gains[1], {}, self.target),
        ]

    def _refit_pair(self, fit: Fit, rows: Sequence[ScreenRow]) -> Fit:
        """The model of a fit with two candidates in it."""
        probes = [row.probe for row in rows if row.probe is not None]
        chosen = [c.indices for c in self.candidates if c.name in [row.name for row in rows]]
        held = [index for probe in probes for index in probe.point]
        start = best_between(self.target, fit.x, start_together(fit, probes), held, SHARES)
        return climb(self.target, start, np.array([*fit.free, *np.setdiff1d(np.concatenate(chosen), fit.free)]))

    def _climbed_again(self, step: Added) -> Fit | None:
        """The model before a step, climbed from where the step led: a candidate must not be named for having moved a
        climb on that had stopped early. None where that is no better."""
        before = step.before.fit
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
        starts = np.clip(np.stack([emptied, imitated]), *self.target.forward.coordinates.bounds)
        again = climb(self.target, starts[int(np.argmax(heights(self.target, starts, "without")))], before.free)
        return again if again.log_evidence > before.log_evidence + 1.0 else None

    def _lead(self, fit: Fit, row: ScreenRow) -> tuple[float, np.ndarray]:
        """See `lead`; a finer mesh has no parameter, and its effect only one size."""
        assert row.probe is not None
        if row.name == DISCRETISATION:
            return fixed_drop(fit, row.probe), fit.x
        return lead(self.target, fit, row.probe, row.lm)

    def _leading(self, significant: Sequence[ScreenRow], drops: Mapping[str, float], fit: Fit) -> list[ScreenRow]:
        """The best candidates of the leading classes, and further members of these while there is room; those that
        cannot bring what a mechanism must are left out."""
        able = [row for row in significant if drops[row.name] > 2.0 * self.rules.evidence]
        able.sort(key=lambda row: row.rank * np.log(fit.counted) - drops[row.name])
        heads: list[ScreenRow] = []
        rest: list[ScreenRow] = []
        for row in able:
            assert row.probe is not None
            alike = any(likeness(row.probe.mark, h.probe.mark) > self.rules.class_cosine for h in heads if h.probe)
            if not alike and len(heads) < self.rules.classes:
                heads.append(row)
            elif alike:
                rest.append(row)
        chosen = [*heads, *rest][: self.rules.members]
        # A refit on a finer mesh costs as much as all others: only where it could win.
        return [row for row in chosen if row.name != DISCRETISATION or drops[row.name] > 0.5 * drops[chosen[0].name]]

    def _class_of(self, best: ScreenRow, able: Sequence[ScreenRow]) -> tuple[str, ...]:
        """The best, and of those that explain as much of these data the ones that look the same."""
        assert best.probe is not None
        alike = [
            row.name
            for row in able
            if row.name != best.name
            and row.probe is not None
            and likeness(best.probe.mark, row.probe.mark) > self.rules.class_cosine
        ]
        return (best.name, *alike)

    def refit(self, fit: Fit, row: ScreenRow) -> Fit:
        """The model of a fit with a candidate in it."""
        return self._refit(fit, row, self._lead(fit, row)[1])

    def _refit(self, fit: Fit, row: ScreenRow, start: np.ndarray) -> Fit:
        if row.name == DISCRETISATION:
            assert self.finer is not None
            return climb(self.target.on(self.finer), start, fit.free)
        assert row.probe is not None
        candidate = next(c for c in self.candidates if c.name == row.name)
        free = np.array([*fit.free, *np.setdiff1d(candidate.indices, fit.free)], dtype=int)
        start = best_between(self.target, fit.x, start, list(row.probe.point), SHARES)
        if len(candidate.indices) == 1:
            found = self._climbed_from_all_sizes(candidate.indices[0], fit.x, start, free)
        else:
            found = climb(self.target, start, free)
        # The model without the candidate is among those with it: a climb that ends at a worse one went astray.
        if found.residual @ found.residual > fit.residual @ fit.residual:
            found = max(found, climb(self.target, fit.x, free), key=lambda end: end.log_evidence)
        return found

    def _climbed_from_all_sizes(
        self, index: int, base: Float[np.ndarray, " d"], start: Float[np.ndarray, " d"], free: Int[np.ndarray, " free"]
    ) -> Fit:
        """A fit with a candidate of one parameter, climbed from the best of its sizes until no other one is better.

        Of a shift in time the likelihood has a summit wherever jumps of commands meet the steps of the simulation or
        the rows of a recording; on one of them a climb from no shift ends.
        """
        found = climb(self.target, self._best_size(index, base, start), free)
        while True:
            better = self._best_size(index, found.x, found.x)
            again = found if np.array_equal(better, found.x) else climb(self.target, better, free)
            if again.log_evidence <= found.log_evidence:
                return found
            found = again

    def _best_size(
        self, index: int, base: Float[np.ndarray, " d"], start: Float[np.ndarray, " d"]
    ) -> Float[np.ndarray, " d"]:
        """The best of a start and of a base with a size from all over its prior."""
        coordinates = self.target.forward.coordinates
        points = np.repeat(base[None], 1 + len(SCANNED), axis=0)
        points[0] = start
        points[1:, index] = np.clip(coordinates.quantiles(index, SCANNED), *(end[index] for end in coordinates.bounds))
        return points[int(np.argmax(heights(self.target, points, "sizes")))]

    def _from_afar(self, name: str, fit: Fit) -> Fit:
        """A fit with one amplitude that leaves most of a large misfit, or a better one from the middle of the base
        parameters' priors: the base model's optimum, where it has made up for the effect, may be in another valley than
        that of both together."""
        candidate = next((c for c in self.candidates if c.name == name), None)
        if candidate is None or len(candidate.indices) != 1 or not far_off(self.target, fit.x):
            return fit
        coordinates = self.target.forward.coordinates
        far = coordinates.prior_mean.copy()
        far[coordinates.base :] = fit.x[coordinates.base :]
        best = climb(self.target, self._best_size(candidate.indices[0], far, far), fit.free)
        if best.log_evidence <= fit.log_evidence:
            return fit
        self.report(f"{name} from elsewhere: sum of squares {best.residual @ best.residual:.0f}")
        return best

    def _surpasses(self, new: Fit, old: Fit, worth: float) -> bool:
        """Whether a model may take the place of one that was chosen before: it must bring so many nats, and that also
        under priors of its further parameters that are twice as wide."""
        further = max(len(new.free) - len(old.free), 0)
        return new.log_evidence > old.log_evidence + worth + WIDER * further

    def without(self, steps: Sequence[Added], index: int, base: Fit) -> list[Added]:
        """Steps less one of them that has parameters, the later ones refitted without it."""
        candidate = next(c for c in self.candidates if c.name == steps[index].name)
        gone = np.setdiff1d(candidate.indices, steps[index - 1].fit.free if index else base.free)
        found, judges = list(steps[:index]), [step.judge for step in steps[: index + 1]]
        for step in steps[index + 1 :]:
            before, start = found[-1].fit if found else base, step.fit.x.copy()
            start[gone] = self.target.forward.coordinates.null[gone]
            fit = climb(step.judge, start, np.setdiff1d(step.fit.free, gone))
            under = climb(step.judge.on(judges[-1].forward), before.x, before.free)
            judges.append(step.judge)
            found.append(replace(step, fit=fit, log_bayes_factor=fit.log_evidence - under.log_evidence))
        return found

    def _without_needless(self, base: Fit, steps: list[Added]) -> list[Added]:
        """Steps less those that later ones have made needless: without its parameters the last model has as much
        evidence. Of a lag found first, and a delay and another lag found later, the first may come down to nothing."""
        last = steps[-1]
        for index in range(len(steps) - 1):
            if steps[index].name == DISCRETISATION:
                continue
            before = steps[index - 1].fit if index else base
            gone = np.setdiff1d(steps[index].fit.free, before.free)
            emptied = last.fit.x.copy()
            emptied[gone] = self.target.forward.coordinates.null[gone]
            if _nats_to(last.fit, emptied, gone) > TOLD_APART:
                continue
            if climb(last.judge, emptied, np.setdiff1d(last.fit.free, gone)).log_evidence >= last.fit.log_evidence:
                self.report(f"{steps[index].name} is no longer needed")
                return self._without_needless(base, self.without(steps, index, base))
        return steps

    def _reconsider(self, base: Fit, steps: list[Added]) -> list[Added]:
        """With the last mechanism in the model, was the first one named rightly? Take it out and ask again."""
        first, last = steps[0], steps[-1]
        if DISCRETISATION in (first.name, last.name) or len(steps) > 2:
            return steps
        candidate = next(c for c in self.candidates if c.name == last.name)
        indices = np.array([*base.free, *candidate.indices], dtype=int)
        # With the first one gone, its place in the fit may be far from the best: the base model's is another start.
        emptied, bare = last.fit.x.copy(), base.x.copy()
        others = np.setdiff1d(last.fit.free, indices)
        emptied[others] = self.target.forward.coordinates.null[others]
        bare[list(candidate.indices)] = last.fit.x[list(candidate.indices)]
        alone = max((climb(self.target, start, indices) for start in (emptied, bare)), key=lambda fit: fit.log_evidence)
        found, _ = self.screened(alone, [last.name])
        again = self._extend(found, [last.name])
        if again is None or again.name in (first.name, *first.members) or again.name == DISCRETISATION:
            return steps
        if not self._surpasses(again.fit, last.fit, self.rules.evidence):
            return steps
        self.report(f"with {last.name} in the model, {again.name} takes the place of {first.name}")
        plain = climb(self.target, base.x, base.free)
        gained = alone.log_evidence - plain.log_evidence
        renewed = replace(last, before=first.before, fit=alone, log_bayes_factor=gained)
        return [renewed, again]


def without_each_other(steps: Sequence[Added]) -> list[Added]:
    """Steps whose classes do not have mechanisms that are steps themselves: both are in the model, which tells them
    apart."""
    named = {step.name for step in steps}
    return [replace(s, members=tuple(n for n in s.members if n == s.name or n not in named)) for s in steps]


def numerical_shift(target: FitTarget, finer: Forward, fit: Fit) -> float | None:
    """Root mean square distance [m] by which a finer mesh and time step move the markers where they are measured; None
    where the finer rollouts do not end well."""
    seen, fine = finer.observe(fit.x[None])
    if not fine[0]:
        return None
    moved = target.forward.observe_one(fit.x)["position"] - seen["position"][0]
    measured = target.measurements.channels[0].valid
    return float(np.sqrt(3.0 * np.mean(moved.reshape(measured.shape)[measured] ** 2)))


def _without_numerical_error(fit: Fit, probe: Probe) -> Float[np.ndarray, " n"]:
    """Residuals of the simulation without its error in space and time, as two resolutions tell it.

    What halving the steps changes is a part of the error: half of it at the first order of the time steps, three
    quarters at the second order of the mesh. So the whole is once to twice the change; the data say how much.
    """
    base = span(fit.jacobian)
    change, left = project_out(base, probe.columns)[:, 0], project_out(base, fit.residual[:, None])[:, 0]
    share = np.clip(float(change @ left) / max(float(change @ change), 1e-300), 1.0, 2.0)
    return fit.residual - share * probe.columns[:, 0]


def _nats_to(fit: Fit, point: Float[np.ndarray, " d"], moved: Int[np.ndarray, " moved"]) -> float:
    """What a fit's normal approximation says that a model loses at best where some coordinates are held at a point."""
    place = [int(np.flatnonzero(fit.free == index)[0]) for index in moved]
    apart = fit.x[moved] - point[moved]
    return 0.5 * float(apart @ np.linalg.solve(fit.covariance[np.ix_(place, place)], apart))
