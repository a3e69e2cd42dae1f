"""Checks of whitened residuals: what they find, how much narrower intervals are, and what chance alone does."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.cautions import Code
from rfdropo_bayes.report.residuals import TOO_NARROW, check_residuals, residual_cautions

MARKERS = ("middle", "tip")


def series(seed: int, phi: float, rows: int = 400) -> np.ndarray:
    """Stationary first-order series of unit size, (time, marker, 3)."""
    rng = np.random.default_rng(seed)
    error = rng.normal(size=(rows, 2, 3))
    for row in range(1, rows):
        error[row] = phi * error[row - 1] + np.sqrt(1.0 - phi**2) * error[row]
    return error


@pytest.mark.parametrize("phi", [0.3, 0.6, 0.9])
def test_intervals_are_too_narrow_by_what_a_first_order_process_has_in_closed_form(phi):
    """Means over 40 seeds, whose scatter is 0.3 of the closed form or less for each seed."""
    found = [check_residuals([series(seed, phi)], MARKERS)["all"] for seed in range(40)]
    assert np.mean([check.correlation for check in found]) == pytest.approx(phi, abs=0.02)
    assert np.mean([check.narrowing for check in found]) == pytest.approx(np.sqrt((1 + phi) / (1 - phi)), rel=0.1)
    assert all(check.correlated for check in found)


def test_chance_is_not_taken_for_correlation_or_outliers():
    """Independent residuals, gaps included; 200 data sets and three checks each at a false-alarm rate of 1e-3, and of
    far less where an effect of a fifth is asked for as well."""
    said = 0
    for seed in range(200):
        white = series(seed, 0.0, rows=60)
        white[np.random.default_rng(seed).uniform(size=(60, 2)) < 0.2] = np.nan
        said += len(residual_cautions(check_residuals([white[:25], white[25:]], MARKERS), "white"))
    assert said <= 3


def test_cautions_name_the_marker_and_the_remedy():
    white = series(0, 0.0)
    white[:, 1] = series(1, 0.8)[:, 1]
    checks = check_residuals([white], MARKERS)
    assert checks["middle"].narrowing < TOO_NARROW < checks["tip"].narrowing
    (caution,) = residual_cautions(checks, "white")
    assert caution.code is Code.RESIDUALS_CORRELATED
    assert "(tip)" in caution.sentence
    assert 'noise = "auto"' in caution.sentence
    assert "audit" in residual_cautions(checks, "auto")[0].sentence


def test_outliers_are_named_with_a_remedy_unless_the_noise_has_tails():
    white = series(2, 0.0)
    white[np.random.default_rng(3).uniform(size=white.shape) < 0.01] *= 10.0
    checks = check_residuals([white], MARKERS)
    (caution,) = residual_cautions(checks, "white")
    assert caution.code is Code.RESIDUALS_HEAVY
    assert 'noise = "student-t"' in caution.sentence
    assert residual_cautions(checks, "student-t") == []


def test_without_residuals_there_is_nothing_to_say():
    nothing = check_residuals([np.full((5, 2, 3), np.nan)], MARKERS)
    assert residual_cautions(nothing, "white") == []
    assert nothing["all"].values == 0
