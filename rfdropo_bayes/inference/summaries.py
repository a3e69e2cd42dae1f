"""What simulation-based rivals see of a trajectory: the summaries that their authors used."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float


def cross_correlation_summary(
    features: Float[np.ndarray, "n time f"], actions: Float[np.ndarray, "time a"]
) -> Float[np.ndarray, "n s"]:
    """BayesSim's: correlation of state changes with actions, and mean and deviation of the state changes.

    Ramos, Possas and Fox 2019, eq. 10: ``s = (<tau_s, tau_a>_ij, E[tau_s], Var[tau_s])`` with ``tau_s`` the state
    differences.
    """
    change = np.diff(features, axis=1)
    action = actions[: change.shape[1]]
    products = np.einsum("ntf,ta->nfa", change, action) / len(action)
    parts = (products.reshape(len(features), -1), change.mean(axis=1), change.std(axis=1))
    return np.concatenate(parts, axis=1)


def thinned_summary(features: Float[np.ndarray, "n time f"], most: int = 100) -> Float[np.ndarray, "n s"]:
    """NPDR's: the trajectory itself, every second row; rows are thinned further until at most ``most`` numbers remain.

    More features than ``most`` in a single row are kept all.
    """
    step = max(2, -(-features.shape[1] * features.shape[2] // most))
    return features[:, step - 1 :: step].reshape(len(features), -1)


def informative(
    summaries: Float[np.ndarray, "n s"], observed: Float[np.ndarray, " s"]
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, " k"], Bool[np.ndarray, " s"]]:
    """Summaries that vary, standardised; masked features are constant and would divide by zero."""
    spread = summaries.std(axis=0)
    kept = spread > 1e-9 * max(float(spread.max()), 1e-300)
    mean, spread = summaries.mean(axis=0)[kept], spread[kept]
    return (summaries[:, kept] - mean) / spread, (observed[kept] - mean) / spread, kept
