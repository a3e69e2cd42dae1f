"""Law of an effect at a port: terms are chosen by cross-validation between recordings, and refitted.

Terms are added one by one. Every feature at every port is fitted linearly, together with the base parameters, to all
recordings but one, and predicts the omitted recording. The best features are refitted without linearisation. The next
term is then searched in the residuals. Choosing several terms before the first refit admits false terms.

Ports and terms use the same noise model as candidates of the library: for a misspecified model, noise of the size of
its residuals (see `inadequacy`), updated after each term.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.discrepancy.deadline import OutOfTime
from rfdropo_bayes.discrepancy.differences import Groups
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget, optimise
from rfdropo_bayes.discrepancy.inadequacy import fit_with_noise
from rfdropo_bayes.discrepancy.port_evidence import PortEvidence, evidences
from rfdropo_bayes.discrepancy.port_responses import Responses, feature_columns, responses, under, with_exact_columns
from rfdropo_bayes.discrepancy.port_rollouts import (
    EVERYWHERE,
    PREFIX,
    FeatureTable,
    PlacedTerm,
    PortedForward,
    Scope,
    coefficient_name,
    placed,
)
from rfdropo_bayes.discrepancy.score_tests import null_residuals
from rfdropo_bayes.mechanisms.features import Feature, dictionary, own_dictionary
from rfdropo_bayes.mechanisms.ports import Port, PortMap

LEAST = 0.01
"""Share of the residuals beyond the noise that a term must explain in left-out recordings."""
BY_EVIDENCE, BY_GAIN = 3, 2  # ports and terms that are refitted
EXCHANGES = 2  # rounds in which another term may replace the chosen term
FRESH = 3  # terms that are refitted in each round
GLANCE = 4  # steps of a refit that only ranks
TIED = 10.0  # nats by which a refit must be worse to be distinguished from the best
PIECES = 3  # parts of a single recording, which are left out in turn
NULLS = 199  # simulated data sets behind the p-values of ports
COLLINEAR = 1e-6  # share of a column that the base parameters must leave


@dataclass(frozen=True)
class TermGain:
    """One feature at one port, fitted linearly together with the base parameters.

    Attributes:
        port, feature, scope: port and feature, and the recordings of the term.
        gain: gain of the log density of left-out recordings [nat].
        share: explained share of their residuals beyond the noise.
        size: value of the coefficient; sd: its deviation.
        typical: root mean square of the feature.
    """

    port: Port
    feature: Feature
    gain: float
    share: float
    size: float
    sd: float
    typical: float
    scope: Scope = EVERYWHERE

    @property
    def place(self) -> tuple[Port, Feature, str]:
        """See `PlacedTerm.place`."""
        return self.port, self.feature, self.scope.group


@dataclass(frozen=True)
class Refit:
    """A model with one more term, refitted.

    Attributes:
        term: the last term.
        target, fit: target and fit of the model.
        gain: see `TermGain`.
        score: gain of the term [nat], less the cost of a parameter and of the choice among many. It decides on the
            term. The coefficient over its deviation does not: cables leave the common scale of stiffness and forces
            free, so that every force is as uncertain as Young's modulus.
    """

    term: PlacedTerm
    target: FitTarget
    fit: Fit
    gain: TermGain
    score: float

    @property
    def shape(self) -> float | None:
        """Shape of the term's feature; None if it is not inferred."""
        if self.term.shape is None:
            return None
        coordinates = self.target.forward.coordinates
        return float(coordinates.values(self.fit.x[None])[0, coordinates.names.index(self.term.shape.name)])

    @property
    def feature(self) -> Feature:
        """The term's feature, in the shape that it has in the fit."""
        return self.term.feature if self.shape is None else self.term.feature.in_shape(self.shape)

    @property
    def square(self) -> float:
        """Sum of squares that the model leaves, in deviations of the noise that it was fitted under."""
        return float(self.fit.residual @ self.fit.residual)


