"""The parameter space: names, transforms with their Jacobians, parameters of single recordings."""

from __future__ import annotations

import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rfdropo_bayes
from rfdropo_bayes.bayes.inferred_parameter import Pooled
from rfdropo_bayes.bayes.scopes import Scopes, build_scopes
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.groups import gather_groups, group_of, in_group
from rfdropo_bayes.posteriors import ParameterInfo
from rfdropo_bayes.simulators.parameters import ParameterSpec

SPECS = (
    ParameterSpec(
        "young_modulus", "Pa", 1e6, 5e7, 4.5e6, {"distribution": "LogNormal", "median": 4e6, "sigma": 0.5}, ""
    ),
    ParameterSpec("poisson_ratio", "-", 0.1, 0.499, 0.45, {"distribution": "Uniform", "low": 0.3, "high": 0.499}, ""),
    ParameterSpec("offset_x", "m", -0.1, 0.1, 0.0, {"distribution": "Normal", "loc": 0.0, "scale": 0.01}, ""),
)

DRAWS = 4000
"""One number for all tests: JAX compiles its random numbers for each shape."""


def space():
    return build_scopes(
        SPECS, {"young_modulus": {}, "poisson_ratio": {}, "offset_x": {}}, {"offset_x": ["a", "b"]}, ["a", "b", "c"]
    )


def test_a_parameter_of_single_recordings_is_free_there_and_absent_elsewhere():
    values = space().sample(jax.random.key(0), DRAWS)
    assert set(values) == {"young_modulus", "poisson_ratio", "offset_x@a", "offset_x@b"}
    np.testing.assert_array_equal(space().values_in("b", values)["offset_x"], values["offset_x@b"])
    assert space().values_in("c", values)["offset_x"] == 0.0  # the nominal one


@pytest.mark.parametrize(
    ("prior", "ends"),
    [
        ({"distribution": "Uniform", "low": 2e6, "high": 7e6}, (2e6, 7e6)),
        ({"distribution": "LogUniform", "low": 2e6, "high": 7e6}, (2e6, 7e6)),
        ({"distribution": "LogNormal", "median": 4e6, "sigma": 0.5}, (1e6, 5e7)),
        ({"distribution": "Normal", "loc": 4e6, "scale": 1e6}, (1e6, 5e7)),
        ({"distribution": "HalfNormal", "scale": 8e6}, (1e6, 5e7)),
    ],
)
def test_a_prior_ends_where_it_says_or_at_the_hard_bounds(prior, ends):
    parameter = build_scopes(SPECS, {"young_modulus": prior}, {}, ["a"])["young_modulus"]
    np.testing.assert_allclose(parameter.ends, ends, rtol=1e-6)
    drawn = parameter.prior.sample(jax.random.key(2), (DRAWS,))
    assert np.all((drawn >= ends[0]) & (drawn <= ends[1]))


@pytest.mark.parametrize(
    ("bounds", "prior", "ends"),
    [
        ((-np.inf, np.inf), {"distribution": "Normal", "loc": 0.0, "scale": 1.0}, (-np.inf, np.inf)),
        ((0.5, np.inf), {"distribution": "LogNormal", "median": 1.0, "sigma": 0.5}, (0.5, np.inf)),
        ((-1.0, 5.0), {"distribution": "HalfNormal", "scale": 1.0}, (0.0, 5.0)),
    ],
)
def test_a_prior_without_ends_or_with_one_has_no_more(bounds, prior, ends):
    spec = ParameterSpec("p", "-", *bounds, 1.0, prior, "")
    assert build_scopes((spec,), {"p": prior}, {}, ["a"])["p"].ends == ends


