"""The methods an experiment file can name: for each a configuration that has only its own fields, and a function."""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jaxtyping import PRNGKeyArray
from pydantic import TypeAdapter, ValidationError

from rfdropo_bayes.bayes.problem import Problem, check_problem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.inference.modes import mode_search as laplace
from rfdropo_bayes.inference.progress import Logbook, Progress
from rfdropo_bayes.inference.result import InferenceResult
from rfdropo_bayes.inference.rfdropo import phi_search as rfdropo
from rfdropo_bayes.inference.smc import sampler
from rfdropo_bayes.inference.smc import start as starts
from rfdropo_bayes.tables import nearest, plain


class Method(NamedTuple):
    """One way of inference."""

    config: type[Any]  # its configuration, a frozen dataclass
    run: Callable[..., InferenceResult]  # ``run(problem, config, key, logbook) -> InferenceResult``
    posterior: bool = True  # its draws are of a posterior, and not of a distribution to randomise over


METHODS: dict[str, Method] = {
    "smc": Method(sampler.SmcConfig, starts.run),
    "rfdropo": Method(rfdropo.RfdropoConfig, rfdropo.run, posterior=False),
    "laplace": Method(laplace.LaplaceConfig, laplace.run),
}


def method_named(name: str) -> Method:
    """Method of a name.

    Raises:
        InputError: no such method; the nearest name is offered.
    """
    if name not in METHODS:
        raise InputError(f"unknown method {name!r}", where="[inference] method", remedy=nearest(name, METHODS))
    return METHODS[name]


def method_of(config: Any) -> str:
    """Name of the method that a configuration belongs to.

    Raises:
        InputError: no method has such a configuration.
    """
    for name, method in METHODS.items():
        if isinstance(config, method.config):
            return name
    known = ", ".join(f"rb.{method.config.called}()" for method in METHODS.values())
    raise InputError(f"{config!r} is not a method", where="method", remedy=f"give one of {known}")


def make_config(name: str, options: Mapping[str, Any]) -> Any:
    """Configuration of a method from a table of options, as an experiment file has them.

    Raises:
        InputError: an option that this method does not have (the nearest is offered), or of a wrong type.
    """
    kind, where = method_named(name).config, "[inference]"
    hints, names = typing.get_type_hints(kind), [field.name for field in dataclasses.fields(kind)]
    for option in options:
        if option not in names:
            raise InputError(f"unknown option {option!r}", where=where, remedy=nearest(option, [*names, "method"]))
    return kind(**{option: _checked(hints[option], value, f"{where} {option}") for option, value in options.items()})


def run(
    problem: Problem,
    name: str,
    options: Mapping[str, Any] | Any,
    key: PRNGKeyArray,
    *,
    checkpoint_dir: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> InferenceResult:
    """Run a method by name.

    Args:
        problem: problem to infer.
        name: name of the method.
        options: table of options, or the method's configuration itself.
        key: random key; the same key gives the same draws.
        checkpoint_dir: folder for checkpoints; None keeps none.
        resume: continue from the checkpoints of a run; a finished run is only read.
        progress: receives reports of stages.

    Raises:
        InputError: an unknown method or option, a problem without required members (`check_problem`), or an error of
        the method.
    """
    method = method_named(name)
    check_problem(problem)
    config = options if isinstance(options, method.config) else make_config(name, options)
    return method.run(problem, config, key, Logbook(checkpoint_dir, resume, progress))


def _checked(hint: Any, value: Any, where: str) -> Any:
    """Value of an option as its field wants it; TOML, as JSON, has lists for tuples and writes 20000 for 20000.0."""
    try:
        return TypeAdapter(hint).validate_json(json.dumps(plain(value)), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[-1]
        place = ".".join([where, *map(str, first["loc"])])
        raise InputError(f"{value!r} does not fit: {first['msg']}", where=place, remedy="correct the value") from None