@dataclass(frozen=True)
class LawResult:
    """Result of the search for laws around one model.

    Attributes:
        map: all ports.
        ports: evidence of every port before the first term.
        terms: one refit per added term, cumulative; empty without a law.
        ties: refits of alternatives to the first term with equal residuals, within `TIED`; the best first.
        afterwards: largest log evidence of any port after each term.
        centre: times of the ports' signals [s] from the recordings' first rows on; for recordings with different
            lead-in times, from their median.
        null_quantile: null quantile of the first term's gain on left-out recordings [nat]; None if no port is
        significant.
    """

    map: PortMap
    ports: list[PortEvidence]
    terms: list[Refit]
    ties: list[Refit]
    afterwards: list[PortEvidence]
    centre: Float[np.ndarray, " spline"]
    null_quantile: float | None

    @property
    def last(self) -> Refit | None:
        """The model with all terms."""
        return self.terms[-1] if self.terms else None

    @property
    def after(self) -> PortEvidence | None:
        """Largest log evidence of any port once the law is in the model; None without a law."""
        return self.afterwards[-1] if self.terms else None

    def cut(self, terms: int) -> LawResult:
        """The law of the first ``terms`` terms."""
        return replace(self, terms=self.terms[:terms], afterwards=self.afterwards[:terms])

    @property
    def alternatives(self) -> list[Refit]:
        """The first term and its ties; empty without a law."""
        return [*self.terms[:1], *self.ties]

    def significant(self, level: float) -> list[PortEvidence]:
        """Ports with a significant effect."""
        return [row for row in self.ports if row.adjusted_p <= level and row.log_evidence > 0.0]


@dataclass(frozen=True)
class _Sums:
    """Inner products of slopes, features and residuals of one or more data sets, one for each piece of the data; the
    priors' pull is of the first data set.
    """

    jj: Float[np.ndarray, "piece d d"]
    jx: Float[np.ndarray, "piece d feature"]
    xx: Float[np.ndarray, "piece feature"]
    jy: Float[np.ndarray, "piece d data"]
    xy: Float[np.ndarray, "piece feature data"]
    yy: Float[np.ndarray, "piece data"]
    count: Float[np.ndarray, " piece"]
    pull: Float[np.ndarray, " d"]


def _pieces(array: Float[np.ndarray, "group value *rest"]) -> Float[np.ndarray, "piece value *rest"]:
    """Recordings, or parts of a single one."""
    if len(array) > 1:
        return array
    length = array.shape[1] // PIECES
    return array[0, : PIECES * length].reshape(PIECES, length, *array.shape[2:])


def _sums(
    linear: Responses,
    columns: Float[np.ndarray, "group value feature"],
    null: Float[np.ndarray, "group value draw"] | None = None,
) -> _Sums:
    """Sums of the residual, followed by simulated residuals."""
    j, x, y = _pieces(linear.jacobian), _pieces(columns), _pieces(linear.residual)[..., None]
    count = linear.noise * np.count_nonzero(y[..., 0], axis=1)
    if null is not None:
        y = np.concatenate([y, _pieces(null)], axis=-1)
    return _Sums(
        np.swapaxes(j, 1, 2) @ j,
        np.swapaxes(j, 1, 2) @ x,
        np.einsum("pvf,pvf->pf", x, x),
        np.swapaxes(j, 1, 2) @ y,
        np.swapaxes(x, 1, 2) @ y,
        np.sum(y**2, axis=1),
        count,
        np.zeros(j.shape[2]) if linear.pull is None else linear.pull,
    )


