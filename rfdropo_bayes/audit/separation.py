"""Which of several mechanisms a data set tells apart.

All of them join the base model. Then the model is fitted without any, with each alone, and with all but each, under one
noise: what the model with all of them leaves, since what is left without them holds what they explain. A mechanism that
can go at no cost is not needed beside the others; of two whose effects on the data point the same way, either may.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.audit.candidates import Candidate, lead, probe_all
from rfdropo_bayes.audit.extension import SHARES, TOLD_APART
from rfdropo_bayes.audit.fit import Fit, FitTarget, best_between, climb
from rfdropo_bayes.audit.pipeline import residual_noise
from rfdropo_bayes.audit.score import Signature, likeness, project_out, signature, span, statistic
from rfdropo_bayes.bayes.noise.autoregression import RESIDUALS

PASSES = 2  # over the models without each, which begin where the one with all of them ends, and it where the best does
WITH_NONE = np.append(SHARES, 0.0)
SMALL = 0.1  # prior deviations at which a mechanism starts that shows nothing at null
GROWING, REFITTING, FINAL = 8, 3, 8  # evaluations of a climb while the model grows, of a variant, and of the whole


@dataclass(frozen=True)
class Variant:
    """The model with some of the mechanisms.

    Attributes:
        present: their names.
        fit: of the model with them.
        rmse: root mean square distance of the markers that it leaves [m].
    """

    present: tuple[str, ...]
    fit: Fit
    rmse: float


@dataclass(frozen=True)
class Separation:
    """What was found of mechanisms and of groups of them; a mechanism is a group of one.

    Attributes:
        target: data and noise of all fits.
        groups: members of each, by name: every mechanism, then the groups that were given.
        none, whole: the model without any, and with all.
        alone, without: with a group alone, and with all but it.
        marks: what each group does to the data at the whole model's optimum, less what the base model can imitate.
        own: share of that which the other groups' mechanisms cannot imitate either.
        rollouts: that it took.
    """

    target: FitTarget
    groups: Mapping[str, tuple[str, ...]]
    none: Variant
    whole: Variant
    alone: Mapping[str, Variant]
    without: Mapping[str, Variant]
    marks: Mapping[str, Signature]
    own: Mapping[str, float]
    rollouts: int

    def gain(self, group: str) -> float:
        """Log evidence that a group alone brings [nats]."""
        return self.alone[group].fit.log_evidence - self.none.fit.log_evidence

    def loss(self, group: str) -> float:
        """Log evidence that is lost without a group, though the others may make up for it [nats]."""
        return self.whole.fit.log_evidence - self.without[group].fit.log_evidence

    def cosine(self, first: str, second: str) -> float:
        """Smallest cosine of the principal angles between the effects of two groups."""
        return abs(likeness(self.marks[first], self.marks[second]))

    def needed(self, group: str) -> bool:
        """Whether the data have no use for the model without a group."""
        return self.loss(group) > TOLD_APART


def separate(
    target: FitTarget,
    candidates: Sequence[Candidate],
    groups: Mapping[str, Sequence[str]],
    start: Float[np.ndarray, " d"],
    report: Callable[[str], None] = lambda line: None,
) -> Separation:
    """Fit all the variants.

    Args:
        target: data, simulator and a noise; one that was not measured (source "residuals") is estimated here.
        candidates: the mechanisms, each at its null value in the simulator.
        groups: names of further groups, and of the mechanisms in them.
        start: coordinates that the model without mechanisms starts from.
        report: called with a line of words now and then.
    """
    coordinates = target.forward.coordinates
    members = {c.name: (c.name,) for c in candidates} | {name: tuple(group) for name, group in groups.items()}
    base = climb(target, start, np.arange(coordinates.base))
    report(f"without any: {_words(target, base)}")
    grown = base
    for candidate in candidates:
        grown = _joined(target, grown, candidate)
        report(f"with {candidate.name}: {_words(target, grown)}")
    if target.noise.source == RESIDUALS:
        target = replace(target, noise=residual_noise(target, grown))
        report(f"noise of what is left: AR({target.noise.first.order})")
    grown = climb(target, grown.x, grown.free, evaluations=FINAL)
    report(f"with all: {_words(target, grown)}")
    by_name = {c.name: c for c in candidates}
    indices = {c.name: c.indices for c in candidates}
    names = tuple(indices)

    def variant(present: tuple[str, ...], fit: Fit) -> Variant:
        report(f"{' + '.join(present) or 'none'}: log evidence {fit.log_evidence - grown.log_evidence:+.1f}")
        return Variant(present, fit, distance(target, fit))

    def reduced(present: tuple[str, ...], others: Sequence[Float[np.ndarray, " d"]]) -> Fit:
        free = np.array([*range(coordinates.base), *(i for name in present for i in indices[name])], dtype=int)
        starts = [_reduced(target, grown, free), *others]
        return max((climb(target, x, free, evaluations=REFITTING) for x in starts), key=lambda fit: fit.log_evidence)

    def joined(present: tuple[str, ...]) -> Fit:
        fit = none.fit
        for name in present:
            fit = _joined(target, fit, by_name[name])
        return fit

    none = variant((), reduced((), [base.x]))
    rest = {name: tuple(n for n in names if n not in group) for name, group in members.items()}
    without: dict[str, Variant] = {}
    for _ in range(PASSES):
        for name in sorted(rest, key=lambda name: len(rest[name])):  # what a smaller model has found, a larger one has
            inside = [found.fit.x for found in without.values() if set(found.present) < set(rest[name])]
            found = [*([without[name].fit] if name in without else []), reduced(rest[name], inside or [none.fit.x])]
            without[name] = variant(rest[name], max(found, key=lambda fit: fit.log_evidence))
        best = max(without.values(), key=lambda found: found.fit.log_evidence).fit
        further = climb(target, best.x, grown.free, evaluations=FINAL)
        if further.log_evidence <= grown.log_evidence:
            break
        grown = further  # the climb with all of them had stopped early, and those without each began where it ended
    alone = {name: variant(group, joined(group)) for name, group in members.items()}
    whole = variant(names, grown)
    marks, own = effects(grown, coordinates.base, {name: _places(grown, indices, members[name]) for name in members})
    return Separation(target, members, none, whole, alone, without, marks, own, target.forward.rollouts)


def distance(target: FitTarget, fit: Fit) -> float:
    """Root mean square distance of the markers from where the model has them [m]."""
    own = slice(0, target.measurements.markers)
    return float(np.sqrt(3.0 * np.mean(target.errors(fit.x)[..., own][target.measurements.valid[..., own]] ** 2)))


def effects(
    fit: Fit, base: int, columns: Mapping[str, Int[np.ndarray, " k"]]
) -> tuple[dict[str, Signature], dict[str, float]]:
    """Signatures of groups of a fit's columns, and the share of each that nothing else in the model can imitate.

    Args:
        fit: of the model with all of them.
        base: number of coordinates of the base model, which come first.
        columns: of the Jacobian, by group.
    """
    fitted = fit.jacobian
    ground = span(fitted[:, :base])
    marks, own = {}, {}
    for name, chosen in columns.items():
        marks[name] = signature(ground, fitted[:, chosen])
        rest = span(np.delete(fitted, chosen, axis=1))
        left, seen = project_out(rest, marks[name].basis), marks[name].rank
        own[name] = float(np.sqrt(np.sum(left**2) / seen)) if seen else 0.0
    return marks, own


def _places(fit: Fit, indices: Mapping[str, tuple[int, ...]], members: Sequence[str]) -> Int[np.ndarray, " k"]:
    """Columns of a fit's Jacobian that belong to mechanisms."""
    return np.flatnonzero(np.isin(fit.free, [i for name in members for i in indices[name]]))


