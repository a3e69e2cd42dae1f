"""One step of naming causes: a model is tested, the leading classes are refitted, and the best may join it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.discrepancy.candidates import Candidate, Probe, lead, probe_all, score_test_rollouts
from rfdropo_bayes.discrepancy.deadline import about
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, best_between, heights, optimisation_rollouts, optimise
from rfdropo_bayes.discrepancy.forward import Forward
from rfdropo_bayes.discrepancy.gain import noise_distance
from rfdropo_bayes.discrepancy.inadequacy import as_measured, misspecified
from rfdropo_bayes.discrepancy.omnibus import Omnibus
from rfdropo_bayes.discrepancy.score import likeness, project_out, signature, span
from rfdropo_bayes.discrepancy.score_tests import ScoreRow, ScoreTests, run_score_tests
from rfdropo_bayes.discrepancy.unknown_size import scale_gain

DISCRETISATION = "discretisation"
SHARES = np.array([1.0, 0.5, 0.2, 0.05])
SCANNED = tuple((k + 0.5) / 32 for k in range(32))
"""Quantiles of the prior of a candidate's size that are tried as starts of an optimisation. The optimum of a delay of
70 ms under a noise of 0.3 mm is 8 ms wide; 32 quantiles are 5 ms apart there, 16 would be 9 ms.
"""
TOLD_APART = 10.0  # nats: a refitted candidate that is worse by this difference is excluded from the class of the best


@dataclass(frozen=True)
class Rules:
    """Numbers the verdict depends on, fixed in advance.

    Attributes:
        level: probability of a false alarm if the model is right: by the joint test, or by score tests that name a
            candidate.
        class_cosine: cosine above which signatures are one class.
        classes: number of leading classes to refit; members: total number of candidates to refit.
        effects: number of mechanisms beyond which a further mechanism must take a significant share of the misfit away,
            unless the model is misspecified.
        evidence: log Bayes factor required to add a mechanism. Later mechanisms need the logarithm of the number of
            candidates in addition, since a few of many candidates together imitate most effects. Candidates within this
            difference of the best are equivalent.
        bootstraps: number of simulated data sets per p-value.
        minutes: limit of the whole audit; it then finishes with its present results.
        extended_passes: p-value of the joint test above which an extended model passes.
        explained, significant: shares of the discrepancy for "explained" and for "partly explained".
        matters: distance of a marker [m] below which a discrepancy does not matter; None if not stated.
    """

    level: float = 0.02
    class_cosine: float = 0.95
    classes: int = 4
    members: int = 8
    effects: int = 3
    evidence: float = 3.0
    bootstraps: int = 999
    minutes: float = 30.0
    extended_passes: float = 0.05
    explained: float = 0.8
    significant: float = 0.2
    matters: float | None = None


@dataclass(frozen=True)
class Added:
    """One mechanism added to the model.

    Attributes:
        name: name of the mechanism.
        members: its equivalence class, itself first: candidates with the same signature and explained share, and
            refitted candidates within `Rules.evidence`.
        before: score tests of the model without it.
        fit: fit of the model with it.
        log_bayes_factor: log Bayes factor of the models with and without it, see `ExtensionSearch.gain`.
        refits: log Bayes factors of all refitted candidates of this step.
        fit_target: the target under which the fit was found, see `inadequacy`. It has the finer simulator from the step
            `DISCRETISATION` on.
    """

    name: str
    members: tuple[str, ...]
    before: ScoreTests
    fit: Fit
    log_bayes_factor: float
    refits: dict[str, float]
    fit_target: FitTarget


@dataclass(frozen=True)
class Refits:
    """The candidates refitted beside a model so far.

    Attributes:
        rows: significant rows of the score tests.
        drops: possible drop of the sum of squares for each of them.
        fits: fit of the model with each refitted candidate.
        waiting: leading candidates without a refit.
    """

    rows: tuple[ScoreRow, ...]
    drops: Mapping[str, float]
    fits: Mapping[str, Fit]
    waiting: tuple[str, ...]

    def with_fit(self, name: str, fit: Fit) -> Refits:
        """The trials with one more fit, or with a better fit of a candidate."""
        waiting = tuple(each for each in self.waiting if each != name)
        return replace(self, fits={**self.fits, name: fit}, waiting=waiting)


@dataclass(frozen=True)
class ExtensionSearch:
    """The search for candidates that a model lacks.

    Attributes:
        target: data, noise and simulator; every candidate is in the simulator, at its null value. Noise and simulator
            are the present model's, see `inadequacy`.
        candidates: mechanisms that may be named.
        rules: see `Rules`.
        seed: seed of all bootstraps.
        finer: the simulator on a finer mesh and time step, for the candidate `DISCRETISATION`; None without it.
        report: called with a line of words as the search goes on.
    """

    target: FitTarget
    candidates: Sequence[Candidate]
    rules: Rules
    seed: int
    finer: Forward | None = None
    report: Callable[[str], None] = lambda line: None

    def under(self, target: FitTarget) -> ExtensionSearch:
        """The same search with another noise or simulator."""
        return self if target is self.target else replace(self, target=target)

    def candidate(self, name: str) -> Candidate | None:
        """A candidate by its name; None for `DISCRETISATION`."""
        return next((each for each in self.candidates if each.name == name), None)

    def worthwhile(self, before: Fit, after: Fit, steps: int) -> bool:
        """Whether the last of so many mechanisms may join. Many candidates together imitate most effects: beyond a few,
        each must take a significant share of the misfit away. A misspecified model may lack many, and down-weighted
        rows keep out imitations.
        """
        if steps <= self.rules.effects or self.target.known is not None:
            return True
        left, taken = (float(fit.residual @ fit.residual) for fit in (before, after))
        misfit = max(left - float(np.count_nonzero(before.residual)), 0.0)
        return left - taken > self.rules.significant * misfit > 0.0

    def score_tests(self, fit: Fit, without: Sequence[str] = ()) -> ScoreTests:
        """Test a fit and its missing candidates.

        An error of mesh or time step that the score test does not see is not counted as a discrepancy: the residuals of
        the finer simulator are used if they pass more easily. See also `corrected`.
        """
        # Some members of a family of parameters may be in the model already.
        missing = [replace(c, indices=tuple(i for i in c.indices if i not in fit.free)) for c in self.candidates]
        free = [
            c
            for c, whole in zip(missing, self.candidates, strict=True)
            if c.name not in without and (c.indices or not whole.indices)
        ]
        names = [c.name for c in free]
        finer = None
        clock, forward = self.target.forward.deadline, self.target.forward
        count = score_test_rollouts(self.target, free)
        apart = 0.0 if without else forward.compiling * forward.lanes.later
        self.report(f"score tests of {len(free)} candidates: {count} rollouts, {about(count * forward.pace + apart)}")
        with clock.stage("screening"):
            probes = probe_all(self.target, fit, free)
        if self.finer is not None and DISCRETISATION not in without:
            refined = replace(self.target, forward=self.finer)
            with clock.stage("finer mesh"):
                finer = refined.recall("finer", [fit.x], lambda: {"left": refined.residual(fit.x[None])[0]})["left"]
            change = (fit.residual - finer)[:, None]
            probes.append(Probe(DISCRETISATION, {}, change, (), signature(span(fit.jacobian), change, 1)))
            names.append(DISCRETISATION)
        with clock.stage("joint test"):
            tests = run_score_tests(
                self.target, fit, probes, names, [self.seed, len(without)], self.rules.bootstraps, finer
            )
            if self.target.known is not None:  # the joint test uses the noise of the measurement
                return replace(tests, omnibus=self._tested(fit, len(without)), finer=None)
            if tests.finer is None:
                return tests
            if tests.row(DISCRETISATION).adjusted_p > self.rules.level:
                tests = replace(tests, omnibus=max(tests.omnibus, tests.finer, key=lambda test: test.p))
            return tests

    def corrected(self, tests: ScoreTests) -> Forward | None:
        """The simulator with its error in space and time corrected; None unless the score tests of a model show this
        error, and it moves the markers by less than the noise of one measurement.

        Many rows and repeats make any error significant, no data set with such a noise is worth a finer mesh, and
        candidates would imitate the error. It is estimated from two resolutions. The change by halving the steps is a
        part of it: half at first order of the time steps, three quarters at second order of the mesh. The error is
        therefore one to two times the change, as the data have it.
        """
        target, fit = self.target, tests.fit
        if self.finer is None or tests.finer is None or target.known is not None or target.forward.correction:
            return None
        row = tests.row(DISCRETISATION)
        if row.adjusted_p > self.rules.level or row.probe is None or not self._below_the_noise(fit):
            return None
        base = span(fit.jacobian)
        moved, left = (project_out(base, each)[:, 0] for each in (row.probe.columns, fit.residual[:, None]))
        times = np.clip(float(moved @ left) / max(float(moved @ moved), 1e-300), 1.0, 2.0)
        return target.forward.extrapolated(self.finer, fit.x, float(times))

    def _below_the_noise(self, fit: Fit) -> bool:
        """Whether a finer mesh and time step move the markers by no more than the noise of one measurement."""
        shift = None if self.finer is None else numerical_shift(self.target, self.finer, fit)
        return shift is not None and shift <= noise_distance(self.target.measured.noise.first)

    def tested(self, fit: Fit, number: int) -> ScoreTests:
        """The joint test of a model, without tests of candidates."""
        tests = run_score_tests(self.target, fit, [], [], [self.seed, number], self.rules.bootstraps)
        return replace(tests, omnibus=self._tested(fit, number))

    def _tested(self, fit: Fit, number: int) -> Omnibus:
        """The joint test of a fit under the noise of the measurement."""
        known = self.target.measured
        measured = as_measured(self.target, fit)
        return run_score_tests(known, measured, [], [], [self.seed, number], self.rules.bootstraps).omnibus

    def refits(self, tests: ScoreTests) -> Iterator[Refits]:
        """The leading classes, one candidate refitted after the other; then the best of them from afar, see
        `_from_distant_starts`."""
        significant = [row for row in tests.rows if row.adjusted_p <= self.rules.level and row.probe is not None]
        if any(row.name == DISCRETISATION for row in significant) and self._below_the_noise(tests.fit):
            significant = [row for row in significant if row.name != DISCRETISATION]
        leads = {row.name: self._lead(tests.fit, row) for row in significant}
        drops = {name: drop for name, (drop, _) in leads.items()}
        leading = self._leading(significant, drops)
        if leading:
            count = len(leading) * optimisation_rollouts(self.target, len(tests.fit.free) + 1)
            seconds = count * self.target.forward.pace
            self.report(f"refitting {len(leading)} leading candidates: up to {count} rollouts, {about(seconds)}")
        tried = Refits(tuple(significant), drops, {}, tuple(row.name for row in leading))
        yield tried
        for row in leading:
            tried = tried.with_fit(row.name, self._refit(tests.fit, row, leads[row.name][1]))
            self.report(f"refit with {row.name}: log Bayes factor {self.gain(tests.fit, tried.fits[row.name]):.1f}")
            yield tried
        gains = self.gains(tests.fit, tried)
        for name in sorted(gains, key=lambda name: -gains[name])[: self.rules.classes]:
            tried = tried.with_fit(name, self._from_distant_starts(name, tried.fits[name]))
            yield tried

    def best(self, tests: ScoreTests, tried: Refits, further: bool) -> Added | None:
        """The best of the refitted candidates with its class; None if no candidate is worth it.

        Args:
            tests: score tests of the model without it.
            tried: the refits so far.
            further: whether the model has mechanisms already, so that another needs more evidence.
        """
        gains = self.gains(tests.fit, tried)
        price = np.log(len(self.candidates)) if further else 0.0
        worth = [name for name, gained in gains.items() if gained >= self.rules.evidence + price]
        if not worth:
            return None
        best = max(worth, key=lambda name: gains[name])
        enough = self.rules.class_cosine**2 * tried.drops[best]
        able = [row for row in tried.rows if tried.drops[row.name] > enough]
        # Candidates with equal signatures near null may differ at their fitted size.
        able = [row for row in able if gains.get(row.name, np.inf) > gains[best] - TOLD_APART]
        mark = next(row.probe.mark for row in tried.rows if row.name == best and row.probe)
        members = [best]
        for row in able:
            if row.name != best and row.probe and likeness(mark, row.probe.mark) > self.rules.class_cosine:
                members.append(row.name)
        # A candidate of nearly equal gain is as likely a cause, for any signature.
        members += [n for n in worth if n not in members and gains[n] > gains[best] - self.rules.evidence]
        fit_target = self.target.on(self.finer) if best == DISCRETISATION and self.finer else self.target
        return Added(best, tuple(members), tests, tried.fits[best], gains[best], gains, fit_target)

    def _lead(self, fit: Fit, row: ScoreRow) -> tuple[float, np.ndarray]:
        """See `lead`; a finer mesh has no parameter, and its effect only one size."""
        assert row.probe is not None
        if row.name == DISCRETISATION:
            base, residual = span(fit.jacobian), fit.residual[:, None]
            now, then = (np.sum(project_out(base, each) ** 2) for each in (residual, residual - row.probe.columns))
            return float(now - then), fit.x
        return lead(self.target, fit, row.probe, row.lm)

    def _leading(self, significant: Sequence[ScoreRow], drops: Mapping[str, float]) -> list[ScoreRow]:
        """The best candidates of the leading classes, and further members of these while there is room; candidates that
        cannot reach the required evidence are skipped, and candidates with slow rollouts come last.
        """
        able = [row for row in significant if drops[row.name] > 2.0 * self.rules.evidence]
        # A finer mesh has no size that could be unknown.
        score = {row.name: 0.0 if row.name == DISCRETISATION else row.score - 0.5 * row.lm for row in able}
        able.sort(key=lambda row: -score[row.name] - 0.5 * drops[row.name])
        heads: list[ScoreRow] = []
        rest: list[ScoreRow] = []
        for row in able:
            assert row.probe is not None
            alike = any(likeness(row.probe.mark, h.probe.mark) > self.rules.class_cosine for h in heads if h.probe)
            if not alike and len(heads) < self.rules.classes:
                heads.append(row)
            elif alike:
                rest.append(row)
        chosen = [*heads, *rest][: self.rules.members]
        # A refit on a finer mesh costs as much as all others: only if it could win.
        chosen = [row for row in chosen if row.name != DISCRETISATION or drops[row.name] > 0.5 * drops[chosen[0].name]]
        costly, parameters = self.target.forward.lanes.costly, self.target.forward.coordinates.space.parameters

        def slow(row: ScoreRow) -> bool:
            candidate = self.candidate(row.name)
            return candidate is None or any(parameters[index].physical in costly for index in candidate.indices)

        return sorted(chosen, key=slow)

    def refit(self, fit: Fit, row: ScoreRow) -> Fit:
        """The model of a fit with a candidate in it."""
        return self._refit(fit, row, self._lead(fit, row)[1])

    def _refit(self, fit: Fit, row: ScoreRow, start: np.ndarray) -> Fit:
        if row.name == DISCRETISATION:
            assert self.finer is not None
            return optimise(self.target.on(self.finer), start, fit.free)
        candidate = self.candidate(row.name)
        assert row.probe is not None
        assert candidate is not None
        free = np.array([*fit.free, *np.setdiff1d(candidate.indices, fit.free)], dtype=int)
        start = best_between(self.target, fit.x, start, list(row.probe.point), SHARES)
        if len(candidate.indices) == 1:
            # From the best size of the prior, until no other size is better. The likelihood of a time shift has an
            # optimum wherever jumps of commands meet the steps of the simulation or the rows of a recording; an
            # optimisation from zero shift stops at one of them.
            index = candidate.indices[0]
            refitted = optimise(self.target, self._best_size(index, fit.x, start), free)
            while True:
                better = self._best_size(index, refitted.x, refitted.x)
                if np.array_equal(better, refitted.x):
                    break
                again = optimise(self.target, better, free)
                if again.log_evidence <= refitted.log_evidence:
                    break
                refitted = again
        else:
            refitted = optimise(self.target, start, free)
        # The model without the candidate is a special case: a worse result is a failed optimisation.
        if refitted.residual @ refitted.residual > fit.residual @ fit.residual:
            refitted = max(refitted, optimise(self.target, fit.x, free), key=lambda end: end.log_evidence)
        return refitted

    def _best_size(
        self, index: int, base: Float[np.ndarray, " d"], start: Float[np.ndarray, " d"]
    ) -> Float[np.ndarray, " d"]:
        """The best of a start and of a base with a size from all over its prior."""
        coordinates = self.target.forward.coordinates
        points = np.repeat(base[None], 1 + len(SCANNED), axis=0)
        points[0] = start
        points[1:, index] = np.clip(coordinates.quantiles(index, SCANNED), *(end[index] for end in coordinates.bounds))
        return points[int(np.argmax(heights(self.target, points, "sizes")))]

    def _from_distant_starts(self, name: str, fit: Fit) -> Fit:
        """A fit with one amplitude that leaves most of a large misfit, or a better fit from the centre of the base
        parameters' priors. The base model's optimum, which compensates for the effect, may be in another basin than the
        joint optimum.
        """
        candidate = self.candidate(name)
        if candidate is None or len(candidate.indices) != 1 or not misspecified(self.target, fit.x):
            return fit
        coordinates = self.target.forward.coordinates
        far = coordinates.prior_mean.copy()
        far[coordinates.base :] = fit.x[coordinates.base :]
        best = optimise(self.target, self._best_size(candidate.indices[0], far, far), fit.free)
        if best.log_evidence <= fit.log_evidence:
            return fit
        self.report(f"{name} from elsewhere: sum of squares {best.residual @ best.residual:.0f}")
        return best

    def gain(self, before: Fit, after: Fit) -> float:
        """Log Bayes factor of a model against the same model with fewer mechanisms; the added sizes have an unknown
        scale (`unknown_size`). Other added parameters have their priors.
        """
        return after.log_evidence - before.log_evidence + scale_gain(*self._sizes(after, before.free))

    def at_stake(self, fit: Fit, kept: Int[np.ndarray, " kept"]) -> float:
        """About `gain` over the same model with only some parameters, without a refit (Savage and Dickey's ratio)."""
        mode, covariance = self._sizes(fit, kept)
        if len(mode) == 0:
            return 0.0
        known = 0.5 * float(mode @ np.linalg.solve(covariance, mode) + np.linalg.slogdet(covariance)[1])
        return known + scale_gain(mode, covariance)

    def _sizes(self, fit: Fit, known: Int[np.ndarray, " known"]) -> tuple[np.ndarray, np.ndarray]:
        """Sizes of a fit beside known parameters, and their covariance."""
        sizes = self.target.forward.coordinates.sizes[fit.free] & ~np.isin(fit.free, known)
        return fit.x[fit.free[sizes]], fit.covariance[np.ix_(sizes, sizes)]

    def gains(self, before: Fit, tried: Refits) -> dict[str, float]:
        """Log Bayes factor of each refitted candidate against the model before."""
        return {name: self.gain(before, fit) for name, fit in tried.fits.items()}


def numerical_shift(target: FitTarget, finer: Forward, fit: Fit) -> float | None:
    """Root mean square distance [m] by which a finer mesh and time step move the measured markers, which no correction
    changes; None after a failed finer rollout.
    """
    seen, fine = finer.observe(fit.x[None])
    if not fine[0]:
        return None
    moved = target.forward.uncorrected.observe_one(fit.x)["position"] - seen["position"][0]
    measured = target.measurements.channels[0].valid
    return float(np.sqrt(3.0 * np.mean(moved.reshape(measured.shape)[measured] ** 2)))
