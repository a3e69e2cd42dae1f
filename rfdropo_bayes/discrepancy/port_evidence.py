"""Evidence of ports: the log evidence of a signal at each port, with base parameters projected out.

    residual y = H b + Phi w + e H: slopes of the base parameters, of flat prior: projected out; e: unit noise w = L v,
    v ~ N(0, s^2), L L' = K = exp(-|ti - tj| / l), one K for each recording

With A = (I - Q Q') Phi, Q = orth(H), and L'A'A L = V lam V', c = V'L'A'y, the evidence against no signal is -1/2 sum
log(1 + s^2 lam) + 1/2 sum s^2 c^2 / (1 + s^2 lam); size s and memory l maximise it on a grid (empirical Bayes;
Rasmussen and Williams 2006, section 2.2 and 5.4). All ports are tested as a family: against the largest log evidence of
any port in simulated data sets without a discrepancy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.discrepancy.port_responses import Responses
from rfdropo_bayes.discrepancy.score import project_out
from rfdropo_bayes.discrepancy.score_tests import tail
from rfdropo_bayes.mechanisms.ports import Port

MEMORIES = (0.1, 0.4, 1.5, 6.0)  # [s]
SIZES = np.geomspace(0.01, 30.0, 15)  # of a signal, in sizes of its port


@dataclass(frozen=True)
class PortEvidence:
    """Evidence of a signal at one port.

    Attributes:
        port: the port.
        log_evidence: log evidence of a signal over no signal [nat]; 0 if no signal is likelier.
        adjusted_p: probability of evidence this large at any port under a right model.
        amplitude: root mean square of the signal's mean [unit of the port].
        memory: correlation time of the signal [s].
        share: explained share of the residuals beyond the noise.
        mean, sd: mean and deviation of the signal at the splines' centres, one row a group of recordings.
    """

    port: Port
    log_evidence: float
    adjusted_p: float
    amplitude: float
    memory: float
    share: float
    mean: Float[np.ndarray, "group spline"]
    sd: Float[np.ndarray, "group spline"]


@dataclass(frozen=True)
class Decomposed:
    """A port's model in its principal directions, for one memory: evidences of any data at once."""

    root: Float[np.ndarray, "coefficient coefficient"]  # L V
    eigenvalues: Float[np.ndarray, " coefficient"]

    def gains(self, projected: Float[np.ndarray, "coefficient data"]) -> Float[np.ndarray, "size data"]:
        """Log evidences of each size; ``projected`` is A'y in sizes of the port."""
        c = (self.root.T @ projected) ** 2
        square = SIZES[:, None] ** 2
        variance = 1.0 + square * self.eigenvalues
        return 0.5 * (square / variance) @ c - 0.5 * np.sum(np.log(variance), axis=1)[:, None]


def evidences(linear: Responses, null: Float[np.ndarray, "draw n"]) -> list[PortEvidence]:
    """Evidence of every port, the largest first.

    Args:
        linear: responses of the model.
        null: whitened residuals of simulated data sets without discrepancy.
    """
    base, ports = linear.base, list(linear.whitened)
    residual = project_out(base, linear.residual.reshape(-1)[:, None])[:, 0]
    data = np.concatenate([residual[:, None], null.T[: len(residual)]], axis=1)
    kernels = [np.exp(-np.abs(np.subtract.outer(linear.basis.centre, linear.basis.centre)) / m) for m in MEMORIES]
    roots = [np.linalg.cholesky(kernel + 1e-10 * np.eye(len(kernel))) for kernel in kernels]
    best, every = {}, np.zeros((len(ports), data.shape[1]))
    for k, port in enumerate(ports):
        parts = _decomposed(linear, base, port, roots)
        response = port.size * linear.whitened[port]
        series = data.reshape(*linear.residual.shape, -1)  # whose base parameters are projected out already
        projected = np.concatenate([part.T @ own for part, own in zip(response, series, strict=True)])  # Phi'y
        gains = np.stack([part.gains(projected) for part in parts])  # memory, size, data
        every[k] = np.maximum(gains.max(axis=(0, 1)), 0.0)
        place = np.unravel_index(int(np.argmax(gains[:, :, 0])), gains.shape[:2])
        best[port] = (parts[place[0]], float(SIZES[place[1]]), MEMORIES[place[0]], projected[:, 0])
    most, excess = every[:, 1:].max(axis=0), float(residual @ residual) - linear.noise * (len(residual) - base.shape[1])
    rows = []
    for k, port in enumerate(ports):
        part, size, memory, projected = best[port]
        lam, c = part.eigenvalues, part.root.T @ projected
        variance = 1.0 + size**2 * lam
        g = size**2 * c / variance
        freedom = float(np.sum(size**2 * lam / variance))
        share = (2.0 * float(g @ c) - float(g @ (lam * g)) - freedom) / max(excess, 1e-300) if excess > 0.0 else 0.0
        mean = (part.root @ g).reshape(linear.residual.shape[0], -1)
        sd = np.sqrt(np.sum(part.root**2 * (size**2 / variance), axis=1)).reshape(mean.shape)
        rms = float(np.sqrt(np.mean(mean**2)))
        rows.append(
            PortEvidence(port, float(every[k, 0]), tail(every[k, 0], most), port.size * rms, memory, share,
                         port.size * mean, port.size * sd)
        )  # fmt: skip
    return sorted(rows, key=lambda row: -row.log_evidence)


def _decomposed(
    linear: Responses, base: Float[np.ndarray, "n rank"], port: Port, roots: Sequence[np.ndarray]
) -> list[Decomposed]:
    response = port.size * linear.whitened[port]
    groups, _, count = response.shape
    across = base.reshape(*linear.residual.shape, -1)
    taken = np.concatenate([part.T @ own for part, own in zip(response, across, strict=True)])
    gram = -taken @ taken.T
    for g, part in enumerate(response):
        own = slice(g * count, (g + 1) * count)
        gram[own, own] += part.T @ part
    parts = []
    for root in roots:
        whole = np.kron(np.eye(groups), root)
        values, vectors = np.linalg.eigh(whole.T @ gram @ whole)
        parts.append(Decomposed(whole @ vectors, np.maximum(values, 0.0)))
    return parts
