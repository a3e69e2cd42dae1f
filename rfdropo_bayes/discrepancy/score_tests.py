"""Score tests of a model: a joint test of its residuals, and a test of each candidate.

All p-values come from a parametric bootstrap: residuals are simulated under a right model. Noise is drawn for every
recording, the noise model is estimated as for the data, and the base model is refitted linearly. One prediction
is rolled out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.noise.autoregression import MISFIT, RESIDUALS, STATED
from rfdropo_bayes.bayes.noise.stacked import Stacked
from rfdropo_bayes.discrepancy.candidates import Probe
from rfdropo_bayes.discrepancy.fit import Fit, FitTarget
from rfdropo_bayes.discrepancy.measurements import Measurements
from rfdropo_bayes.discrepancy.omnibus import (
    DIRECTED,
    POSE,
    Omnibus,
    block_squares,
    joint_test,
    pose_regressors,
    statistics,
)
from rfdropo_bayes.discrepancy.score import Signature, project_out, signature, span, statistic
from rfdropo_bayes.discrepancy.unknown_size import linear_evidence

CHUNK_NUMBERS = 2e7  # of simulated residuals in memory at a time
IMITATED = 0.01  # of a regressor's norm: base parameters imitate it if they leave less


@dataclass(frozen=True)
class ScoreRow:
    """Score test of one candidate.

    Attributes:
        name: registry name.
        probe: its best probe; None if its effect is not visible.
        lm: score statistic of that probe; rank: its degrees of freedom.
        p: p-value of that probe alone.
        adjusted_p: probability of a statistic this large at any probe of any candidate under a right model.
        score: log Bayes factor of its linear effect [nat], see `unknown_size`; candidates are ranked by it.
    """

    name: str
    probe: Probe | None
    lm: float
    rank: int
    p: float
    adjusted_p: float
    score: float


@dataclass(frozen=True)
class ScoreTests:
    """A model, the joint test of its residuals, and the score tests of candidates (best first).

    ``finer`` is the joint test of the residuals on a finer mesh and time step, None without it; ``omnibus`` is the same
    if the model passes by it.
    """

    fit: Fit
    omnibus: Omnibus
    rows: tuple[ScoreRow, ...]
    finer: Omnibus | None = None

    @property
    def refined(self) -> bool:
        """Whether it is on the finer mesh and time step that the model was tested."""
        return self.omnibus is self.finer

    def row(self, name: str) -> ScoreRow:
        """Row of one candidate."""
        return next(row for row in self.rows if row.name == name)


def run_score_tests(
    target: FitTarget,
    fit: Fit,
    probes: Sequence[Probe],
    names: Sequence[str],
    seed: Any,
    bootstraps: int,
    finer: Float[np.ndarray, " n"] | None = None,
) -> ScoreTests:
    """Test a fitted model and candidates against it, calibrated by parametric bootstrap.

    Args:
        target: data and noise.
        fit: fit of the model.
        probes: probes of all candidates.
        names: names of all candidates, including candidates without a probe.
        seed: seed of the bootstrap.
        bootstraps: number of simulated data sets.
        finer: residuals of the finer simulator with the same parameters.
    """
    seen, base = [probe for probe in probes if probe.mark.rank > 0], span(fit.jacobian)
    # As in the simulated data sets, a further step of the parameters is no discrepancy: a prior holds back a size of
    # many of its deviations.
    measured = np.stack([fit.residual] if finer is None else [fit.residual, finer])
    residuals = project_out(base, measured.T).T
    pose = _of_the_pose(target, fit, base)
    observed, surprises = _statistics(target, residuals, seen, pose)
    simulated, reference = _simulated(target, fit, seen, pose, np.random.default_rng(seed), bootstraps)
    if target.noise.source == RESIDUALS:  # their mean square equals the residuals' by construction
        del observed["variance"], simulated["variance"]
    most = reference.max(axis=1) if seen else np.zeros(bootstraps)
    if seen:  # without candidates their test has no p-value
        observed[DIRECTED], simulated[DIRECTED] = surprises.max(axis=1), most
    tests = []
    for index, residual in enumerate(residuals):
        white = target.measurements.series(residual)
        blocks = block_squares(white, target.measurements.valid)
        tests.append(joint_test({name: float(v[index]) for name, v in observed.items()}, simulated, blocks))
    rows = []
    for name in names:
        own = [i for i, probe in enumerate(seen) if probe.candidate == name]
        if not own:
            rows.append(ScoreRow(name, None, 0.0, 0, 1.0, 1.0, -np.inf))
            continue
        best = max(own, key=lambda i: surprises[0, i])
        surprise, probe = surprises[0, best], seen[best]
        lm, rank = float(statistic(probe.mark, fit.residual)[0]), probe.mark.rank
        p = max(float(np.exp(-surprise)), float(np.finfo(float).tiny))  # no p-value is zero
        usual = target.forward.coordinates.prior_sd[list(probe.amplitudes)] if probe.amplitudes else 1.0
        score = linear_evidence(project_out(base, probe.columns) * usual, fit.residual, probe.mark.sign)
        rows.append(ScoreRow(name, probe, lm, rank, p, tail(surprise, most), score))
    return ScoreTests(
        fit, tests[0], tuple(sorted(rows, key=lambda row: -row.score)), tests[1] if len(tests) > 1 else None
    )


def _of_the_pose(target: FitTarget, fit: Fit, base: Float[np.ndarray, "n rank"]) -> Signature:
    """The part of `pose_regressors` that base parameters cannot imitate."""
    measured = target.measurements
    groups, rows, _ = measured.count.shape
    shown = target.recall("shown", [fit.x], lambda: {"position": target.forward.observe_one(fit.x)["position"]})
    position = shown["position"].reshape(groups, -1, measured.markers // 3, 3)[:, :rows]
    errors = np.zeros((6 * 3, *measured.count.shape))
    errors[..., : measured.markers] = pose_regressors(position, measured.time, measured.valid[..., : measured.markers])
    columns = np.zeros((measured.size, len(errors)))
    columns[: measured.count.size] = measured.whiten(errors, target.noise).T
    return signature(base, columns / np.maximum(IMITATED * np.linalg.norm(columns, axis=0), np.finfo(float).tiny))


def _statistics(
    target: FitTarget, residuals: Float[np.ndarray, "count n"], probes: Sequence[Probe], pose: Signature
) -> tuple[dict[str, np.ndarray], Float[np.ndarray, "count probe"]]:
    joint = statistics(target.measurements.series(residuals)) | {POSE: statistic(pose, residuals)[1]}
    surprises = [statistic(probe.mark, residuals)[1] for probe in probes]
    return joint, np.stack(surprises, axis=1) if probes else np.zeros((len(residuals), 0))


def _simulated(
    target: FitTarget, fit: Fit, probes: Sequence[Probe], pose: Signature, rng: np.random.Generator, count: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    base = span(fit.jacobian)
    chunk = max(1, min(count, int(CHUNK_NUMBERS / base.shape[0])))
    parts: list[tuple[Mapping[str, np.ndarray], np.ndarray]] = []
    for start in range(0, count, chunk):
        size = min(chunk, count - start)
        residuals = null_residuals(target.measurements, target.noise, base, len(fit.free), rng, size)
        parts.append(_statistics(target, residuals, probes, pose))
    joined = {name: np.concatenate([part[0][name] for part in parts]) for name in parts[0][0]}
    return joined, np.concatenate([part[1] for part in parts])


def null_residuals(
    measurements: Measurements,
    noise: Stacked,
    base: Float[np.ndarray, "n rank"],
    parameters: int,
    rng: np.random.Generator,
    count: int,
) -> Float[np.ndarray, "count n"]:
    """Whitened residuals of ``count`` data sets without discrepancy, after the base model is fitted to each.

    Args:
        measurements: the data, for their times, gaps and repeats.
        noise: noise to draw.
        base: orthonormal basis of the base parameters' effects on whitened data.
        parameters: number of fitted base parameters.
        rng: random generator of the noise.
        count: number of data sets.
    """
    residuals = np.empty((count, len(base)))
    drawn = noise.at(measurements.single_steps).draw(rng, (count, *measurements.departures.shape))
    if noise.source == RESIDUALS:
        # Estimated from residuals of the base model, as for the data: noise before a fit is slightly larger.
        order = [group[0] for group in measurements.members]
        white, rows = measurements.whiten(drawn[:, order], noise), base[: measurements.count.size]
        left = (white - white @ rows @ rows.T).reshape(count, *measurements.count.shape)
        drawn = np.empty_like(drawn)
        drawn[:, order] = noise.at(measurements.steps).colour(left, measurements.valid)
    for row, single in enumerate(drawn):
        estimated = noise
        if noise.source not in (STATED, MISFIT):
            estimated = measurements.noise(single, parameters, noise)
        residuals[row, : measurements.count.size] = measurements.whiten(measurements.mean_of(single), estimated)
    weighed = measurements.size - measurements.count.size  # whose errors are known
    residuals[:, measurements.count.size :] = rng.standard_normal((count, weighed))
    return project_out(base, residuals.T).T


def tail(observed: float, simulated: Float[np.ndarray, " count"]) -> float:
    """Share of simulated statistics at least as large, the observed one among them."""
    return float((1 + np.sum(simulated >= observed)) / (1 + len(simulated)))


def p_in_words(p: float, simulated: int) -> str:
    """A bootstrap's p-value, "= 0.02"; "< 0.001" if no simulated statistic was as large."""
    least = 1.0 / (1 + simulated)
    return f"= {p:.2g}" if p > 1.5 * least else f"< {least:.2g}"
