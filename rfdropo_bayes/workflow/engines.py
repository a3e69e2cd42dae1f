"""Which engine computes the motion of the body."""

from __future__ import annotations

import jax

from rfdropo_bayes.simulators.compiled import CompiledEngine
from rfdropo_bayes.simulators.mesh_body import MeshAssembly
from rfdropo_bayes.simulators.mesh_engines import CompiledMeshEngine, MeshEngine, ReferenceMeshEngine
from rfdropo_bayes.simulators.reference import ReferenceEngine
from rfdropo_bayes.simulators.trunk import Assembly, Discretisation, Engine
from rfdropo_bayes.workflow.experiment import SimulatorTable


def build_engine(
    table: SimulatorTable, assembly: Assembly, discretisation: Discretisation, from_equilibrium: bool
) -> Engine:
    """The engine that [simulator] asks for; "auto" takes the compiled one where JAX has only a CPU."""
    name = table.engine
    if name == "auto":
        name = "numba" if jax.default_backend() == "cpu" else "jax"
    if name == "jax":
        return ReferenceEngine(assembly, discretisation.time_step, from_equilibrium)
    return CompiledEngine(assembly, discretisation.time_step, from_equilibrium, table.precision, table.threads)


def build_mesh_engine(table: SimulatorTable, assembly: MeshAssembly, time_step: float) -> MeshEngine:
    """The engine that [simulator] asks for; "auto" is the compiled one, as JAX takes minutes to compile a mesh."""
    if table.engine == "jax":
        return ReferenceMeshEngine(assembly, time_step)
    return CompiledMeshEngine(assembly, time_step, table.precision, table.threads)
