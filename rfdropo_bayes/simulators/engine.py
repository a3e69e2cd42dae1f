"""What computes the motion of a body, and of a cube that it pushes: any body, in JAX or compiled by Numba.

Both give the same numbers. JAX is differentiable and runs on whatever device it finds; Numba fills the lanes and
threads of a CPU with rollouts, one call out of a traced program for a whole batch, and its derivatives are differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import (
    BendingLaw,
    BodyEffects,
    Material,
    PointMap,
    Viscoelasticity,
    Wall,
    point_positions,
    prepare,
    simulate,
    state_at_rest,
    tetrahedral_dynamics,
)
from rfdropo_bayes.fem import static_equilibrium as find_equilibrium
from rfdropo_bayes.fem.dynamics import System
from rfdropo_bayes.fem.native.layered import NativeLayered
from rfdropo_bayes.fem.native.tetrahedral_engine import TetrahedralEngine
from rfdropo_bayes.fem.pushing import PushScene
from rfdropo_bayes.fem.rigid_body import Cube, CubeState
from rfdropo_bayes.fem.tetrahedral_dynamics import TetrahedralMaterial, TetrahedralSystem
from rfdropo_bayes.simulators.differences import (
    ACCELERATION,
    LENGTH,
    MASS,
    MASS_DAMPING,
    STIFFNESS_DAMPING,
    incompressibility_margin,
    with_differences,
)

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
CUBE_SIZES = np.repeat([LENGTH, 0.1, 0.1, 1.0], [3, 4, 3, 3])
"""Sizes of a cube's centre [m], quaternion, velocity [m/s] and spin [rad/s]."""
FRICTION = 0.1
"""Size of a coefficient of friction."""


class Body(Protocol):
    """A body with its cables, and the points of it that are recorded: a named tuple that may hold more."""

    @property
    def system(self) -> System | TetrahedralSystem:
        """Body and cables."""

    @property
    def markers(self) -> PointMap:
        """Recorded points."""

    def _replace(self, *, markers: PointMap = ...) -> Any:
        """The same with other points."""


class Backend(NamedTuple):
    """What the arithmetic runs on.

    Attributes:
        name: "numba" or "jax".
        precision: of all arithmetic of "numba"; that of "jax" is double.
        threads: of "numba"; None for all processors.
        one_sided, difference: how derivatives of "numba" are taken, see `with_differences`.
    """

    name: Literal["numba", "jax"] = "numba"
    precision: Literal["float64", "float32"] = "float64"
    threads: int | None = None
    one_sided: bool = False
    difference: float | None = None


class CubeInputs(NamedTuple):
    """The cube of one rollout."""

    cube: Cube
    start: CubeState


class Inputs(NamedTuple):
    """What a rollout is computed from."""

    material: Material | TetrahedralMaterial
    start: Float[Array, " cable"]  # displacements before the first step [m]
    displacement: Float[Array, "step cable"]  # at the end of every step [m]
    cube: CubeInputs | None = None


class Motion(NamedTuple):
    """What an engine returns: rows are time steps, row 0 is the initial state."""

    position: Float[Array, "row marker 3"]
    tension: Float[Array, "row cable"]
    diverged: Bool[Array, ""]
    imbalance: Float[Array, ""]  # relative unbalanced force of the initial equilibrium; 0 for a start at rest
    converged: Bool[Array, ""]  # whether the impulses of every step's constraints were found
    pose: Float[Array, "row 7"] | None = None  # of the cube: centre [m] and unit quaternion (x, y, z, w)


def effects_costly(effects: BodyEffects) -> bool:
    """Whether an effect is present that slows every rollout down, even at its null value: friction of the cables, which
    adds rows to the problem of every step."""
    return effects.coulomb_friction is not None or effects.capstan_friction is not None


