"""All mechanisms by name. To add one: write its class in the module of its stage, and one line here."""

from __future__ import annotations

from collections.abc import Iterable

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms.actuation import ActuatorLag, CommandDelay, CommandGain
from rfdropo_bayes.mechanisms.body import BaseTilt, Payload, StiffnessGradient
from rfdropo_bayes.mechanisms.friction import CableCompliance, CapstanFriction, CoulombFriction
from rfdropo_bayes.mechanisms.material_laws import (
    BendingStiffening,
    BendTwistCoupling,
    PlaneAnisotropy,
    Softening,
    ViscoelasticBranch,
)
from rfdropo_bayes.mechanisms.sensing import CameraRotation, CameraScale
from rfdropo_bayes.mechanisms.surroundings import QuadraticDrag, WallContact
from rfdropo_bayes.simulators.mechanisms import Mechanism
from rfdropo_bayes.simulators.parameters import nearest

REGISTRY: dict[str, type] = {
    mechanism.name: mechanism
    for mechanism in (
        CommandDelay,
        ActuatorLag,
        CommandGain,
        Payload,
        StiffnessGradient,
        BaseTilt,
        CoulombFriction,
        CapstanFriction,
        CableCompliance,
        ViscoelasticBranch,
        BendingStiffening,
        PlaneAnisotropy,
        BendTwistCoupling,
        Softening,
        QuadraticDrag,
        WallContact,
        CameraRotation,
        CameraScale,
    )
}


def mechanisms_named(names: Iterable[str], *, where: str = "[model] mechanisms") -> tuple[Mechanism, ...]:
    """The mechanisms of an experiment file, in its order; InputError for an unknown name."""
    chosen = []
    for name in names:
        if name not in REGISTRY:
            raise InputError(f"unknown mechanism {name!r}", where=where, remedy=nearest(name, REGISTRY))
        chosen.append(REGISTRY[name]())
    return tuple(chosen)
