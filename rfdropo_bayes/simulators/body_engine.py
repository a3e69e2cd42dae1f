"""Engines for the motion of a body, and of a cube that it pushes: a rod in JAX or compiled by Numba, a mesh by Numba.

For a rod both engines give the same numbers. JAX is differentiable and runs on any device; Numba uses vector lanes and
threads of a CPU, in one callback for a whole batch, which JAX cannot differentiate. A rod may also be at rest in every
row: an equilibrium found from the row before, without time or damping.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem import Material, PointMap, point_positions, prepare, simulate, state_at_rest
from rfdropo_bayes.fem import static_equilibrium as find_equilibrium
from rfdropo_bayes.fem.dynamics import Prepared, State, System
from rfdropo_bayes.fem.integrators import STAGES, Integrator
from rfdropo_bayes.fem.mesh_points import NodePoints
from rfdropo_bayes.fem.native.rod_engine import NativeRod
from rfdropo_bayes.fem.native.tetrahedral_engine import TetrahedralEngine
from rfdropo_bayes.fem.pushing import PushGeometry
from rfdropo_bayes.fem.rigid_body import Cube, CubeState
from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.fem.section_loads import SectionLoads, loaded
from rfdropo_bayes.fem.tetrahedra import TetrahedralMaterial, TetrahedralSystem
from rfdropo_bayes.simulators.callbacks import one_callback
from rfdropo_bayes.simulators.port_signals import BodySignals

QUASI_STATIC: Literal["quasi-static"] = "quasi-static"  # motion of a body that is at rest in every row
LOAD_PLACES = (0.3, 0.65, 1.0)
"""Shares of a body's length at which forces may act: more places are not distinguishable, as forces at neighbouring
places move the markers similarly (cosine .95 at .06 and .2 m of an arm of .2 m).
"""


class EngineBody(Protocol):
    """A body with its cables, and the points of it that are recorded: a named tuple that may hold more."""

    @property
    def system(self) -> System | TetrahedralSystem:
        """Body and cables."""

    @property
    def markers(self) -> PointMap | NodePoints:
        """Recorded points."""


class Backend(NamedTuple):
    """Backend of the arithmetic."""

    name: Literal["numba", "jax"] = "numba"  # "numba" or "jax"
    precision: Literal["float64", "float32"] = "float64"  # precision of "numba"; "jax" uses double precision
    threads: int | None = None  # threads of "numba"; None for all processors


class CubeInputs(NamedTuple):
    """The cube of one rollout."""

    cube: Cube
    start: CubeState


class Inputs(NamedTuple):
    """Inputs of a rollout."""

    material: Material | TetrahedralMaterial
    start: Float[Array, " drive"]  # before the first step: displacements of cables [m], pressures of chambers [Pa]
    drive: Float[Array, "step drive"]  # at the end of every step
    cube: CubeInputs | None = None
    loads: BodySignals | None = None


@dataclass(frozen=True)
class Engine:
    """The motion of a body, with or without a cube, under given displacements of cables and pressures of chambers."""

    body: EngineBody  # the moving body
    time_step: float  # time step of the simulation [s]
    backend: Backend = field(default_factory=Backend)  # backend of the arithmetic
    from_equilibrium: bool = False  # start in the static equilibrium of the initial drives, else undeformed; of a rod
    scene: PushGeometry | None = None  # geometry on which the body pushes a cube; None for a body that touches nothing
    # scheme of a time step, see `fem.integrators`; "quasi-static" for a rod that is at rest in every row, an
    # equilibrium found from the row before
    integrator: Integrator = "euler"

    def __post_init__(self) -> None:
        system = self.body.system
        if not self.is_rod:
            if self.from_equilibrium or self.at_rest:
                raise InputError(
                    "a body of tetrahedra has neither a start in equilibrium nor quasi-static motion",
                    where="engine",
                    remedy="use a rod",
                )
            if self.backend.name == "jax":
                raise InputError("JAX has no body of tetrahedra", where="engine", remedy='use engine = "numba"')
        if self.at_rest and self.scene is not None:
            raise InputError(
                "quasi-static motion does not allow a cube", where="engine", remedy='use motion = "dynamic"'
            )
        if self.integrator != "euler" and not isinstance(system, System) and np.isfinite(system.limits.rate):
            raise InputError(
                f"integrator {self.integrator!r} with drives that SOFA limits: their limit is one of SOFA's own steps",
                where="[simulator] integrator",
                remedy='use integrator = "euler", or drives = "robot" in [simulator.tetrahedra]',
            )

    @property
    def at_rest(self) -> bool:
        """Whether every row of a motion is an equilibrium."""
        return self.integrator == QUASI_STATIC

    @property
    def is_rod(self) -> bool:
        """Whether the body is a rod, else a mesh of tetrahedra."""
        return isinstance(self.body.system, System)

    @property
    def carries_loads(self) -> bool:
        """Whether signals may act on the body."""
        return self.is_rod and self.scene is None

    @cached_property
    def load_stations(self) -> tuple[int, ...]:
        """Stations of a rod that forces may act on, from the base to the tip, see `LOAD_PLACES`."""
        system = self.body.system
        if not isinstance(system, System):
            return ()
        height = np.asarray(system.body.station)
        aims = height[0] + np.array(LOAD_PLACES) * (height[-1] - height[0])
        nearest = [int(np.argmin(np.abs(height - aim))) for aim in aims]
        return tuple(sorted({k for k in nearest if k >= system.clamped_stations}))

    @property
    def lanes(self) -> int:
        """Preferred number of rollouts per call."""
        if self.backend.name == "jax":
            return 64
        return 512 if self.is_rod else 64

    def describe(self) -> dict[str, object]:
        """Name, precision, device and the integrator if it is not implicit Euler, for the record."""
        steps = {} if self.integrator == "euler" else {"integrator": self.integrator}
        if self.backend.name == "jax":
            return {"engine": "jax", "precision": "float64", "device": jax.devices()[0].platform, **steps}
        return {"engine": "numba", "precision": self.backend.precision, "device": "cpu", **steps}

    def motion(
        self,
        material: Material | TetrahedralMaterial,
        start: Float[Array, " drive"],
        drive: Float[Array, "step drive"],
        steps: Int[Array, ""] | None = None,
        cube: CubeInputs | None = None,
        loads: BodySignals | None = None,
    ) -> Motion:
        """Roll out from the initial state; ``steps`` limits the steps computed; later rows are meaningless. At rest a
        step is an equilibrium.

        Raises:
            InputError: a cube without a scene, or a scene without a cube; loads on another body than a rod alone.
        """
        if (cube is None) != (self.scene is None):
            raise InputError("a scene and a cube must be given together", where="engine")
        if loads is not None and not self.carries_loads:
            raise InputError(
                "signals on the body act on a rod without a cube only",
                where="engine",
                remedy='set body = "rod" under [simulator], and leave the cube out',
            )
        inputs = Inputs(material, start, drive, cube, loads)
        if self.backend.name == "jax":
            return self._reference(inputs, steps)
        limit = jnp.asarray(drive.shape[0] if steps is None else steps, jnp.float64)
        return self._call(inputs, limit)

    def section_loads(self, loads: BodySignals | None) -> SectionLoads | None:
        """Signals on the body as the engine takes them, with the stations that forces act on; None without signals."""
        return None if loads is None else SectionLoads(*loads, station=self.load_stations)

    def initial(
        self, material: Material, start: Float[Array, " drive"], loads: BodySignals | None = None
    ) -> tuple[Prepared, State, Float[Array, ""]]:
        """A rod in JAX before its first step, and the relative force out of balance."""
        system: Any = self.body.system
        prepared, state, residual = prepare(system, material), state_at_rest(system), jnp.zeros(())
        if self.from_equilibrium:
            under, force = prepared, jnp.zeros((len(state.position), 6))
            acting = self.section_loads(loads)
            if acting is not None:
                under, force = loaded(system, prepared, acting, 0)
            state, equilibrium = find_equilibrium(system, under, start, force)
            residual = equilibrium.residual
        if len(STAGES[self.integrator]) > 1:
            state = state._replace(commanded=jnp.asarray(start))
        return prepared, state, residual

    def _reference(self, inputs: Inputs, steps: Int[Array, ""] | None) -> Motion:
        markers, rows = self.body.markers, inputs.drive[:, None, :]
        cube, system, material = inputs.cube, cast("System", self.body.system), cast("Material", inputs.material)
        around: dict[str, Any] = {} if cube is None else {"scene": self.scene, "cube": cube.cube}
        prepared, state, imbalance = self.initial(material, inputs.start, inputs.loads)
        acting = self.section_loads(inputs.loads)
        state = state._replace(cube=None if cube is None else cube.start)
        options = {"horizon": steps, "integrator": self.integrator, "loads": acting, **around}
        rollout = simulate(system, prepared, state, rows, self.time_step, markers, **options)
        first = point_positions(markers, state.position, state.orientation)
        pose = None
        if cube is not None and rollout.pose is not None:
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
        options: dict[str, Any] = {"threads": backend.threads, "scene": self.scene, "integrator": self.integrator}
        if isinstance(system, System):
            return NativeRod(system, self.body.markers, self.time_step, precision=backend.precision, **options)
        kind = np.dtype(backend.precision).type
        return TetrahedralEngine(system.body, system.cables, system.limits, self.body.markers, dtype=kind, **options)

    def _call(self, inputs: Inputs, limit: Array) -> Motion:
        system, rows = self.body.system, inputs.drive.shape[0] + 1
        cables = len(system.cables.anchor) if isinstance(system, System) else inputs.drive.shape[1]

        def numbers(*shape: int) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct(shape, jnp.float64)

        flag = jax.ShapeDtypeStruct((), jnp.bool_)
        pose = None if self.scene is None else numbers(rows, 7)
        markers = len(self.body.markers.weight)
        shapes = Motion(numbers(rows, markers, 3), numbers(rows, cables), flag, numbers(), flag, pose)
        return one_callback(self._rolled, shapes, inputs, limit)

    def _rolled(self, inputs: Inputs, steps: int) -> Motion:
        """Rollouts of a batch with one axis."""
        cube = None if inputs.cube is None else cube_arrays(inputs.cube)
        if isinstance(self.body.system, System):
            begin = {"start" if self.from_equilibrium else "before": inputs.start}
            options: dict[str, Any] = {"steps": steps, "cube": cube, "loads": self.section_loads(inputs.loads)}
            motion = self.native.rollout(inputs.material, inputs.drive, **begin, **options)
            return motion._replace(solves=None)
        commands = inputs.drive[:, :steps]
        return self.native.rollouts(inputs.material._asdict(), commands, time_step=self.time_step, cube=cube)


def cube_arrays(cube: CubeInputs) -> tuple[Float[np.ndarray, "batch 13"], Float[np.ndarray, "batch 4"]]:
    """Cubes as the kernels read them."""
    solid = cube.cube
    values = np.stack([solid.mass, solid.side, solid.gyration_radius, solid.friction], axis=-1)
    return np.concatenate([*cube.start], axis=-1), values
