"""The compiled engines for a trunk that pushes a cube: one call out of a traced program for a whole batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem.layered import PointMap
from rfdropo_bayes.fem.layered_pushing import check_effects
from rfdropo_bayes.fem.native.layered_push import NativeLayeredPush
from rfdropo_bayes.fem.native.tetrahedral_push import TetrahedralPushEngine
from rfdropo_bayes.simulators import compiled, mesh_engines
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.compiled import flattened
from rfdropo_bayes.simulators.differences import LENGTH, with_differences
from rfdropo_bayes.simulators.mesh_trunk import MeshTrunkSimulator
from rfdropo_bayes.simulators.push_engines import layered_scene, mesh_scene
from rfdropo_bayes.simulators.pushing import CubeInputs, PushMotion
from rfdropo_bayes.simulators.robot_simulator import Values
from rfdropo_bayes.simulators.trunk import TrunkSimulator

Inputs = tuple[Any, Float[Array, "13"], Float[Array, "4"]]
"""Inputs of the trunk, state of the cube at the start, and its mass, side, radius of gyration and friction."""

STATE_SIZES = np.repeat([LENGTH, 0.1, 0.1, 1.0], [3, 4, 3, 3])
"""Sizes of a cube's centre [m], quaternion, velocity [m/s] and spin [rad/s]."""
FRICTION = 0.1
"""Size of a coefficient of friction."""


def cube_inputs(cube: CubeInputs) -> tuple[Float[Array, "13"], Float[Array, "4"]]:
    """A cube as the kernels read it."""
    solid = cube.cube
    values = jnp.stack([solid.mass, solid.side, solid.gyration_radius, cube.friction])
    return jnp.concatenate([*cube.start]), values


def _cube_sizes(state: Float[Array, "13"], values: Float[Array, "4"]) -> tuple[Array, Array]:
    floor = jnp.asarray([1e-12, 1e-12, 1e-12, FRICTION])
    return jnp.broadcast_to(jnp.asarray(STATE_SIZES), state.shape), jnp.abs(values) + floor


def _call(on_host: Callable[..., PushMotion], inputs: Inputs, rows: int, cables: int, markers: PointMap) -> PushMotion:
    """One callback for the whole batch."""
    flag = jax.ShapeDtypeStruct((), jnp.bool_)
    shapes = PushMotion(
        jax.ShapeDtypeStruct((rows, len(markers.node), 3), jnp.float64),
        jax.ShapeDtypeStruct((rows, cables), jnp.float64),
        jax.ShapeDtypeStruct((rows, 7), jnp.float64),
        flag,
        flag,
        flag,
        jax.ShapeDtypeStruct((), jnp.float64),
    )
    return jax.pure_callback(on_host, shapes, inputs, vmap_method="broadcast_all")


def _flat(inputs: Inputs) -> tuple[tuple[int, ...], Inputs]:
    """The batch axes that vmap has added, and the inputs with one in their place."""
    batch = inputs[1].shape[:-1]
    count = int(np.prod(batch))
    return batch, jax.tree.map(lambda value: flattened(np.asarray(value), len(batch), count), inputs)


def _restored(motion: PushMotion, batch: tuple[int, ...]) -> PushMotion:
    return PushMotion(*(np.reshape(value, batch + np.shape(value)[1:]) for value in motion))