@dataclass(frozen=True)
class Engine:
    """The motion of a body under given cable displacements, with or without a cube.

    Attributes:
        body: what moves.
        time_step: of the simulation [s].
        backend: what computes.
        from_equilibrium: start in the static equilibrium of the initial displacements, else undeformed; of layers.
        scene: what the body pushes a cube on; None for a body that touches nothing.
    """

    body: Body
    time_step: float
    backend: Backend = field(default_factory=Backend)
    from_equilibrium: bool = False
    scene: PushScene | None = None

    def __post_init__(self) -> None:
        if self.from_equilibrium and not self.layered:
            raise InputError("a body of tetrahedra starts at rest", where="engine", remedy="use a layered body")

    @property
    def layered(self) -> bool:
        """Whether the body is made of layers, else of tetrahedra."""
        return isinstance(self.body.system, System)

    @property
    def lanes(self) -> int:
        """How many rollouts it likes to be given at once."""
        if self.backend.name == "jax":
            return 64 if self.layered else 16
        return 512 if self.layered else 64

    def describe(self) -> dict[str, object]:
        """Name, precision and device, for the record."""
        if self.backend.name == "jax":
            return {"engine": "jax", "precision": "float64", "device": jax.devices()[0].platform}
        return {"engine": "numba", "precision": self.backend.precision, "device": "cpu"}

    def recording(self, points: PointMap) -> Engine:
        """The same engine in double precision, recording these points of the body in place of the markers."""
        body, backend = self.body._replace(markers=points), self.backend._replace(precision="float64")
        return replace(self, body=body, backend=backend)

    def motion(
        self,
        material: Material | TetrahedralMaterial,
        start: Float[Array, " cable"],
        displacement: Float[Array, "step cable"],
        steps: Int[Array, ""] | None = None,
        cube: CubeInputs | None = None,
    ) -> Motion:
        """Roll out from the initial state; ``steps`` limits the steps computed, later rows hold no meaning.

        Derivatives of the compiled backend are differences along each tangent.

        Raises:
            InputError: a cube without a scene, or a scene without a cube.
        """
        if (cube is None) != (self.scene is None):
            raise InputError("a cube without a scene, or a scene without a cube", where="engine")
        inputs = Inputs(material, start, displacement, cube)
        if self.backend.name == "jax":
            return self._reference(inputs, steps)
        limit = jnp.asarray(displacement.shape[0] if steps is None else steps, jnp.float64)
        return self._differentiable(inputs, limit)

    def _reference(self, inputs: Inputs, steps: Int[Array, ""] | None) -> Motion:
        markers, rows = self.body.markers, inputs.displacement[:, None, :]
        cube, imbalance = inputs.cube, jnp.zeros(())
        around: dict[str, Any] = {} if cube is None else {"scene": self.scene, "cube": cube.cube}
        place = None if cube is None else cube.start
        if isinstance(self.body.system, TetrahedralSystem):
            system: Any = self.body.system
            state: Any = tetrahedral_dynamics.state_at_rest(system)._replace(cube=place)
            run: Any = partial(tetrahedral_dynamics.simulate, system, inputs.material)
        else:
            system = self.body.system
            prepared, state = prepare(system, inputs.material), state_at_rest(system)  # type: ignore[arg-type]
            if self.from_equilibrium:
                state, found = find_equilibrium(system, prepared, inputs.start)
                imbalance = found.residual
            state = state._replace(cube=place)
            run = partial(simulate, system, prepared)
        rollout = run(state, rows, self.time_step, markers, horizon=steps, **around)
        first = point_positions(markers, state.position)
        pose = None
        if cube is not None:
            begin = jnp.concatenate([cube.start.position, cube.start.orientation])
            pose = jnp.concatenate([begin[None], rollout.pose])
        return Motion(
            jnp.concatenate([first[None], rollout.position]),
            jnp.concatenate([state.tension[None], rollout.tension]),
            rollout.diverged,
            imbalance,
            rollout.converged,
            pose,
        )

    @cached_property
    def native(self) -> Any:
        """The compiled engine."""
        system, backend = self.body.system, self.backend
        options: dict[str, Any] = {"threads": backend.threads, "scene": self.scene}
        if isinstance(system, System):
            return NativeLayered(system, self.body.markers, self.time_step, precision=backend.precision, **options)
        kind = np.dtype(backend.precision).type
        return TetrahedralEngine(system.body, system.cables, system.limits, self.body.markers, dtype=kind, **options)

    @cached_property
    def _differentiable(self) -> Any:
        backend = self.backend
        return with_differences(self._call, input_sizes, backend.precision, backend.one_sided, backend.difference)

    def _call(self, inputs: Inputs, limit: Array) -> Motion:
        """One callback for the whole batch."""
        rows, cables = inputs.displacement.shape[0] + 1, inputs.displacement.shape[1]

        def numbers(*shape: int) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct(shape, jnp.float64)

        flag = jax.ShapeDtypeStruct((), jnp.bool_)
        pose = None if self.scene is None else numbers(rows, 7)
        markers = len(self.body.markers.node)
        shapes = Motion(numbers(rows, markers, 3), numbers(rows, cables), flag, numbers(), flag, pose)
        return jax.pure_callback(self._on_host, shapes, inputs, limit, vmap_method="broadcast_all")

    def _on_host(self, inputs: Inputs, limit: Array) -> Motion:
        """Flatten whatever batch axes vmap has added, roll out what differs, and restore them."""
        batch, rows = inputs.displacement.shape[:-2], inputs.displacement.shape[-2] + 1
        count = int(np.prod(batch))
        given = jax.tree.map(lambda value: flattened(np.asarray(value), len(batch), count), inputs)
        # Padding of a batch, and perturbations of what acts after the body, ask for the same rollout again and again.
        chosen, place = distinct(jax.tree.leaves(given))
        found = self._rolled(jax.tree.map(lambda value: value[chosen], given), int(np.max(limit)))
        restored = (None if part is None else part[place].reshape((*batch, *part.shape[1:])) for part in found)
        position, tension, diverged, imbalance, converged, pose = restored
        axis = len(batch)
        return Motion(
            padded(position, axis, rows), padded(tension, axis, rows), diverged, imbalance, converged,
            None if pose is None else padded(pose, axis, rows),
        )  # fmt: skip

    def _rolled(self, inputs: Inputs, steps: int) -> tuple:
        """Rollouts of a batch with one axis, in the order of ``Motion``."""
        cube = None if inputs.cube is None else cube_arrays(inputs.cube)
        if isinstance(self.body.system, System):
            start = inputs.start if self.from_equilibrium else None
            found = self.native.rollout(inputs.material, inputs.displacement, start=start, steps=steps, cube=cube)
        else:
            commands = inputs.displacement[:, :steps]
            found = self.native.rollouts(inputs.material._asdict(), commands, time_step=self.time_step, cube=cube)
        return found.position, found.tension, found.diverged, found.residual, found.converged, found.pose