def _joined(target: FitTarget, fit: Fit, candidate: Candidate) -> Fit:
    """The model of a fit with a mechanism in it."""
    seen = [probe for probe in probe_all(target, fit, [candidate]) if probe.mark.rank > 0]
    start = fit.x.copy()
    if seen:
        best = max(seen, key=lambda probe: float(statistic(probe.mark, fit.residual)[1]))
        start = lead(target, fit, best, float(statistic(best.mark, fit.residual)[0]))[1]
        held = list(best.point)
    else:
        held = []
    start = best_between(target, fit.x, start, held, WITH_NONE)
    for index in candidate.indices:  # a size of nothing has no slope for its shape
        null = target.forward.coordinates.null[index]
        if target.forward.coordinates.affine[index] and abs(start[index] - null) < SMALL:
            start[index] = null + SMALL
    free = np.array([*fit.free, *candidate.indices], dtype=int)
    found = climb(target, np.clip(start, *target.forward.coordinates.bounds), free, evaluations=GROWING)
    if found.residual @ found.residual > fit.residual @ fit.residual:  # it went astray
        return climb(target, fit.x, free, evaluations=GROWING)
    return found


def _reduced(target: FitTarget, fit: Fit, free: Int[np.ndarray, " free"]) -> Float[np.ndarray, " d"]:
    """Where a fit with fewer free coordinates starts: the others at null, and these where the linear model has them."""
    coordinates = target.forward.coordinates
    gone = np.setdiff1d(fit.free, free)
    emptied = fit.x.copy()
    emptied[gone] = coordinates.null[gone]
    place = {int(i): k for k, i in enumerate(fit.free)}
    kept, lost = [place[int(i)] for i in free], [place[int(i)] for i in gone]
    left = fit.residual - fit.jacobian[:, lost] @ (emptied - fit.x)[gone]
    prior = np.diag(1.0 / coordinates.prior_sd[free])
    pull = (coordinates.prior_mean[free] - emptied[free]) / coordinates.prior_sd[free]
    design = np.concatenate([fit.jacobian[:, kept], prior])
    moved = emptied.copy()
    moved[free] += np.linalg.lstsq(design, np.concatenate([left, pull]), rcond=None)[0]
    return best_between(target, emptied, moved, [], WITH_NONE)


def _words(target: FitTarget, fit: Fit) -> str:
    return f"{1e3 * distance(target, fit):.2f} mm"
