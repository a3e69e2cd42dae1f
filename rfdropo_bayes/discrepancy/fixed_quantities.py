"""Parameters of a robot that a model fixes at nominal values, as candidates of an audit.

A parameter of the robot's own file that is not inferred, such as the zeros of all cables, may also explain a misfit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from rfdropo_bayes.bayes.inferred_parameter import InferredParameter
from rfdropo_bayes.bayes.scopes import Scopes
from rfdropo_bayes.discrepancy.candidates import Candidate
from rfdropo_bayes.simulators.parameters import ParameterSpec

ZEROS = "initial_displacement"  # of cables, see `Robot`
MEASURED = "offset_"  # of the frame: `camera_offset` is the library's name for it


@dataclass(eq=False)
class OwnParameter:
    """A robot's own parameters as a candidate, with the interface of a mechanism for records."""

    name: str
    parameters: tuple[ParameterSpec, ...]
    cause: str
    remedy: str
    stage: str = ""


def with_fixed_quantities(
    space: Scopes, simulated: Sequence[ParameterSpec], known: Sequence[str]
) -> tuple[Scopes, list[Candidate]]:
    """Parameters and candidates beyond the library's.

    Only quantities at several places are candidates: a single value (a damping) would be in the base model if it
    mattered.

    Args:
        space: base parameters, then the library's.
        simulated: every parameter of the base simulator.
        known: fixed parameters.
    """
    present = {*known, *(parameter.physical for parameter in space.parameters)}
    absent = [spec for spec in simulated if spec.name not in present and spec.prior]
    specs = [spec for spec in absent if not spec.name.startswith(MEASURED)]
    parameters, candidates = list(space.parameters), []
    for family in families(specs):
        first = len(parameters)
        for spec in family:
            parameters.append(InferredParameter.of(spec, {}, where="[audit]"))
        cause = f"{family[0].description}: not the nominal one"
        own = OwnParameter(stem(family), tuple(family), cause, _remedy(family))
        candidates.append(Candidate(own.name, tuple(range(first, len(parameters))), own, own.name))
    return replace(space, parameters=tuple(parameters)), candidates


def _remedy(family: Sequence[ParameterSpec]) -> str:
    """Remedy at the robot."""
    name = stem(family)
    if name == ZEROS:
        return (
            "send zero to all drives, and turn each until its cable just begins to move the body; set the drive's zero "
            "there, or infer initial_displacement in [model.priors]"
        )
    places = ", ".join(spec.name.removeprefix(f"{name}_").replace("_", " ") for spec in family)
    return f"measure the {name.replace('_', ' ')} at each place ({places}), and state it in [model.fixed]"


def families(specs: Sequence[ParameterSpec]) -> list[list[ParameterSpec]]:
    """Parameters that are one quantity at several places (the zeros of all cables), by the start of their names; or by
    their family, if a simulator has it.
    """
    alike: dict[str, list[ParameterSpec]] = {}
    for spec in specs:
        key = repr((spec.unit, spec.low, spec.high, sorted(spec.prior.items())))
        alike.setdefault(spec.family or key, []).append(spec)
    return [members for members in alike.values() if members[0].family or (len(members) > 1 and stem(members))]


def stem(specs: Sequence[ParameterSpec]) -> str:
    """Their family, or the common beginning of several parameters' names, in whole words."""
    if specs[0].family:
        return specs[0].family
    words = zip(*(spec.name.split("_") for spec in specs), strict=False)
    shared = []
    for first, *others in words:
        if any(other != first for other in others):
            break
        shared.append(first)
    return "_".join(shared)
