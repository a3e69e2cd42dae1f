"""Efficient score statistics: the residual explained by a direction but not by base parameters.

With whitened residual r and base Jacobian J at the optimum, a candidate's directions J_m leave S = (I - J (J'J)^-1 J')
J_m, and LM = r'S (S'S)^-1 S'r is chi-squared with the rank of S as its degrees of freedom if the base model is right
(Rao's score test). A single direction with a known sign counts on that side only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

RANK_TOLERANCE = 1e-5  # of the largest singular value: limit of the base parameters' span
VISIBLE = 1.0  # least norm of the change of the whitened data by a candidate of the size that its prior expects


@dataclass(frozen=True)
class Signature:
    """Effect of a candidate on the whitened data, orthogonal to the base parameters' effects."""

    basis: Float[np.ndarray, "n rank"]  # orthonormal columns of S; empty if no effect is visible
    sign: int  # +1 if only the positive side of its single direction has a meaning; else 0

    @property
    def rank(self) -> int:
        """Directions that can be seen."""
        return self.basis.shape[1]


def span(jacobian: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n rank"]:
    """Orthonormal basis of the span of the columns, each scaled to unit length."""
    size = np.linalg.norm(jacobian, axis=0)
    columns = jacobian[:, size > 0] / size[size > 0]
    if columns.shape[1] == 0:
        return np.zeros((len(jacobian), 0))
    vectors, values, _ = np.linalg.svd(columns, full_matrices=False)
    return vectors[:, values > RANK_TOLERANCE * values[0]]


def project_out(base: Float[np.ndarray, "n rank"], columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Columns less their part in the span of an orthonormal basis."""
    remaining = columns - base @ (base.T @ columns)
    return remaining - base @ (base.T @ remaining)  # twice, so that rounding leaves nothing either


def signature(base: Float[np.ndarray, "n rank"], columns: Float[np.ndarray, "n k"], sign: int = 0) -> Signature:
    """The visible part of a candidate's directions, each column is the effect of a prior-sized change."""
    visible = project_out(base, columns)
    if visible.shape[1] == 1:
        size = float(np.linalg.norm(visible))
        return Signature(visible / size, sign) if size > VISIBLE else Signature(visible[:, :0], 0)
    vectors, values, _ = np.linalg.svd(visible, full_matrices=False)
    return Signature(vectors[:, values > max(VISIBLE, 1e-3 * values[0])], 0)


def statistic(mark: Signature, residual: Float[np.ndarray, "*batch n"]) -> tuple[np.ndarray, np.ndarray]:
    """LM and minus the logarithm of its p-value under the base model, of one or many residuals."""
    score = residual @ mark.basis
    lm = np.sum(score**2, axis=-1)
    if mark.rank == 0:
        return lm, np.zeros_like(lm)
    surprise = -chi2.logsf(lm, mark.rank)
    if mark.sign:
        right = mark.sign * score[..., 0] > 0
        lm, surprise = np.where(right, lm, 0.0), np.where(right, surprise + np.log(2.0), 0.0)
    return lm, surprise


def joint_statistic(first: Signature, second: Signature, residual: Float[np.ndarray, " n"]) -> float:
    """LM of two candidates together; 0 if the linear model gives one of them a forbidden sign."""
    basis = np.concatenate([first.basis, second.basis], axis=1)
    size, *_ = np.linalg.lstsq(basis, residual, rcond=1e-3)
    own = size[: first.rank], size[first.rank :]
    if any(mark.sign * part[0] < 0 for mark, part in zip((first, second), own, strict=True) if mark.sign):
        return 0.0
    return float(residual @ (basis @ size))


def likeness(first: Signature, second: Signature) -> float:
    """Smallest cosine of the principal angles: 1 if the smaller signature lies within the larger."""
    if first.rank == 0 or second.rank == 0:
        return 0.0
    if first.sign and second.sign:
        return float(first.sign * second.sign * (first.basis[:, 0] @ second.basis[:, 0]))
    return float(np.linalg.svd(first.basis.T @ second.basis, compute_uv=False)[-1])
