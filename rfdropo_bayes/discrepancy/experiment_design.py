"""Which commands would distinguish the leading explanations, and with which probability.

If one hypothesis is true, another has the misfit ``lambda``: the squared whitened distance after its best fit to the
given and the new recordings together (T-optimality; Atkinson and Fedorov 1975, Biometrika 62:57-70). Twice the expected
log likelihood ratio is lambda, and the better hypothesis is found with probability ``Phi(sqrt(lambda) / 2)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from rfdropo_bayes.discrepancy.fit import Fit, FitTarget
from rfdropo_bayes.discrepancy.forward import Forward
from rfdropo_bayes.discrepancy.port_rollouts import with_laws_of
from rfdropo_bayes.simulators.commands import Commands, stack_commands


@dataclass(frozen=True)
class Hypothesis:
    """An explanation and its fit to the given recordings; ``forward`` has its law at a port, and is None without a
    law.
    """

    name: str
    fit: Fit
    forward: Forward | None = None


@dataclass(frozen=True)
class DesignOutlook:
    """Expected information of a command sequence.

    Attributes:
        separation: smallest lambda over pairs of hypotheses; pairs: lambda of each pair, the lesser of both directions.
        right: probability that the better hypothesis of the worst pair is found.
        information: gain of the base parameters' information, in nats (half the growth of the log determinant).
    """

    separation: float
    pairs: dict[tuple[str, str], float]
    right: float
    information: float


def outlooks(
    target: FitTarget, base: Fit, hypotheses: Sequence[Hypothesis], sequences: Sequence[Commands]
) -> list[DesignOutlook]:
    """Outlook of each command sequence, recorded once with the noise and at the times of the first given recording.

    Args:
        target: the given recordings; base: the base model's fit to them.
        hypotheses: explanations to distinguish; with fewer than two, only the information counts.
        sequences: commands on the simulator's clock, shaped like the given recordings.
    """
    forward = target.forward
    stacked = stack_commands(sequences)
    names = {f"new {k}": k for k in range(len(sequences))}
    repeated = [0] * len(sequences)  # every sequence is observed as the first recording was
    channels = tuple(channel.of_recordings(repeated) for channel in target.measurements.channels)
    valid = target.measurements.valid[repeated]
    fresh = replace(
        target,
        forward=Forward(
            forward.lanes, forward.coordinates, stacked, names, deadline=forward.deadline, start=forward.start[repeated]
        ),
        measurements=replace(target.measurements, channels=channels, count=valid.astype(float), members=()),
    )
    models = [base, *(h.fit for h in hypotheses)]
    owns = [fresh, *(fresh.on(with_laws_of(h.forward or forward, fresh.forward)) for h in hypotheses)]
    predicted = [-own.errors(fit.x) for own, fit in zip(owns, models, strict=True)]
    slopes = [
        -own.error_slopes(np.repeat(fit.x[None], len(fit.free), axis=0), np.eye(len(fit.x))[fit.free])[0]
        for own, fit in zip(owns, models, strict=True)
    ]
    outlooks_found = []
    for k in range(len(sequences)):

        def whiten(series: np.ndarray, k: int = k) -> np.ndarray:
            own = series[..., [k], :, :]
            white = target.noise.at(target.measurements.steps[:1]).whiten(own, valid[[k]])
            return white.reshape(*own.shape[:-3], -1)

        news = [whiten(series) for series in predicted]
        jacobians = [whiten(slope).T for slope in slopes]
        pairs = {}
        for i, one in enumerate(hypotheses, 1):
            for j, other in enumerate(hypotheses[i:], i + 1):
                both = [
                    _misfit(models[b], models[b].residual - models[a].residual, news[a] - news[b], jacobians[b])
                    for a, b in ((i, j), (j, i))
                ]
                pairs[(one.name, other.name)] = min(both)
        least = min(pairs.values(), default=0.0)
        outlooks_found.append(
            DesignOutlook(least, pairs, float(norm.cdf(0.5 * np.sqrt(least))), _information(base, jacobians[0]))
        )
    return outlooks_found


def _misfit(
    fit: Fit, old: Float[np.ndarray, " n"], new: Float[np.ndarray, " m"], jacobian: Float[np.ndarray, "m free"]
) -> float:
    """Squared distance that a hypothesis keeps from data that differ from its predictions by ``old`` and ``new``."""
    distance = np.concatenate([old, new])
    design = np.concatenate([fit.jacobian, jacobian])
    size = np.linalg.norm(design, axis=0)
    design = design[:, size > 0] / size[size > 0]
    step = np.linalg.lstsq(design, distance, rcond=1e-9)[0]
    return float(np.sum((distance - design @ step) ** 2))


def _information(base: Fit, jacobian: Float[np.ndarray, "m free"]) -> float:
    precision = np.linalg.inv(base.covariance)
    return 0.5 * float(np.linalg.slogdet(precision + jacobian.T @ jacobian)[1] - np.linalg.slogdet(precision)[1])


def best(outlook: Sequence[DesignOutlook], separating: bool) -> int:
    """The sequence that separates most, or that informs most if there is nothing to separate."""
    return int(np.argmax([o.separation if separating else o.information for o in outlook]))


def at_hand(target: FitTarget, hypotheses: Sequence[Hypothesis]) -> dict[tuple[str, str], float]:
    """Lambda of each pair on the recordings at hand alone."""
    none = np.zeros((0, 1))
    misfits = {}
    for i, one in enumerate(hypotheses):
        for other in hypotheses[i + 1 :]:
            both = [
                _misfit(b.fit, b.fit.residual - a.fit.residual, np.zeros(0), none.repeat(len(b.fit.free), axis=1))
                for a, b in ((one, other), (other, one))
            ]
            misfits[(one.name, other.name)] = min(both)
    return misfits