def test_the_unconstrained_map_is_a_bijection_and_its_density_carries_the_jacobian():
    chosen = space()
    values = chosen.sample(jax.random.key(1), DRAWS)
    u = chosen.to_unconstrained(values)
    back = chosen.from_unconstrained(u)
    for name in chosen.names:
        np.testing.assert_allclose(back[name], values[name], rtol=1e-10)
    # Density in u = density in physical units times |dx/du|, the latter by automatic differentiation.
    whole = jax.jit(
        jax.vmap(jax.jacfwd(lambda row: jnp.stack([chosen.from_unconstrained(row)[n] for n in chosen.names])))
    )
    slope = whole(u)
    expected = chosen.log_prior(values) + jnp.linalg.slogdet(slope)[1]
    np.testing.assert_allclose(chosen.log_prior_unconstrained(u), expected, rtol=1e-9)


@pytest.mark.slow
def test_draws_around_an_earlier_posterior_keep_its_rows_together_and_stay_inside():
    """What it lacks, and what lies outside the support, comes from the prior; one value for all serves every one."""
    modulus = np.array([2e6, 3e6, 1e6, 9e9])  # the third on the bound, the fourth beyond it
    earlier = {"young_modulus": {"": modulus}, "offset_x": {"": 1e-9 * modulus, "b": np.full(4, 0.02)}}
    values = space().sample_around(earlier, jax.random.key(3), 200)
    assert np.isfinite(space().to_unconstrained(values)).all()
    inside = np.isin(np.round(values["young_modulus"], 3), modulus)
    np.testing.assert_allclose(values["offset_x@a"][inside], 1e-9 * values["young_modulus"][inside], rtol=1e-9)
    assert np.isin([2e6, 3e6], np.round(values["young_modulus"], 3)).all()
    assert np.max(values["young_modulus"]) < 5e7
    np.testing.assert_allclose(values["offset_x@b"], 0.02, rtol=1e-12)
    assert len(np.unique(values["poisson_ratio"])) == 200
    other = space().sample_around({"offset_x": {"elsewhere": np.full(4, 0.03)}}, jax.random.key(3), 5)
    np.testing.assert_allclose(other["offset_x@a"], 0.03, rtol=1e-12)


@pytest.mark.parametrize(
    ("priors", "scopes", "message"),
    [
        ({"young_modulos": {}}, {}, "did you mean 'young_modulus'"),
        ({}, {}, "no parameter has a prior"),
        ({"offset_x": {}}, {"offset_x": ["d"]}, "no recording is called 'd'"),
        ({"poisson_ratio": {"distribution": "Uniform", "low": 0.4, "high": 0.6}}, {}, "outside the bounds"),
    ],
)
def test_what_cannot_be_inferred_is_refused(priors, scopes, message):
    with pytest.raises(InputError, match=message):
        build_scopes(SPECS, priors, scopes, ["a", "b", "c"])


DAYS = {"january": ["a*"], "april": "b"}


def pooled_space(recordings=("a1", "a2", "b", "c")):
    pooled = {"offset_x": Pooled(0.002, gather_groups(recordings, DAYS))}
    return build_scopes(SPECS, {"young_modulus": {}, "offset_x": {}}, {}, list(recordings), pooled=pooled)


def test_groups_of_recordings_deviate_from_what_all_share():
    """Recordings of one day have one value, one without a group its own; their spread is the one that was given."""
    chosen = pooled_space()
    deviations = {f"offset_x_deviation@{group}" for group in ("january", "april", "c")}
    assert set(chosen.names) == {"young_modulus", "offset_x", *deviations}
    values = chosen.sample(jax.random.key(0), DRAWS)
    own = {r: chosen.values_in(r, values)["offset_x"] for r in ("a1", "a2", "b", "c")}
    np.testing.assert_array_equal(own["a1"], own["a2"])
    np.testing.assert_allclose(own["b"] - own["a1"], sum_of(values, "april") - sum_of(values, "january"), atol=1e-15)
    assert np.std(own["c"] - values["offset_x"]) == pytest.approx(0.002, rel=0.06)  # 5 standard errors
    back = chosen.from_unconstrained(chosen.to_unconstrained(values))
    np.testing.assert_allclose(back["offset_x_deviation@april"], values["offset_x_deviation@april"], rtol=1e-10)


def sum_of(values, group):
    return values["offset_x"] + values[f"offset_x_deviation@{group}"]