def cube_arrays(cube: CubeInputs) -> tuple[Float[np.ndarray, "batch 13"], Float[np.ndarray, "batch 4"]]:
    """Cubes as the kernels read them."""
    solid = cube.cube
    values = np.stack([solid.mass, solid.side, solid.gyration_radius, solid.friction], axis=-1)
    return np.concatenate([*cube.start], axis=-1), values


def input_sizes(inputs: Inputs) -> Inputs:
    """Sizes that perturbations of the inputs are relative to."""
    material, start, displacement, cube = inputs
    changes: dict[str, Any] = {
        "gravity": jnp.full_like(material.gravity, ACCELERATION),
        "rayleigh_mass": jnp.abs(material.rayleigh_mass) + MASS_DAMPING,
        "rayleigh_stiffness": jnp.abs(material.rayleigh_stiffness) + STIFFNESS_DAMPING,
    }
    if isinstance(material, Material):
        effects = [
            None if value is None else jax.tree.map(jnp.asarray, size)
            for value, size in zip(material.effects, EFFECT_SIZES, strict=True)
        ]
        changes |= {
            "poisson_ratio": incompressibility_margin(material.poisson_ratio),
            "point_mass": jnp.full_like(material.point_mass, MASS),
            "effects": BodyEffects(*effects),
        }
    magnitudes = jax.tree.map(lambda value: jnp.abs(value) + 1e-12, material)._replace(**changes)
    if cube is not None:
        solid = jax.tree.map(lambda value: jnp.abs(value) + 1e-12, cube.cube)
        widths = np.split(CUBE_SIZES, np.cumsum([3, 4, 3]))
        place = CubeState(*(jnp.broadcast_to(size, v.shape) for size, v in zip(widths, cube.start, strict=True)))
        cube = CubeInputs(solid._replace(friction=jnp.abs(cube.cube.friction) + FRICTION), place)
    return Inputs(magnitudes, jnp.full_like(start, LENGTH), jnp.full_like(displacement, LENGTH), cube)


def distinct(arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Which rows differ from all before them, and for every row the place of its like among these."""
    seen: dict[bytes, int] = {}
    place = [seen.setdefault(b"".join(a[row].tobytes() for a in arrays), len(seen)) for row in range(len(arrays[0]))]
    return np.unique(place, return_index=True)[1], np.array(place)


def flattened(array: np.ndarray, axes: int, count: int) -> np.ndarray:
    """One batch axis of ``count`` in place of the first ``axes`` axes."""
    return array.reshape(count, *array.shape[axes:])


def padded(recorded: np.ndarray, axis: int, rows: int) -> np.ndarray:
    """Zero rows along an axis where fewer steps were computed than there are commands."""
    if recorded.shape[axis] == rows:
        return recorded
    width = [(0, 0)] * recorded.ndim
    width[axis] = (0, rows - recorded.shape[axis])
    return np.pad(recorded, width)
