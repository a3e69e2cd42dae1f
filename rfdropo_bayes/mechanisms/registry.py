"""All mechanisms by name. To add a mechanism, write a class in the module of its stage.

A mechanism may also be defined in a user's code: ``"package.module:ClassName"``, or ``"file.py:ClassName"`` beside the
experiment file, replaces a registry name; see docs/mechanisms.md.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import actuation, body_mechanisms, sensing
from rfdropo_bayes.mechanisms.drift import Drift, DriveZero, drift_of
from rfdropo_bayes.mechanisms.sizes import scales_of, sized
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.black_box import BlackBox
from rfdropo_bayes.simulators.mechanisms import Mechanism
from rfdropo_bayes.tables import nearest

MODULES = (actuation, body_mechanisms, sensing)
DRIFTING = (
    DriveZero,
    actuation.CommandGain,
    actuation.CableGain,
    actuation.CableSlack,
    sensing.CameraOffset,
    sensing.CameraRotation,
    sensing.CameraScale,
)
"""Mechanisms whose sizes may drift, see `drift_of`."""


def defined_in(module: ModuleType) -> list[Any]:
    """The mechanisms that a module defines, in its order: its classes with a cause."""
    own = (kind for kind in vars(module).values() if isinstance(kind, type) and kind.__module__ == module.__name__)
    return [kind for kind in own if hasattr(kind, "cause")]


KINDS = (*(kind for module in MODULES for kind in defined_in(module)), *map(drift_of, DRIFTING))
REGISTRY: dict[str, type] = {kind.name: kind for kind in KINDS}
ACTS = {"actuation": ("actuate",), "body": ("embody",), "contact": ("embody",), "sensing": ("sense", "sense_over_time")}
"""By which method a mechanism of each stage acts."""


def mechanisms_named(
    names: Iterable[Any],
    robot: Robot | BlackBox | None = None,
    *,
    folder: Path = Path(),
    where: str = "[model] mechanisms",
) -> tuple[Mechanism, ...]:
    """The mechanisms of an experiment file, in its order, made for a robot."""
    return tuple(choice.made_for(robot) for choice in choose_mechanisms(names, folder=folder, where=where))


@dataclass(frozen=True)
class MechanismChoice:
    """A mechanism of a model, which is yet to be made for its robot.

    Attributes:
        source: name under which a file would ask for it.
        kind: class of the mechanism, or the mechanism itself.
    """

    source: str
    kind: Any

    def made_for(self, robot: Robot | BlackBox | None) -> Mechanism:
        """The mechanism; a class with parameters per cable (a class method ``for_robot``) is made for the robot, and
        mechanisms of the library have its sizes."""
        if not isinstance(self.kind, type):
            return self.kind
        kind: Any = self.kind
        made = kind.for_robot(robot) if robot is not None and hasattr(kind, "for_robot") else kind()
        if isinstance(robot, Robot) and made.stage != "actuation" and REGISTRY.get(kind.name) is kind:
            scales = scales_of(robot)
            made.parameters = tuple(sized(spec, scales) for spec in made.parameters)
            if isinstance(made, Drift):
                made.own.parameters = tuple(sized(spec, scales) for spec in made.own.parameters)
        return made


def choose_mechanisms(
    names: Iterable[Any], *, folder: Path = Path(), where: str = "[model] mechanisms"
) -> tuple[MechanismChoice, ...]:
    """The named mechanisms.

    Args:
        names: names in the registry, ``module:ClassName`` of user code, or mechanisms as classes or objects.
        folder: base folder of user files.
        where: location of the names, for messages.

    Raises:
        InputError: an unknown name, or a module or class that cannot be imported or does not define a mechanism.
    """
    chosen = []
    for name in names:
        kind = name
        if isinstance(name, str):
            kind = _imported(name, folder, where) if ":" in name else REGISTRY.get(name)
            if kind is None:
                raise InputError(f"unknown mechanism {name!r}", where=where, remedy=nearest(name, REGISTRY))
        else:
            _check_kind(name if isinstance(name, type) else type(name), str(getattr(name, "name", name)), where)
        chosen.append(MechanismChoice(source_of(name), kind))
    return tuple(chosen)


def source_of(mechanism: Any) -> str:
    """Name of a mechanism in a file: a name of the library, or ``module:ClassName``."""
    if isinstance(mechanism, str):
        return mechanism
    kind = mechanism if isinstance(mechanism, type) else type(mechanism)
    name = str(getattr(kind, "name", ""))  # a user's class without a name is refused where it is made
    return name if REGISTRY.get(name) is kind else f"{kind.__module__}:{kind.__qualname__}"


def _imported(name: str, folder: Path, where: str) -> Any:
    """The class named by ``module:ClassName`` or ``file.py:ClassName``."""
    source, _, attribute = name.rpartition(":")
    try:
        if source.endswith(".py"):
            path = Path(folder).resolve() / source
            # A file of any name, which must not stand for an installed module of that name.
            own = f"rfdropo_mechanism_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
            spec = importlib.util.spec_from_file_location(own, path)
            assert spec is not None
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            # As an import does it: dataclasses look their module up while they are made.
            sys.modules[spec.name] = module
            spec.loader.exec_module(module)
        else:
            module = importlib.import_module(source)
        kind = getattr(module, attribute)
    except Exception as error:  # whatever a user's code raises
        raise InputError(
            f"cannot import the mechanism {name!r} ({type(error).__name__}: {error})",
            where=where,
            remedy="give module:ClassName of an installed module, or file.py:ClassName beside the experiment file",
        ) from None
    _check_kind(kind, name, where)
    return kind


def _check_kind(kind: Any, name: str, where: str) -> None:
    """Raise InputError if a user's class lacks a required member of a mechanism, or has the name of another."""
    lacking = [key for key in ("name", "stage", "cause", "remedy") if not hasattr(kind, key)]
    # A class that is made for a robot may have its parameters only then.
    if not hasattr(kind, "for_robot") and not hasattr(kind, "parameters"):
        lacking.append("parameters")
    if lacking:
        raise InputError(
            f"{name!r} is not a mechanism: it lacks {', '.join(lacking)}", where=where, remedy="see docs/mechanisms.md"
        )
    if kind.stage in ACTS and not any(hasattr(kind, method) for method in ACTS[kind.stage]):
        raise InputError(
            f"{name!r} has stage {kind.stage!r}, but no method {' or '.join(ACTS[kind.stage])}",
            where=where,
            remedy="write the method, or give the stage at which it acts",
        )
    if REGISTRY.get(kind.name, kind) is not kind:
        raise InputError(
            f"{name!r} has the name of a mechanism of the library, {kind.name!r}",
            where=where,
            remedy="give it a name of its own",
        )