def test_an_optimisation_starts_from_a_group_s_own_deviation_and_from_no_other_s():
    earlier = {"offset_x": {"": np.full(3, 0.01)}, "offset_x_deviation": {"january": np.full(3, 0.001)}}
    values = pooled_space().sample_around(earlier, jax.random.key(1), DRAWS)
    np.testing.assert_allclose(values["offset_x_deviation@january"], 0.001, rtol=1e-12)
    assert len(np.unique(values["offset_x_deviation@april"])) == DRAWS


def test_the_first_draw_around_an_earlier_posterior_is_its_first():
    earlier = {"young_modulus": {"": np.linspace(1.1e6, 2e6, 30)}, "offset_x": {"": np.linspace(0.001, 0.01, 30)}}
    for seed in range(3):
        values = pooled_space().sample_around(earlier, jax.random.key(seed), DRAWS)
        np.testing.assert_allclose(values["young_modulus"][0], 1.1e6)
        assert values["offset_x"][0] == pytest.approx(0.001)
        assert len(np.unique(values["young_modulus"])) > 1


def test_a_group_that_names_a_recording_comes_before_wildcards():
    assert group_of("a1", {**DAYS, "winter": "a1"}) == "winter"
    assert group_of("a1[0:45]", {**DAYS, "winter": ["a1", "b"]}) == "winter"
    assert group_of("a2", {**DAYS, "winter": "a1"}) == "january"
    assert group_of("a1[0:45]", {**DAYS, "winter": "a1[0:45]"}) == "winter"  # a piece names its recording
    named = {"first": "run [1]", "others": "run*"}  # brackets in the name of a recording are its own
    assert [group_of(name, named) for name in ("run [1]", "run [1][0:45]", "run [2]")] == ["first", "first", "others"]
    assert group_of("run [2][0:45][3:9]", {}) == "run [2]"


def test_a_recording_is_moved_to_a_group_from_the_one_that_named_it():
    moved = in_group("a1[0:9]", "today", {**DAYS, "winter": ["a1[5:7]", "b"], "spring": "a1"})
    assert moved == {"january": ["a*"], "april": ["b"], "winter": ["b"], "today": ["a1"]}
    assert group_of("a1", moved) == "today"


def test_what_cannot_be_pooled_is_refused():
    with pytest.raises(InputError, match="a1 is in two groups: january and winter"):
        gather_groups(["a1"], {**DAYS, "winter": "*1"})
    with pytest.raises(InputError, match=r"about a shared value.*also name it under \[model.priors\]"):
        build_scopes(SPECS, {"young_modulus": {}}, {}, ["b"], pooled={"offset_x": Pooled(0.1, {"april": ("b",)})})
    with pytest.raises(InputError, match="the spread between groups is 0"):
        build_scopes(SPECS, {"offset_x": {}}, {}, ["b"], pooled={"offset_x": Pooled(0.0, {"april": ("b",)})})


def hierarchical(known=None):
    """Three groups' offsets about a shared one, their spread inferred, or known."""
    pooled = {"offset_x": Pooled(0.002, gather_groups(("a1", "b", "c"), DAYS), "offset")}
    space = build_scopes(SPECS, {"offset_x": {}}, {}, ["a1", "b", "c"], pooled=pooled)
    return space if known is None else space.holding({"offset_spread": known})


