"""Which engine computes the motion of the body."""

from __future__ import annotations

import jax

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.compiled import CompiledEngine
from rfdropo_bayes.simulators.compiled_push import CompiledLayeredPushEngine, CompiledMeshPushEngine
from rfdropo_bayes.simulators.mesh_body import MeshAssembly
from rfdropo_bayes.simulators.mesh_engines import CompiledMeshEngine, MeshEngine, ReferenceMeshEngine
from rfdropo_bayes.simulators.mesh_trunk import MeshTrunkSimulator
from rfdropo_bayes.simulators.push_engines import LayeredPushEngine, MeshPushEngine
from rfdropo_bayes.simulators.pushing import PushSimulator, push_table
from rfdropo_bayes.simulators.reference import ReferenceEngine
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator
from rfdropo_bayes.simulators.trunk import Assembly, Discretisation, Engine, TrunkSimulator
from rfdropo_bayes.workflow.experiment import SimulatorTable


def build_engine(
    table: SimulatorTable, assembly: Assembly, discretisation: Discretisation, from_equilibrium: bool
) -> Engine:
    """The engine that [simulator] asks for."""
    if _layered_engine(table) == "jax":
        return ReferenceEngine(assembly, discretisation.time_step, from_equilibrium)
    return CompiledEngine(assembly, discretisation.time_step, from_equilibrium, table.precision, table.threads)


def build_mesh_engine(table: SimulatorTable, assembly: MeshAssembly, time_step: float) -> MeshEngine:
    """The engine that [simulator] asks for; "auto" is the compiled one, as JAX takes minutes to compile a mesh."""
    if table.engine == "jax":
        return ReferenceMeshEngine(assembly, time_step)
    return CompiledMeshEngine(assembly, time_step, table.precision, table.threads)


def build_push_simulator(table: SimulatorTable, trunk: RobotSimulator) -> PushSimulator:
    """The trunk with the robot's cube and plate before it, on the engine that [simulator] asks for.

    Raises:
        InputError: a robot without a cube, or a trunk of another kind.
    """
    push_table(trunk.robot)
    if isinstance(trunk, MeshTrunkSimulator):
        if table.engine == "jax":
            return PushSimulator(MeshPushEngine(trunk))
        return PushSimulator(CompiledMeshPushEngine(trunk, table.precision, table.threads))
    if isinstance(trunk, TrunkSimulator):
        if _layered_engine(table) == "jax":
            return PushSimulator(LayeredPushEngine(trunk))
        return PushSimulator(CompiledLayeredPushEngine(trunk, table.precision, table.threads))
    raise InputError("no contacts for this kind of trunk", where="[simulator] push", remedy="use push = false")


def _layered_engine(table: SimulatorTable) -> str:
    """Name of the engine for layers; "auto" takes the compiled one where JAX has only a CPU."""
    if table.engine != "auto":
        return table.engine
    return "numba" if jax.default_backend() == "cpu" else "jax"
