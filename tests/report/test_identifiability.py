"""Combinations that the data determine, from draws whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.bayes.inferred_parameter import InferredParameter
from rfdropo_bayes.bayes.scopes import build_scopes
from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, Scope
from rfdropo_bayes.report.identifiability import identify, product_in_words, spread_in_words
from rfdropo_bayes.report.summary import bound_reached, posterior_table
from rfdropo_bayes.simulators.parameters import ParameterSpec

LOG = {"distribution": "LogNormal"}


def record(posterior: dict[str, np.ndarray], prior: dict[str, np.ndarray], **tables: dict) -> PosteriorRecord:
    infos = tuple(ParameterInfo(name, "-", prior=tables.get(name, LOG)) for name in posterior)
    return PosteriorRecord(infos, {name: values[None] for name, values in posterior.items()}, prior)


def test_a_scale_ridge_is_named_with_its_ratio_and_its_scale() -> None:
    """Standard deviations known to 3 % from 4000 draws: failure rate under other seeds below 1e-3."""
    rng = np.random.default_rng(0)
    scale = 0.4 * rng.normal(size=4000)
    draws = {
        "young_modulus": 4.5e6 * np.exp(scale + 0.006 * rng.normal(size=4000)),
        "density": 1080 * np.exp(scale),
        "poisson_ratio": 0.45 * np.exp(0.01 * rng.normal(size=4000)),
    }
    prior = {name: np.exp(0.5 * rng.normal(size=4000)) for name in draws}
    found = identify(record(draws, prior))
    by_powers = {tuple(sorted(c.powers.items())): c for c in found}
    ratio = by_powers[("density", -1.0), ("young_modulus", 1.0)]
    assert ratio.verdict == "determined"
    assert ratio.sd == pytest.approx(0.006, rel=0.1)
    assert ratio.prior_sd == pytest.approx(0.5 * np.sqrt(2), rel=0.1)
    assert ratio.sentence.startswith("young_modulus / density is determined to ±0.6 % (prior a factor of 2")
    common = by_powers[("density", 1.0), ("young_modulus", 1.0)]
    assert common.verdict == "free"
    assert common.sentence.startswith("the common scale of young_modulus and density is left free by the data: ±40 %")
    assert (("poisson_ratio", 1.0),) in by_powers
    assert found[0] is ratio
    assert found[-1] is common


def test_three_parameters_on_one_ridge_are_reported_as_ratios() -> None:
    """Eigenvectors across the ridge would mix the two ratios at random; standard deviations known to 3 %."""
    rng = np.random.default_rng(6)
    scale = 0.4 * rng.normal(size=4000)
    widths = {"young_modulus": 0.0, "density": 0.006, "payload_mass": 0.008}
    draws = {name: np.exp(scale + width * rng.normal(size=4000)) for name, width in widths.items()}
    found = identify(record(draws, {name: np.exp(0.5 * rng.normal(size=4000)) for name in draws}))
    assert [c.verdict for c in found] == ["determined", "determined", "free"]
    assert set(found[2].powers.values()) == {1.0}
    assert found[2].sentence.startswith("the common scale of young_modulus, density and payload_mass is left free")
    for combination in found[:2]:
        assert sorted(combination.powers.values()) == [-1.0, 1.0]
        variance = sum(widths[name] ** 2 for name in combination.powers)
        assert combination.sd == pytest.approx(np.sqrt(variance), rel=0.1)


def test_a_parameter_that_may_be_zero_stands_by_itself() -> None:
    rng = np.random.default_rng(1)
    draws = {"damping": np.abs(0.002 * rng.normal(size=2000)), "tilt": 0.1 * rng.normal(size=2000)}
    prior = {"damping": np.abs(0.1 * rng.normal(size=2000)), "tilt": 0.1 * rng.normal(size=2000)}
    tables = {"damping": {"distribution": "HalfNormal"}, "tilt": {"distribution": "Normal"}}
    found = {next(iter(c.powers)): c for c in identify(record(draws, prior, **tables))}
    assert found["damping"].verdict == "determined"
    assert found["tilt"].verdict == "free"


def test_words() -> None:
    assert product_in_words({"a": 1.0, "b": -1.0}) == "a / b"
    assert product_in_words({"a": 1.0, "b": 0.5, "c": -1.0, "d": -2.0}) == "a \u00d7 b^0.5 / (c \u00d7 d^2)"
    assert product_in_words({"a": -1.0}) == "1 / a"
    assert spread_in_words(0.0079) == "±0.8 %"
    assert spread_in_words(0.0004) == "±0.04 %"
    assert spread_in_words(np.log(2.1)) == "a factor of 2.1 either way"


@pytest.mark.parametrize(
    ("draws", "expected"),
    [
        (lambda rng: np.abs(rng.normal(size=2000)), "low"),
        (lambda rng: rng.exponential(size=2000), "low"),
        (lambda rng: 100.0 - rng.exponential(size=2000), "high"),
        (lambda rng: rng.uniform(0.0, 100.0, 2000), None),
        (lambda rng: 5.0 + rng.normal(size=2000), None),
        (lambda rng: np.zeros(2000), "low"),
    ],
)
def test_piles_at_bounds_are_found_however_wide_the_bounds(draws, expected) -> None:
    """Quantiles from 2000 draws: failure rate under other seeds below 1e-2 for the half-normal, far lower elsewhere."""
    info = ParameterInfo("p", "-", 0.0, 100.0)
    assert bound_reached(draws(np.random.default_rng(2)), info) == expected


@pytest.mark.parametrize(
    ("prior", "ends"),
    [
        ({}, (-10.0, 10.0)),
        ({"distribution": "Uniform", "low": 2.0, "high": 7.0}, (2.0, 7.0)),
        ({"distribution": "HalfNormal", "scale": 1.0}, (0.0, 10.0)),
        ({"distribution": "Normal", "loc": 0.0, "scale": 1.0}, (-10.0, 10.0)),
    ],
)
def test_piles_are_looked_for_where_the_prior_ends(prior, ends) -> None:
    """As the warnings of the sampler have it, whose prior is a distribution instead of a table."""
    info = ParameterInfo("p", "-", -10.0, 10.0, prior)
    assert info.ends == ends
    near = np.random.default_rng(5).exponential(1e-2, 2000)
    assert bound_reached(ends[0] + near, info) == "low"
    assert bound_reached(ends[1] - near, info) == "high"
    if prior:
        spec = ParameterSpec("p", "-", -10.0, 10.0, 0.0, prior, "")
        np.testing.assert_allclose(build_scopes((spec,), {"p": prior}, {}, ["r"])["p"].ends, ends, rtol=1e-6)


def test_a_spread_of_nothing_is_no_bound() -> None:
    table, scope = {"distribution": "HalfNormal", "scale": 1.0}, Scope(spread=True)
    info = ParameterInfo("zero_spread", "m", 0.0, 10.0, table, scope=scope)
    assert bound_reached(np.random.default_rng(5).exponential(1e-2, 2000), info) is None
    spec = ParameterSpec("zero_spread", "m", 0.0, 10.0, 1.0, info.prior, "")
    assert InferredParameter.of(spec, {}, scope, where="").ends == info.ends


def test_logarithmic_parameters_are_compared_in_logarithms() -> None:
    rng = np.random.default_rng(3)
    info = ParameterInfo("p", "-", 1.0, 1e8, {"distribution": "LogUniform", "low": 1.0, "high": 1e8})
    assert bound_reached(10 ** rng.uniform(0.0, 8.0, 4000), info) is None
    assert bound_reached(np.exp(np.abs(rng.normal(size=4000))), info) == "low"
    assert bound_reached(4.5e6 * np.exp(0.1 * rng.normal(size=4000)), info) is None


def test_the_table_has_moments_quantiles_and_diagnostics() -> None:
    rng = np.random.default_rng(4)
    draws = rng.normal(5.0, 2.0, (4, 2500))
    rows = posterior_table(
        PosteriorRecord((ParameterInfo("p", "m"),), {"p": draws}, {"p": rng.normal(0.0, 20.0, 4000)})
    )
    assert rows[0].mean == pytest.approx(5.0, abs=0.1)
    assert rows[0].sd == pytest.approx(2.0, rel=0.05)
    assert rows[0].q05 == pytest.approx(5.0 - 1.645 * 2.0, abs=0.2)
    assert rows[0].contraction == pytest.approx(0.1, rel=0.1)
    assert rows[0].r_hat < 1.01
    assert not rows[0].at_bound