def test_a_spread_between_groups_that_is_inferred_is_that_of_the_deviations():
    """Deviations have the spread of their draw; the map to the real line is a bijection whose density carries the
    Jacobian; held at a value, the space is that of a known spread."""
    space = hierarchical()
    assert space.scales == {"offset_spread": tuple(f"offset_x_deviation@{g}" for g in ("january", "april", "c"))}
    values = space.sample(jax.random.key(0), DRAWS)
    ratio = values["offset_x_deviation@april"] / values["offset_spread"]
    assert np.std(ratio) == pytest.approx(1.0, rel=0.06)  # 5 standard errors
    assert np.std(values["offset_spread"]) == pytest.approx(0.002 * np.sqrt(1 - 2 / np.pi), rel=0.08)
    u = space.to_unconstrained(values)
    back = space.from_unconstrained(u)["offset_x_deviation@c"]
    np.testing.assert_allclose(back, values["offset_x_deviation@c"], rtol=1e-7, atol=1e-15)
    whole = jax.jit(
        jax.vmap(jax.jacfwd(lambda row: jnp.stack([space.from_unconstrained(row)[n] for n in space.names])))
    )
    slope = whole(u)
    expected = space.log_prior(values) + jnp.linalg.slogdet(slope)[1]
    np.testing.assert_allclose(space.log_prior_unconstrained(u), expected, rtol=1e-9)
    held = hierarchical(0.001)
    assert "offset_spread" not in held.names
    assert held["offset_x_deviation@c"].prior.scale == 0.001


def every_kind():
    """A shared parameter, one of each recording, one of one group alone, and one that is pooled."""
    size = ParameterSpec("size", "-", 0.0, 9.0, 0.5, {"distribution": "HalfNormal", "scale": 1.0}, "")
    recordings = ("a1", "b", "c")
    pooled = {"offset_x": Pooled(0.002, gather_groups(recordings, DAYS), "offset")}
    priors = {"young_modulus": {}, "poisson_ratio": {}, "offset_x": {}, "size": {}}
    alone, only_in = {"poisson_ratio": ["a1", "b"]}, {"size": {"april": ("b",)}}
    return build_scopes((*SPECS, size), priors, alone, recordings, pooled=pooled, only_in=only_in)


def test_a_posterior_says_whose_each_parameter_is():
    """Read back from its record, the parameters hold where they held: a group's in new recordings of the group."""
    chosen = every_kind()
    infos = [ParameterInfo.from_dict(json.loads(json.dumps(info.as_dict()))) for info in chosen.infos]
    back = Scopes.read(infos, tuple(chosen.specs.values()), {})
    assert back.names == chosen.names
    values = {name: float(k) for k, name in enumerate(chosen.names, 1)}
    new = back.extended(["a1[3:9]", "b2", "d"], ["a1", "b", "c"], {**DAYS, "april": "b*"})
    assert new.like["size@april"] == ("size@april",)
    assert new.like["poisson_ratio@a1[3:9]"] == ("poisson_ratio@a1",)
    assert new.like["offset_x_deviation@d"] == ()
    assert "poisson_ratio@d" not in new.scopes.names  # two of three fitted recordings had one
    given = values | {"poisson_ratio@a1[3:9]": 0.3, "offset_x_deviation@d": 0.01}
    piece, april, other = (new.scopes.values_in(name, given) for name in ("a1[3:9]", "b2", "d"))
    assert (piece["poisson_ratio"], piece["size"], other["poisson_ratio"]) == (0.3, 0.5, 0.45)
    assert (april["size"], other["size"]) == (values["size@april"], 0.5)


def test_what_is_held_acts_where_it_did():
    chosen = every_kind()
    values = {name: float(column[0]) for name, column in chosen.sample(jax.random.key(0), DRAWS).items()}
    held = {name: values[name] for name in ("offset_x_deviation@january", "poisson_ratio@b", "young_modulus")}
    rest = {name: value for name, value in values.items() if name not in held}
    for recording in ("a1", "b", "c"):
        assert chosen.holding(held).values_in(recording, rest) == chosen.values_in(recording, values)


def test_a_parameter_that_the_model_lacks_is_refused():
    with pytest.raises(InputError, match="holds 'size', which the experiment's model lacks"):
        Scopes.read(every_kind().infos, SPECS, {})


def test_no_label_is_taken_apart():
    """The structure of parameters is in `Scope`; text that knows the sign is text for people."""
    package = Path(rfdropo_bayes.__file__).parent
    found = {
        p.name
        for p in package.rglob("*.py")
        if re.search(r"""(split|partition|in)\W{1,2}["']@["']""", p.read_text("utf-8"))
    }
    assert found == set()
