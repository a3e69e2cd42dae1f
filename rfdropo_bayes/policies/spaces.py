"""Gymnasium's spaces of a policy layout."""

from __future__ import annotations

from typing import Any

import numpy as np

from rfdropo_bayes.robots.policy_layout import PolicyLayout

FAR = 1e3  # bound above all observed values, in SI units; Gymnasium requires bounds


def spaces_of(layout: PolicyLayout) -> tuple[Any, Any]:
    """Observation and action space."""
    from gymnasium import spaces  # it comes with an extra, which episodes do without

    observed = spaces.Box(-FAR, FAR, (layout.size,), np.float32)
    if layout.kind == "discrete":
        return observed, spaces.Discrete(len(layout.moves))
    return observed, spaces.Box(-1.0, 1.0, (len(layout.channels),), np.float32)
