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
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import actuation, body_mechanisms, sensing
from rfdropo_bayes.mechanisms.actuation import InCommandUnit
from rfdropo_bayes.mechanisms.sizes import normal, scales_of, sized
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.black_box import BlackBox
from rfdropo_bayes.simulators.mechanisms import Mechanism, MemorylessActuation, SteppedActuation, Values
from rfdropo_bayes.simulators.protocol import ParameterSpec, nearest

USUAL = 10.0  # [s] in which a size of its prior's scale comes about
RATE = "_rate"


class Drift:
    """Base of drifts. Sizes start at their null values.

    Args:
        own: the mechanism whose sizes drift, made for a robot.
    """

    kind: ClassVar[type]

    def __init__(self, own: Any = None) -> None:
        self.own: Any = self.kind() if own is None else own
        self.parameters = tuple(
            spec._replace(
                name=spec.name + RATE,
                unit="1/s" if spec.unit == "-" else f"{spec.unit}/s",
                low=spec.low - spec.nominal,
                high=spec.high - spec.nominal,
                nominal=0.0,
                prior={**spec.prior, "scale": spec.prior["scale"] / USUAL},
                description=f"rate of the {spec.description}",
            )
            for spec in self.own.parameters
        )

    @classmethod
    def for_robot(cls, robot: Robot) -> Any:
        """The drift with the parameters of the mechanism for a robot."""
        kind: Any = cls.kind
        return cls(kind.for_robot(robot) if hasattr(kind, "for_robot") else kind())

    def sizes(self, values: Values, elapsed: Float[Array, "*time"]) -> dict[str, Float[Array, "*time"]]:
        """Sizes so many seconds after the start, within their bounds."""
        # Not a clip, whose derivative at a bound, at which some sizes start, would be halved.
        sizes = {}
        for spec in self.own.parameters:
            size = spec.nominal + values[spec.name + RATE] * elapsed
            sizes[spec.name] = jnp.where(size < spec.low, spec.low, jnp.where(size > spec.high, spec.high, size))
        return sizes


class ActuationDrift(Drift, SteppedActuation):
    """Drift of a mechanism of actuation that depends on the present command."""

    stage = "actuation"
    inside_drive = False
    origin = "drives that warm up, or cables that stretch, slip or wind unevenly"
    remedy = "repeat each command at the start and at the end of a recording and compare the poses"

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> Int[Array, ""]:
        """Number of steps."""
        return jnp.zeros((), int)

    def advance(
        self, values: Values, memory: Int[Array, ""], given: Float[Array, " channel"], now: float
    ) -> tuple[Int[Array, ""], Float[Array, " channel"]]:
        """Apply the size of the moment."""
        return memory + 1, self.own.reach(self.sizes(values, now * (memory + 1)), given)


class SensingDrift(Drift):
    """Drift of a mechanism of sensing that depends on the present markers."""

    stage = "sensing"
    origin = "cameras or a base that move or warm up"
    remedy = "record two markers that are fixed to the base"

    def sense_over_time(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"]
    ) -> Float[Array, "time marker 3"]:
        """Apply the size of each row."""
        return jax.vmap(self._seen)(self.sizes(values, time - time[0]), position)

    def begin(self, values: Values, first: Float[Array, "marker 3"], interval: float) -> tuple[()]:
        """Nothing to remember."""
        return ()

    def advance(
        self, values: Values, memory: tuple[()], given: Float[Array, "marker 3"], now: Float[Array, ""]
    ) -> tuple[tuple[()], Float[Array, "marker 3"]]:
        """Apply the size of the moment."""
        return memory, self._seen(self.sizes(values, now), given)

    def _seen(self, sizes: Values, position: Float[Array, "marker 3"]) -> Float[Array, "marker 3"]:
        return self.own.sense(sizes, position[None])[0]


class DriveZero(InCommandUnit, MemorylessActuation):
    """The zero of all drives is shifted, of which a drift is made: the zeros of cables are parameters of a robot."""

    name = "drive_zero"
    in_metres = (ParameterSpec("drive_zero", "m", -0.1, 0.1, 0.0, normal(0.005), "shift of the zero of every drive"),)

    def reach(self, values: Values, sent: Float[Array, "*step channel"]) -> Float[Array, "*step channel"]:
        """Shift the commands."""
        return sent + values["drive_zero"]


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


def drift_of(kind: Any) -> type:
    """The mechanism ``<name>_drift``: the sizes of another mechanism change linearly in time.

    Args:
        kind: class of a mechanism that depends on the present command (`MemorylessActuation`), or on the present
            markers (a method ``sense``), and has no memory.
    """
    base: Any = ActuationDrift if issubclass(kind, MemorylessActuation) else SensingDrift
    return type(
        f"{kind.__name__}Drift",
        (base,),
        {
            "__doc__": f"`{kind.name}` changes at a steady rate from the start of the recording; no rate at null.",
            "__module__": __name__,
            "name": f"{kind.name}_drift",
            "kind": kind,
            "cause": f"{base.origin}: `{kind.name}` changes during the recording",
        },
    )
