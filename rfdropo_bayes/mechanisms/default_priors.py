"""Default priors of mechanisms, as the tables of an experiment file; scales are in the parameter's unit."""

from __future__ import annotations

from typing import Any


def normal(scale: float, loc: float = 0.0) -> dict[str, Any]:
    """Normal prior of an effect of either sign."""
    return {"distribution": "Normal", "loc": loc, "scale": scale}


def half_normal(scale: float) -> dict[str, Any]:
    """Half-normal prior of an effect that cannot be negative."""
    return {"distribution": "HalfNormal", "scale": scale}


def log_normal(median: float, sigma: float) -> dict[str, Any]:
    """Log-normal prior of a time that is known to a factor of exp(sigma)."""
    return {"distribution": "LogNormal", "median": median, "sigma": sigma}