def cross_validated_gains(
    sums: _Sums, precision: Float[np.ndarray, "d d"] | None = None
) -> tuple[Float[np.ndarray, "feature data"], np.ndarray, np.ndarray, np.ndarray]:
    """Gain [nat] of every feature in every data set, each alone beside the base parameters; of the first data set also
    share, size and deviation.

    A piece left out is predicted with uncertain base parameters: r ~ N(0, S), S = 1 + J A^-1 J' with A the precision
    from the other pieces. A gain is half the decrease of r' S^-1 r. The decrease of r'r would mostly be the error of
    base parameters that only this piece determines, which no refit brings.

    The prior of the base parameters fixes undetermined directions. Its ``precision`` is 1 in these columns by default,
    and it pulls parameters towards its centre.
    """
    before, gain = 0.0, np.zeros(sums.xy.shape[1:])
    prior = np.eye(sums.jj.shape[1]) if precision is None else precision
    whole = [part.sum(axis=0) for part in (sums.jj, sums.jx, sums.xx, sums.jy, sums.xy)]
    if precision is None:
        whole[3][:, 0] -= sums.pull
    inverse = np.linalg.inv(whole[0] + prior)
    for p in range(len(sums.yy)):
        own = (sums.jj[p], sums.jx[p], sums.xx[p], sums.jy[p], sums.xy[p])
        others = [every - part for every, part in zip(whole, own, strict=True)]
        b, u, c, _ = _solved(others, prior)
        left_j, left_jx = sums.jy[p] - sums.jj[p] @ b, sums.jx[p] - sums.jj[p] @ u
        along = sums.xy[p] - sums.jx[p].T @ b - u.T @ left_j - left_jx.T @ inverse @ left_j
        square = sums.xx[p] - np.sum(u * (sums.jx[p] + left_jx), axis=0) - np.sum(left_jx * (inverse @ left_jx), axis=0)
        gain += 2.0 * c * along - c**2 * square[:, None]
        first, own_j = left_j[:, 0], sums.jy[p, :, 0]
        before += sums.yy[p, 0] - float(b[:, 0] @ (own_j + first)) - float(first @ inverse @ first) - sums.count[p]
    _, _, size, sd = _solved(whole, prior)
    return 0.5 * gain, gain[:, 0] / max(before, 1e-300), size[:, 0], sd


