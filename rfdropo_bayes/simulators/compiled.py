"""The compiled engine behind JAX: one call out of a traced program for a whole batch of rollouts."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.fem import BendingLaw, BodyEffects, Material, PointMap, Viscoelasticity, Wall
from rfdropo_bayes.fem.native.effect_rows import COMPILED_EFFECTS
from rfdropo_bayes.fem.native.layered import NativeLayered, NativeRollout
from rfdropo_bayes.fem.native.layered_session import LayeredSession
from rfdropo_bayes.simulators.differences import (
    ACCELERATION,
    LENGTH,
    MASS,
    MASS_DAMPING,
    STIFFNESS_DAMPING,
    incompressibility_margin,
    with_differences,
)
from rfdropo_bayes.simulators.reference import ReferenceEngine
from rfdropo_bayes.simulators.session import LaneMotion
from rfdropo_bayes.simulators.trunk import Assembly, Motion

Inputs = tuple[Material, Float[Array, " cable"], Float[Array, "step cable"]]

EFFECT_SIZES = BodyEffects(
    bending=BendingLaw(0.2, 0.2, 0.1, 0.1, 0.1),
    viscoelasticity=Viscoelasticity(0.3, 0.3),
    softening_rate=0.01,
    drag=100.0,
    wall=Wall(1e3, 0.01, 0.1),
    cable_compliance=1e-4,
    coulomb_friction=0.05,
    capstan_friction=0.1,
)
"""Sizes of effects, whose null values are zero; units as in ``BodyEffects``."""


def effects_lacking(effects: BodyEffects) -> tuple[str, ...]:
    """Names of the effects that are present and that the compiled engine does not know: with any of them, rollouts run
    on the reference engine."""
    given = (name for name, value in effects._asdict().items() if value is not None)
    return tuple(name for name in given if name not in COMPILED_EFFECTS)


def effects_costly(effects: BodyEffects) -> bool:
    """Whether an effect is present that slows every rollout down, even at its null value: one that the compiled engine
    lacks, or friction, which solves for stick and slip in every step."""
    friction = (effects.coulomb_friction, effects.capstan_friction)
    return bool(effects_lacking(effects)) or any(value is not None for value in friction)


@cache
def _say_once(lacking: tuple[str, ...]) -> None:
    names = ", ".join(name.replace("_", " ") for name in lacking)
    logging.getLogger(__name__).warning("rollouts with %s run on the JAX engine, which is slower", names)


def input_sizes(inputs: Inputs) -> Inputs:
    """Sizes that perturbations of the inputs are relative to."""
    material, start, displacement = inputs
    effects = [
        None if value is None else jax.tree.map(jnp.asarray, size)
        for value, size in zip(material.effects, EFFECT_SIZES, strict=True)
    ]
    magnitudes = jax.tree.map(lambda value: jnp.abs(value) + 1e-12, material)._replace(
        poisson_ratio=incompressibility_margin(material.poisson_ratio),
        gravity=jnp.full_like(material.gravity, ACCELERATION),
        point_mass=jnp.full_like(material.point_mass, MASS),
        rayleigh_mass=jnp.abs(material.rayleigh_mass) + MASS_DAMPING,
        rayleigh_stiffness=jnp.abs(material.rayleigh_stiffness) + STIFFNESS_DAMPING,
        effects=BodyEffects(*effects),
    )
    return magnitudes, jnp.full_like(start, LENGTH), jnp.full_like(displacement, LENGTH)


@dataclass(frozen=True)
class CompiledEngine:
    """The Numba engine: SIMD lanes and threads over the batch; the same numbers as the reference engine.

    Attributes:
        assembly: the discretised robot.
        time_step: of the simulation [s].
        from_equilibrium: start in the static equilibrium of the initial displacements, else undeformed.
        precision: of all arithmetic.
        threads: None for all processors.
        one_sided, difference: how derivatives are taken, see `with_differences`.
    """

    assembly: Assembly
    time_step: float
    from_equilibrium: bool
    precision: Literal["float64", "float32"] = "float64"
    threads: int | None = None
    one_sided: bool = False
    difference: float | None = None
    lanes: ClassVar[int] = 512

    @cached_property
    def _native(self) -> NativeLayered:
        return NativeLayered(
            self.assembly.system,
            self.assembly.markers,
            self.time_step,
            precision=self.precision,
            threads=self.threads,
        )

    def describe(self) -> dict[str, object]:
        """Name and precision."""
        return {"engine": "numba", "precision": self.precision, "device": "cpu"}

    def recording(self, points: PointMap) -> CompiledEngine:
        """See `Engine.recording`."""
        return replace(self, assembly=self.assembly._replace(markers=points), precision="float64")

    def body_lanes(self, count: int) -> CompiledLanes:
        """See `Engine.body_lanes`."""
        return CompiledLanes(LayeredSession(self._native, count), self.from_equilibrium)

    def motion(
        self,
        material: Material,
        start: Float[Array, " cable"],
        displacement: Float[Array, "step cable"],
        steps: Int[Array, ""] | None,
    ) -> Motion:
        """See `Engine.motion`.

        Derivatives are differences along each tangent, two rollouts per direction or one. With effects of the body
        that this engine does not know, the reference engine computes rollouts and derivatives.
        """
        lacking = effects_lacking(material.effects)
        if lacking:
            _say_once(lacking)
            return ReferenceEngine(self.assembly, self.time_step, self.from_equilibrium).motion(
                material, start, displacement, steps
            )
        limit = jnp.asarray(displacement.shape[0] if steps is None else steps, jnp.float64)
        return self._differentiable((material, start, displacement), limit)

    @cached_property
    def _differentiable(self) -> Callable[[Inputs, Array], Motion]:
        return with_differences(self._call, input_sizes, self.precision, self.one_sided, self.difference)

    def _call(self, inputs: Inputs, limit: Array) -> Motion:
        material, start, displacement = inputs
        rows, cables = displacement.shape[0] + 1, displacement.shape[1]
        shapes = Motion(
            jax.ShapeDtypeStruct((rows, len(self.assembly.markers.node), 3), jnp.float64),
            jax.ShapeDtypeStruct((rows, cables), jnp.float64),
            jax.ShapeDtypeStruct((), jnp.bool_),
            jax.ShapeDtypeStruct((), jnp.float64),
            jax.ShapeDtypeStruct((), jnp.bool_),
        )
        return jax.pure_callback(
            self._on_host, shapes, material, start, displacement, limit, vmap_method="broadcast_all"
        )

    def _on_host(self, material: Material, start: Array, displacement: Array, limit: Array) -> Motion:
        """Flatten whatever batch axes vmap has added, roll out what differs, and restore them."""
        batch = displacement.shape[:-2]
        count = int(np.prod(batch))
        given = jax.tree.map(
            lambda value: flattened(np.asarray(value), len(batch), count), (material, start, displacement)
        )
        # Padding of a batch, and perturbations of what acts after the body, ask for the same rollout again and again.
        chosen, place = distinct(jax.tree.leaves(given))
        body, first, commands = jax.tree.map(lambda value: value[chosen], given)
        found = self._native.rollout(
            body, commands, start=first if self.from_equilibrium else None, steps=int(np.max(limit))
        )
        if len(chosen) < count:
            found = type(found)(*(part[place] for part in found))
        rows = displacement.shape[-2] + 1
        return Motion(
            padded(found.position, rows).reshape(*batch, rows, -1, 3),
            padded(found.tension, rows).reshape(*batch, rows, displacement.shape[-1]),
            found.diverged.reshape(batch),
            found.residual.reshape(batch),
            found.cables_converged.reshape(batch),
        )


class CompiledLanes:
    """Bodies of a session in the compiled engine: see `BodyLanes`."""

    def __init__(self, session: LayeredSession, from_equilibrium: bool) -> None:
        self._session, self._from_equilibrium = session, from_equilibrium
        self.save, self.restore = session.save, session.restore

    @property
    def nbytes(self) -> int:
        """See `BodyLanes`."""
        return self._session.nbytes

    def reset(
        self, rows: Int[np.ndarray, " row"], material: Material, start: Float[np.ndarray, "row cable"]
    ) -> LaneMotion:
        """See `BodyLanes`."""
        return _last(self._session.reset(rows, material, start=start if self._from_equilibrium else None))

    def advance(self, displacement: Float[np.ndarray, "lane step cable"]) -> LaneMotion:
        """See `BodyLanes`."""
        return _last(self._session.advance(displacement, stride=displacement.shape[1]))


def _last(found: NativeRollout) -> LaneMotion:
    """The last recorded row."""
    return LaneMotion(
        found.position[:, -1], found.tension[:, -1], found.diverged, found.residual, found.cables_converged
    )


def distinct(arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Which rows differ from all before them, and for every row the place of its like among these."""
    seen: dict[bytes, int] = {}
    place = [seen.setdefault(b"".join(a[row].tobytes() for a in arrays), len(seen)) for row in range(len(arrays[0]))]
    return np.unique(place, return_index=True)[1], np.array(place)


def flattened(array: np.ndarray, axes: int, count: int) -> np.ndarray:
    """One batch axis of ``count`` in place of the first ``axes`` axes."""
    return array.reshape(count, *array.shape[axes:])


def padded(recorded: np.ndarray, rows: int) -> np.ndarray:
    """Zero rows where fewer steps were computed than there are commands."""
    if recorded.shape[1] == rows:
        return recorded
    full = np.zeros((recorded.shape[0], rows, *recorded.shape[2:]))
    full[:, : recorded.shape[1]] = recorded
    return full
