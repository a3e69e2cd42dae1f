"""After a few mechanisms a further mechanism joins if it takes a significant share of the misfit away."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rfdropo_bayes.discrepancy.extension import ExtensionSearch, Rules


def search(known: object = None) -> ExtensionSearch:
    target: Any = SimpleNamespace(known=known)
    return ExtensionSearch(target, (), Rules(), 0)


def fit(square: float) -> Any:
    """A fit of 100 values whose squared residuals, in variances of the noise, are ``square`` each."""
    return SimpleNamespace(residual=np.full(100, np.sqrt(square)))


@pytest.mark.parametrize(("left", "joins"), [(1.5, True), (1.75, True), (1.85, False), (1.99, False)])
def test_the_fourth_takes_a_fifth_of_the_misfit(left, joins):
    assert search().worthwhile(fit(2.0), fit(left), 4) is joins


def test_the_first_three_and_causes_of_a_misspecified_model_join_by_evidence_alone():
    assert search().worthwhile(fit(2.0), fit(1.99), 3)
    assert search(known=object()).worthwhile(fit(2.0), fit(1.99), 6)


def test_noise_leaves_nothing_to_take():
    assert not search().worthwhile(fit(0.9), fit(0.5), 4)