def _solved(sums: Sequence[np.ndarray], precision: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Base parameters alone, their projection of every feature, and each feature's coefficients and deviation."""
    jj, jx, xx, jy, xy = sums
    prior = jj + precision
    b, u = np.linalg.solve(prior, jy), np.linalg.solve(prior, jx)
    remaining = xx - np.sum(u * jx, axis=0)
    seen = remaining > COLLINEAR * np.maximum(xx, 1e-300)
    safe = np.where(seen, remaining, 1.0)
    c = np.where(seen[:, None], (xy - u.T @ jy) / safe[:, None], 0.0)
    return b, u, c, np.where(seen, 1.0 / np.sqrt(safe), np.inf)


class LinearModel(NamedTuple):
    """A model, linear around its fit, beside which further terms are ranked.

    Attributes:
        known: target of the simulator without a law.
        terms: terms of the model's law.
        fit: the model.
        responses: responses, with the residual and the slopes of the fit.
        precision: precision of the base parameters, see `cross_validated_gains`.
    """

    known: FitTarget
    terms: Sequence[Refit]
    fit: Fit
    responses: Responses
    precision: Float[np.ndarray, "d d"] | None = None


@dataclass
class LawSearch:
    """The search for a law beside a fitted model.

    Attributes:
        ports: ports of the simulator.
        table: features of commands, and of motion for ports of the body.
        own: features of a cable's own command, for ports of several cables.
        units: names and unit of the commands.
        seed: seed of simulated data sets.
        level: probability that a port is named although nothing is missing.
        report: called with a line of words.
        most: largest number of terms; None leaves it to the recordings.
        taken: names of coefficients in the model, from laws of an earlier audit.
        scopes: recordings in which a law may act: all, and each group's.
        timed: whether rows have times; without them there are no features in time.
    """

    ports: PortMap
    table: FeatureTable
    own: Sequence[Feature]
    units: tuple[tuple[str, ...], str]
    seed: int
    level: float
    report: Callable[[str], None] = lambda line: None
    most: int | None = None
    taken: frozenset[str] = frozenset()
    scopes: tuple[Scope, ...] = (EVERYWHERE,)
    timed: bool = True

    def find(self, target: FitTarget, fit: Fit, forced: bool = False) -> LawResult:
        """Port and law of an effect that the model lacks: the last of `laws`."""
        *_, law = self.laws(target, fit, forced)
        return law

    def laws(self, target: FitTarget, fit: Fit, forced: bool = False) -> Iterator[LawResult]:
        """Ports of an effect that the model lacks, then its law after each term. The last law stands if the time is up.

        Args:
            target: target of the model's fit.
            fit: fit of the model.
            forced: whether to search a first term although no port is significant.
        """
        known = target
        linear = responses(known, fit, self.ports, self.table, self.report)
        values = self.table.over(linear.levels)  # of all features of the commands, then of the motion
        if linear.of_motion is not None:
            values = np.concatenate([values, linear.of_motion], axis=1)
        null = self._null(known, fit, linear)
        where = evidences(linear, null)
        centre = linear.basis.centre - linear.begun
        law = LawResult(self.ports, where, [], [], [], centre, None)
        yield law
        try:
            while len(law.terms) != self.most and (where[0].adjusted_p <= self.level or (forced and not law.terms)):
                terms = law.terms
                if not terms:
                    linear = self._sharpened(known, fit, linear, values, where)
                null_quantile = self._null_quantile(linear, values, null)
                law = law if terms else replace(law, null_quantile=null_quantile)
                ranked = self._ranked(linear, values, null_quantile, terms=terms)
                model = LinearModel(known, terms, fit, linear)
                chosen = self._confirmed(model, ranked, null_quantile, partial(leading_terms, where=where))
                refits = self._refits(known, terms, fit, chosen)
                if not refits or refits[0].score <= 0.0:
                    break
                best, others = self._exchanged(known, terms, linear, values, refits, null_quantile, where)
                if best.score <= 0.0:
                    break
                ties = law.ties if terms else _tied(best, others)
                best = self._shaped(known, terms, best)
                fit_target, fit = best.target, best.fit
                if fit_target.known is not None:  # misspecified so far: under noise of the present residuals
                    fit_target, fit = fit_with_noise(fit_target.known, fit.x, fit.free)
                anew = fit_target is not best.target
                best = replace(best, target=fit_target, fit=fit)
                linear, known = under(linear, known, fit_target), fit_target.on(target.forward)
                linear = _relinearised(known, linear, fit)
                null = self._null(known, fit, linear)
                where = evidences(linear, null)
                law_words = f"{best.term.port.words}: {best.feature.formula(self.units[0])}{in_words(best.term.scope)}"
                rest = f"{where[0].port.words} {where[0].log_evidence:.1f} nats"
                self.report(f"law at {law_words}, score {best.score:.1f}; then {rest}")
                if anew and not terms:
                    ties = _tied(best, [_under_noise_of(best, tie) for tie in ties])
                law = replace(law, terms=[*terms, best], ties=ties, afterwards=[*law.afterwards, where[0]])
                yield law
        except OutOfTime:
            self.report("the time was up before the law was found")
        if not law.terms:
            yield law

    def _sharpened(
        self, known: FitTarget, fit: Fit, linear: Responses, values: np.ndarray, where: Sequence[PortEvidence]
    ) -> Responses:
        """Responses with exact columns at the ports that lead by evidence or gain, and at all that need no rollouts."""
        by_gain = dict.fromkeys(row.port for row in self._ranked(linear, values, 0.0))
        leading = [row.port for row in where[:BY_EVIDENCE]] + list(by_gain)[:BY_GAIN]
        chosen = [p for p in self.ports.ports if p.stage == "sensing" or p in leading]
        return with_exact_columns(known, fit, linear, {port: self._offered(port, values)[1] for port in chosen})

    def _features(self, port: Port) -> Sequence[Feature]:
        """Features of a law at a port, which on a body include the motion."""
        if self.ports.members(port) != (port,):
            features = tuple(self.own)
        else:
            features = (*self.table.features, *(self.table.of_motion if port.stage == "body" else ()))
        return features if self.timed else tuple(feature for feature in features if not feature.in_time)

    def _offered(self, port: Port, values: Float[np.ndarray, "group feature row"]) -> tuple[np.ndarray, np.ndarray]:
        """Sizes of a port's features, and the features over their sizes (group, feature, member, row)."""
        place = {feature: k for k, feature in enumerate((*self.table.features, *self.table.of_motion))}
        own = [[place[f.of(m.number)] for m in self.ports.members(port)] for f in self._features(port)]
        signals = values[:, np.array(own)]
        sizes = np.sqrt(np.mean(signals**2, axis=(0, 2, 3)))  # root mean squares over all recordings
        return sizes, signals / np.maximum(sizes, 1e-300)[:, None, None]

    def _null(self, known: FitTarget, fit: Fit, linear: Responses) -> Float[np.ndarray, "draw n"]:
        """Whitened residuals of simulated data sets that lack nothing."""
        rng = np.random.default_rng([self.seed, 6])
        draws = null_residuals(known.measurements, known.noise, linear.base, len(fit.free), rng, NULLS)
        return draws[:, : linear.residual.size]

    def _null_quantile(self, linear: Responses, values: np.ndarray, null: Float[np.ndarray, "draw n"]) -> float:
        """Gain [nat] that the best of all features at all ports has in a share `level` of data sets that lack
        nothing."""
        series = np.moveaxis(null.reshape(-1, *linear.residual.shape), 0, 2)
        most = np.full(len(null), -np.inf)
        for port in self.ports.ports:
            for _, columns in self._scoped(linear, feature_columns(linear, port, self._offered(port, values)[1])):
                most = np.maximum(most, cross_validated_gains(_sums(linear, columns, series))[0][:, 1:].max(axis=0))
        return float(np.quantile(most, 1.0 - self.level, method="higher"))

    def _ranked(
        self, linear: Responses, values: np.ndarray, null_quantile: float,
        precision: Float[np.ndarray, "d d"] | None = None, terms: Sequence[Refit] = (),
    ) -> list[TermGain]:  # fmt: skip
        """All features at all ports whose gain exceeds the null quantile ``null_quantile``, the largest gain first; see
        `cross_validated_gains`.

        Terms already in the law or the model are excluded: at a strongly nonlinear port they would gain again. A term
        whose shape is inferred has every shape.
        """
        rows = []
        had = {refit.term.place for refit in terms}
        had |= {_of_any_shape(refit.term.place) for refit in terms if refit.term.shape}
        for port in self.ports.ports:
            features, (sizes, signals) = self._features(port), self._offered(port, values)
            for scope, columns in self._scoped(linear, feature_columns(linear, port, signals)):
                gains, share, size, sd = cross_validated_gains(_sums(linear, columns), precision)
                for k in np.flatnonzero((gains[:, 0] > null_quantile) & (share >= LEAST)).tolist():
                    parts = (float(size[k] / sizes[k]), float(sd[k] / sizes[k]), float(sizes[k]))
                    row = TermGain(port, features[k], float(gains[k, 0]), float(share[k]), *parts, scope)
                    if had & {row.place, _of_any_shape(row.place)}:
                        continue
                    if not self.taken or coefficient_name(*row.place[:2], self.units[0], scope.group) not in self.taken:
                        rows.append(row)
        return sorted(rows, key=lambda row: -row.gain)

    def _scoped(
        self, linear: Responses, columns: Float[np.ndarray, "group value feature"]
    ) -> Iterator[tuple[Scope, Float[np.ndarray, "group value feature"]]]:
        """Effects of features that act in the recordings of one scope only."""
        for scope in self.scopes:
            yield scope, columns * scope.has(linear.recordings)[:, None, None] if scope.group else columns

    def _exchanged(
        self, known: FitTarget, terms: Sequence[Refit], linear: Responses, values: np.ndarray, refits: Sequence[Refit],
        null_quantile: float, where: Sequence[PortEvidence],
    ) -> tuple[Refit, list[Refit]]:  # fmt: skip
        """The best term after full optimisation, or a replacement; and all other refits.

        The base model has compensated for a part of the missing effect, and the linear model does not predict its
        correction. With a law in the model the base parameters are nearer to the truth. The terms are then ranked
        again, with base parameters constrained by their posterior. The term's feature is also tried at the ports with
        the largest evidence, at which the linear model may have preferred another feature: a delay is strongly
        nonlinear.
        """
        chosen, every = refits[0], list(refits)
        best, tried = self._optimised(chosen), {chosen.term.place}
        for _ in range(EXCHANGES):
            fit = best.fit
            without = fit.x.copy()
            without[-1] = 0.0
            residual = best.target.residual(without[None])[0]
            bare = replace(fit, x=without[:-1], free=fit.free[:-1], residual=residual, jacobian=fit.jacobian[:, :-1],
                           covariance=fit.covariance[:-1, :-1])  # fmt: skip
            scale = _scale(known, bare)
            precision = np.linalg.inv(bare.covariance / np.outer(scale, scale))  # of the posterior, in prior deviations
            model = LinearModel(known, terms, bare, _relinearised(known, linear, bare), precision)
            ranked = self._ranked(model.responses, values, null_quantile, model.precision, terms)
            ranked = [row for row in ranked if row.place not in tried]
            fresh = self._confirmed(model, ranked, null_quantile, partial(fresh_terms, best=best.term, where=where))
            tried |= {row.place for row in fresh}
            others = [self._refit(known, terms, bare, row) for row in fresh]
            every += others
            better = max(others, key=lambda refit: refit.score, default=best)
            if better.square >= best.square - 2.0:
                break
            words = f"{better.term.port.words}: {better.term.feature.formula(self.units[0])}"
            self.report(f"instead: {words}{in_words(better.term.scope)}")
            best = self._optimised(better)
        before = chosen.square + 2.0 * (chosen.score + self._cost(known))
        best, *every = (replace(r, score=0.5 * (before - r.square) - self._cost(known)) for r in (best, *every))
        return best, every

    def _cost(self, known: FitTarget) -> float:
        """Nats that a term costs: its parameter, and the choice among all features at all ports."""
        count = max(float(np.sum(known.measurements.valid)), 2.0)
        choices = len(self.scopes) * sum(len(self._features(port)) for port in self.ports.ports)
        return float(0.5 * np.log(count) + np.log(choices))

    def _confirmed(
        self, model: LinearModel, ranked: Sequence[TermGain], null_quantile: float,
        chosen: Callable[[Sequence[TermGain]], list[TermGain]],
    ) -> list[TermGain]:  # fmt: skip
        """The terms to refit, each with its gain beside the present model.

        Responses belong to the first model, and splines miss fast effects. A law and refitted base parameters change
        the model enough to produce false gains. The effect of a chosen term is therefore recomputed by rollouts, and
        terms are chosen again until all have been recomputed.
        """
        rows, seen = list(ranked), dict[tuple[Port, Feature, str], TermGain]()
        while fresh := [row for row in chosen(rows) if row.place not in seen]:
            seen |= {row.place: row for row in self._beside(model, fresh)}
            rows = [seen.get(row.place, row) for row in rows]
            rows = sorted((r for r in rows if r.gain > null_quantile and r.share >= LEAST), key=lambda row: -row.gain)
        return chosen(rows)

    def _beside(self, model: LinearModel, rows: Sequence[TermGain]) -> list[TermGain]:
        """Terms with their gains beside a model, with effects from rollouts."""
        placed_terms = [self._placed(row) for row in rows]
        target = model.known.on(self._with(model.known, model.terms, placed_terms))
        x = np.append(model.fit.x, np.zeros(len(rows)))
        directions = np.eye(len(x))[-len(rows) :]

        def compute() -> dict[str, np.ndarray]:
            return {"slopes": target.slopes(np.repeat(x[None], len(rows), axis=0), directions)[0]}

        series = target.measurements.series(target.recall("terms", [x], compute)["slopes"])
        columns = np.moveaxis(series.reshape(len(rows), len(model.responses.residual), -1), 0, 2)
        gains, share, size, sd = cross_validated_gains(_sums(model.responses, columns), model.precision)
        scales = [float(term.spec.prior["scale"]) for term in placed_terms]
        numbers = zip(rows, gains[:, 0].tolist(), share.tolist(), size * scales, sd * scales, strict=True)
        return [replace(row, gain=g, share=s, size=float(c), sd=float(d)) for row, g, s, c, d in numbers]

    def _placed(self, row: TermGain) -> PlacedTerm:
        return placed(row.port, row.feature, row.typical, *self.units, row.scope)

    def _with(self, known: FitTarget, terms: Sequence[Refit], added: Sequence[PlacedTerm]) -> PortedForward:
        """Rollouts with further terms after the law's."""
        return PortedForward(known.forward, self.ports, self.table, [*(refit.term for refit in terms), *added])

    def _refits(self, known: FitTarget, terms: Sequence[Refit], fit: Fit, chosen: Sequence[TermGain]) -> list[Refit]:
        """Terms, each refitted; the best first."""
        refits = []
        for row in chosen:
            tried = self._refit(known, terms, fit, row)
            refits.append(tried)
            words = f"{row.port.words}: {row.feature.formula(self.units[0])}{in_words(row.scope)}"
            self.report(f"refit with {words}: left-out gain {row.gain:.1f}, score {tried.score:.1f}")
        return sorted(refits, key=lambda refit: -refit.score)

    def _refit(self, known: FitTarget, terms: Sequence[Refit], fit: Fit, row: TermGain) -> Refit:
        """The model with one more term, optimised a few steps from the linear model's estimate."""
        term = self._placed(row)
        scale = float(term.spec.prior["scale"])
        start = np.append(fit.x, np.clip(row.size / scale, -FARTHEST, FARTHEST))
        free = np.append(fit.free, len(start) - 1)
        target = known.on(self._with(known, terms, [term]))
        fitted = optimise(target, start, free, evaluations=GLANCE)
        gained = float(fit.residual @ fit.residual - fitted.residual @ fitted.residual)
        return Refit(term, target, fitted, row, 0.5 * gained - self._cost(known))

    def _optimised(self, refit: Refit) -> Refit:
        """The refit after a complete optimisation."""
        return replace(refit, fit=optimise(refit.target, refit.fit.x, refit.fit.free))

    def _shaped(self, known: FitTarget, terms: Sequence[Refit], best: Refit) -> Refit:
        """The same with the shape of the last term's feature inferred, if the data prefer another shape.

        The dictionary has few shapes. Residuals of an intermediate shape would lead to further, false terms.
        """
        if best.term.feature.shape is None:
            return best
        term = best.term.with_shape(self.units[1])
        target, start = known.on(self._with(known, terms, [term])), np.append(best.fit.x, 0.0)
        fit = optimise(target, start, np.append(best.fit.free, len(best.fit.x)))
        shaped = replace(best, term=term, target=target, fit=fit)
        cost = 0.5 * float(np.log(max(float(np.sum(known.measurements.valid)), 2.0)))
        gained = 0.5 * (best.square - shaped.square) - cost
        if gained <= 0.0:
            return best
        self.report(f"its shape is {shaped.feature.shape:.3g}, {gained:.1f} nats better than {best.feature.shape:.3g}")
        return replace(shaped, score=best.score + gained)


def leading_terms(ranked: Sequence[TermGain], where: Sequence[PortEvidence]) -> list[TermGain]:
    """The best terms by evidence of their ports and by gain."""
    by_port: dict[Port, TermGain] = {}
    for row in ranked:
        by_port.setdefault(row.port, row)
    chosen = list(by_port.values())[: BY_GAIN + 1]
    chosen += [by_port[row.port] for row in where[:BY_EVIDENCE] if row.port in by_port]
    return list(dict.fromkeys([*chosen, *ranked[:BY_GAIN]]))


def fresh_terms(ranked: Sequence[TermGain], best: PlacedTerm, where: Sequence[PortEvidence]) -> list[TermGain]:
    """Possible replacements of the best term: terms of largest gain, its feature at the leading ports, and the term
    itself in other recordings.
    """
    leading = [row.port for row in where[:BY_EVIDENCE]]
    same = [row for row in ranked if row.feature == best.feature]
    alike = [row for row in same if row.port == best.port or (row.port in leading and row.scope == best.scope)]
    return list(dict.fromkeys([*ranked[:FRESH], *alike]))


def _of_any_shape(place: tuple[Port, Feature, str]) -> tuple[Port, Feature, str]:
    """The place of a term whose shape may be any."""
    port, feature, group = place
    return port, feature._replace(shape=None), group


def in_words(scope: Scope) -> str:
    """Phrase with the group of recordings if a law acts in one group only."""
    return f" in {scope.group} alone" if scope.group else ""


FARTHEST = 100.0  # prior deviations within which a refit starts


def _tied(best: Refit, others: Sequence[Refit]) -> list[Refit]:
    """Refits of other terms with residuals as small as the best, within `TIED`; each term once, the best first."""
    refits_by_place: dict[tuple[Port, Feature, str], Refit] = {}
    for refit in sorted(others, key=lambda refit: -refit.score):
        refits_by_place.setdefault(refit.term.place, refit)
    refits_by_place.pop(best.term.place, None)
    return [refit for refit in refits_by_place.values() if refit.score > best.score - TIED]


def _under_noise_of(best: Refit, tie: Refit) -> Refit:
    """A refit of another term under the noise of the best term's residuals, since the noise of a misspecified model
    discriminates less.
    """
    target = best.target.on(tie.target.forward)
    fit = optimise(target, tie.fit.x, tie.fit.free, evaluations=GLANCE)
    refit = replace(tie, target=target, fit=fit)
    return replace(refit, score=best.score - 0.5 * (refit.square - best.square))


def _scale(known: FitTarget, fit: Fit) -> Float[np.ndarray, " free"]:
    """Prior deviations of a fit's parameters; coefficients of laws have their own as a unit."""
    base = fit.free < len(known.forward.coordinates.names)
    return np.append(known.forward.coordinates.prior_sd[fit.free[base]], np.ones(np.count_nonzero(~base)))


def _relinearised(known: FitTarget, linear: Responses, fit: Fit) -> Responses:
    """The same responses beside the residual and the slopes of another fit, the coefficients of laws among them."""
    groups = linear.residual.shape[0]
    white = known.measurements.series(fit.residual).reshape(groups, -1)
    slopes = known.measurements.series(fit.jacobian.T).reshape(len(fit.free), groups, -1)
    scale = _scale(known, fit)
    own = known.forward.coordinates
    pulls = np.append(own.prior_slopes(fit.x[: len(own.names)])[0], -fit.x[len(own.names) :])  # laws have unit normals
    jacobian = np.moveaxis(slopes * scale[:, None, None], 0, 2)
    return replace(linear, residual=white, jacobian=jacobian, pull=-pulls[fit.free] * scale)


def law_search(
    target: FitTarget, ports: PortMap, channels: Sequence[str], unit: str, seed: int, level: float,
    report: Callable[[str], None], groups: Groups | None = None, timed: bool = True,
) -> LawSearch:  # fmt: skip
    """The search on a simulator with these ports and commands, for laws of all recordings and of single groups."""
    commands = target.forward.commands
    stroke = float(np.ptp(np.concatenate([np.asarray(commands.step), np.asarray(commands.initial)[:, None]], axis=1)))
    stroke = max(stroke, 1e-12)
    features = dictionary(len(channels), stroke)
    table = FeatureTable(target.forward.lanes, features)
    own, names = own_dictionary(stroke), target.forward.coordinates.names
    taken = frozenset(name for name in names if name.startswith(PREFIX))
    members = {} if groups is None else groups.members
    scopes = (EVERYWHERE, *(Scope(name, recordings) for name, recordings in members.items()))
    units = (tuple(channels), unit)
    return LawSearch(ports, table, own, units, seed, level, report, taken=taken, scopes=scopes, timed=timed)