@dataclass(frozen=True)
class CompiledLayeredPushEngine:
    """A layered body and a cube on the Numba engine: SIMD lanes and threads over the batch.

    Attributes:
        trunk: whose layers, cables and markers it moves.
        precision: of all arithmetic.
        threads: None for all processors.
    """

    trunk: TrunkSimulator
    precision: Literal["float64", "float32"] = "float64"
    threads: int | None = None
    lanes: ClassVar[int] = 512

    @property
    def time_step(self) -> float:
        """That of the trunk."""
        return self.trunk.discretisation.time_step

    @cached_property
    def _native(self) -> NativeLayeredPush:
        assembly = self.trunk.assembly
        return NativeLayeredPush(
            assembly.system,
            assembly.markers,
            layered_scene(self.trunk),
            self.time_step,
            precision=self.precision,
            threads=self.threads,
        )

    def describe(self) -> dict[str, object]:
        """Name and precision."""
        return {"engine": "numba", "precision": self.precision, "device": "cpu"}

    def recording(self, points: PointMap) -> CompiledLayeredPushEngine:
        """See `PushEngine.recording`."""
        trunk = self.trunk
        return replace(
            self, trunk=replace(trunk, assembly=trunk.assembly._replace(markers=points)), precision="float64"
        )

    def motion(self, values: Values, commands: Commands, cube: CubeInputs) -> PushMotion:
        """See `PushEngine.motion`. Derivatives are central differences along each tangent.

        Raises:
            InputError: effects of the cables, which contacts are not solved together with.
        """
        material = self.trunk.material(values)
        check_effects(material.effects)
        trunk = (material, *self.trunk.wound(values, commands, self.time_step))
        return self._differentiable((trunk, *cube_inputs(cube)), jnp.zeros(()))

    @cached_property
    def _differentiable(self) -> Callable[[Inputs, Array], PushMotion]:
        def call(inputs: Inputs, _: Array) -> PushMotion:
            steps, cables = inputs[0][2].shape
            return _call(self._on_host, inputs, steps + 1, cables, self.trunk.assembly.markers)

        def sizes(inputs: Inputs) -> Inputs:
            return compiled.input_sizes(inputs[0]), *_cube_sizes(*inputs[1:])

        return with_differences(call, sizes, self.precision)

    def _on_host(self, inputs: Inputs) -> PushMotion:
        batch, ((material, start, displacement), state, values) = _flat(inputs)
        settles = self.trunk.robot.initial_state == "equilibrium"
        found = self._native.push(material, displacement, state, values, start=start if settles else None)
        body = found.body
        motion = PushMotion(
            body.position, body.tension, found.pose, body.diverged, body.cables_converged, found.contacts_converged,
            body.residual,
        )  # fmt: skip
        return _restored(motion, batch)


@dataclass(frozen=True)
class CompiledMeshPushEngine:
    """A body of tetrahedra and a cube on the Numba engine; attributes as `CompiledLayeredPushEngine`."""

    trunk: MeshTrunkSimulator
    precision: Literal["float64", "float32"] = "float64"
    threads: int | None = None
    lanes: ClassVar[int] = 64

    @property
    def time_step(self) -> float:
        """That of the trunk."""
        return self.trunk.time_step

    @cached_property
    def _native(self) -> TetrahedralPushEngine:
        system = self.trunk.assembly.system
        return TetrahedralPushEngine(
            system.body,
            system.cables,
            system.limits,
            self.trunk.assembly.markers,
            mesh_scene(self.trunk),
            dtype=np.dtype(self.precision).type,
            threads=self.threads,
        )

    def describe(self) -> dict[str, object]:
        """Name and precision."""
        return {"engine": "numba", "precision": self.precision, "device": "cpu"}

    def recording(self, points: PointMap) -> CompiledMeshPushEngine:
        """See `PushEngine.recording`."""
        trunk = self.trunk
        return replace(
            self, trunk=replace(trunk, assembly=trunk.assembly._replace(markers=points)), precision="float64"
        )

    def motion(self, values: Values, commands: Commands, cube: CubeInputs) -> PushMotion:
        """See `PushEngine.motion`. Derivatives are central differences along each tangent."""
        trunk = self.trunk.material(values), self.trunk.displacements(values, commands)
        return self._differentiable((trunk, *cube_inputs(cube)), jnp.zeros(()))

    @cached_property
    def _differentiable(self) -> Callable[[Inputs, Array], PushMotion]:
        def call(inputs: Inputs, _: Array) -> PushMotion:
            steps, cables = inputs[0][1].shape
            return _call(self._on_host, inputs, steps + 1, cables, self.trunk.assembly.markers)

        def sizes(inputs: Inputs) -> Inputs:
            return mesh_engines.input_sizes(inputs[0]), *_cube_sizes(*inputs[1:])

        return with_differences(call, sizes, self.precision)

    def _on_host(self, inputs: Inputs) -> PushMotion:
        batch, ((material, displacement), state, values) = _flat(inputs)
        found = self._native.push(material._asdict(), displacement, state, values, time_step=self.time_step)
        body, assembly = found.body, self.trunk.assembly
        position, tension = mesh_engines.with_start(assembly, body.position, body.tension)
        return _restored(
            PushMotion(
                position, tension, found.pose, body.diverged, body.cables_converged, found.contacts_converged,
                np.zeros(len(position)),
            ),
            batch,
        )  # fmt: skip
