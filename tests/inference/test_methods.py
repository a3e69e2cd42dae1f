"""The registry: every method by name, options that only it has."""

from __future__ import annotations

import tomllib

import jax
import pytest
import tomli_w

from rfdropo_bayes.cautions import Caution
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference import methods
from rfdropo_bayes.inference.method_options import options_table

from .toys import Decay, Spring

# Studies add methods of their own as soon as a test imports them.
OWN = [name for name, own in methods.METHODS.items() if own.config.__module__.startswith("rfdropo_bayes.")]


@pytest.mark.parametrize(
    ("method", "options", "words"),
    [
        ("smd", {}, "did you mean 'smc'"),
        ("smc", {"particels": 100}, "did you mean 'particles'"),
        ("smc", {"finalists": 5}, "unknown option 'finalists'"),
        ("smc", {"metod": "laplace"}, "did you mean 'method'"),
        ("rfdropo", {"rolouts": 100}, "did you mean 'rollouts'"),
        ("smc", {"particles": "many"}, "'many' does not fit: Input should be a valid integer"),
        ("smc", {"particles": True}, "True does not fit: Input should be a valid integer"),
        ("rfdropo", {"search": {"frequency": [1.0]}}, "does not fit"),
        ("rfdropo", {"parameters": "frequency"}, "does not fit"),
    ],
)
def test_a_wrong_option_is_named_with_what_was_meant(method, options, words):
    with pytest.raises(InputError, match=words):
        methods.make_config(method, options)


def test_options_come_as_toml_has_them():
    config = methods.make_config("rfdropo", {"rollouts": 20000, "parameters": ["a"], "search": {"a": [1, 2]}})
    assert config.rollouts == 20000.0
    assert config.parameters == ("a",)
    assert config.search == {"a": (1.0, 2.0)}
    assert methods.make_config("smc", {"rollouts": None}).rollouts is None


@pytest.mark.parametrize("method", OWN)
def test_options_of_every_method_are_written_as_toml_and_read_again(method):
    """Options may be None, which TOML has no word for."""
    config = methods.method_named(method).config()
    written = tomli_w.dumps(options_table(config))
    assert methods.make_config(method, tomllib.loads(written)) == config


def test_ranges_of_a_search_are_written_as_lists():
    ranges = methods.make_config("rfdropo", {"search": {"a": [1, 2]}})
    assert options_table(ranges)["search"] == {"a": [1.0, 2.0]}


@pytest.mark.parametrize("method", OWN)
def test_every_method_answers_in_the_same_form(method):
    problem = Spring() if method == "rfdropo" else Decay(n_rows=20)
    options = {
        "smc": {"particles": 100},
        "rfdropo": {"evaluations": 40, "rollouts_per_candidate": 10},
        "laplace": {"starts": 1, "blocks": 1},
    }.get(method, {})
    result = methods.run(problem, method, options, jax.random.key(0))
    assert result.method == method
    shapes = {draws.shape for draws in result.draws.values()}
    assert len(shapes) == 1
    assert len(shapes.pop()) == 2
    assert result.rollouts > 0
    assert result.evaluations > 0
    assert result.seconds > 0
    assert result.trace
    assert all(isinstance(caution, Caution) for caution in result.cautions)
