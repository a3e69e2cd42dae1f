"""The uniform bar in MuJoCo's flex and in PyElastica, where they are installed: settled sag and time for a second."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

LENGTH, SIDE, YOUNG, POISSON, DENSITY, GRAVITY = 0.195, 0.02, 0.45e6, 0.45, 1000.0, 9.81
SAG = 0.0944
"""[m] Settled tip of the finest solid mesh; the elastica, without shear, gives 0.0948."""
SECONDS = 3.0


class Peer(NamedTuple):
    """One simulator's answer; ``sag`` None: it did not run, for the reason in ``remark``."""

    name: str
    unknowns: int = 0
    sag: float | None = None  # of the settled tip [m]
    cost: float | None = None  # [s] for a simulated second, on one thread; None: a static solution
    remark: str = ""

    @property
    def rollouts_per_second(self) -> float | None:
        """Rollouts of a second, 100 steps of 10 ms or what the simulator needs for them."""
        return None if self.cost is None else 1.0 / self.cost


def _mujoco(dof: str, cells: tuple[int, int, int], iterations: int) -> Peer:
    import mujoco

    count, spacing = [n + 1 for n in cells], [LENGTH / cells[0], SIDE / cells[1], SIDE / cells[2]]
    grid = f'cellcount="{cells[0]} {cells[1]} {cells[2]}"' if dof == "trilinear" else ""
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option timestep="0.01" solver="CG" iterations="{iterations}" tolerance="1e-10" gravity="0 0 -{GRAVITY}"
                  integrator="discrete"/>
          <size memory="200M"/>
          <worldbody>
            <flexcomp name="bar" type="grid" dim="3" dof="{dof}" {grid} count="{count[0]} {count[1]} {count[2]}"
                      spacing="{spacing[0]} {spacing[1]} {spacing[2]}" mass="{LENGTH * SIDE**2 * DENSITY}"
                      pos="{LENGTH / 2} 0 0" radius="0.0001">
              <contact selfcollide="none" contype="0" conaffinity="0"/>
              <elasticity young="{YOUNG}" poisson="{POISSON}" damping="0.02"/>
              <pin gridrange="0 0 0 0 {cells[1]} {cells[2]}"/>
            </flexcomp>
          </worldbody>
        </mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    end = data.flexvert_xpos[:, 0] > LENGTH - 1e-6
    last: list[float] = []
    start = time.perf_counter()
    for _ in range(round(SECONDS / 0.01)):
        mujoco.mj_step(model, data)
        last.append(-float(data.flexvert_xpos[end, 2].mean()))
    cost = (time.perf_counter() - start) / SECONDS
    name = f"MuJoCo {mujoco.__version__} flex, {dof}, {iterations} iterations"
    return Peer(name, int(model.nv), float(np.mean(last[-100:])), cost)


def _elastica(elements: int) -> Peer:
    import elastica

    class Simulation(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Damping):
        """A rod that is held, falls and is damped."""

    step, simulation = 2e-4, Simulation()
    rod = elastica.CosseratRod.straight_rod(
        elements, np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), LENGTH,
        SIDE / np.sqrt(np.pi), DENSITY, youngs_modulus=YOUNG, shear_modulus=YOUNG / (2.0 * (1.0 + POISSON)),
    )  # fmt: skip
    # A square of the same area has another second moment than the disc: bending and inertia are set to the square's.
    rod.bend_matrix[:2] *= (SIDE**4 / 12.0) / (np.pi * (SIDE / np.sqrt(np.pi)) ** 4 / 4.0)
    simulation.append(rod)
    simulation.constrain(rod).using(
        elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    simulation.add_forcing_to(rod).using(elastica.GravityForces, acc_gravity=np.array([0.0, 0.0, -GRAVITY]))
    simulation.dampen(rod).using(elastica.AnalyticalLinearDamper, uniform_damping_constant=3.0, time_step=step)
    simulation.finalize()
    stepper = elastica.PositionVerlet()
    now, last = stepper.step(simulation, 0.0, step), []  # the first step compiles
    start = time.perf_counter()
    for _ in range(round(SECONDS / step)):
        now = stepper.step(simulation, now, step)
        last.append(-float(rod.position_collection[2, -1]))
    cost = (time.perf_counter() - start) / SECONDS
    tail = last[-round(1.0 / step) :]
    return Peer(f"PyElastica rod, {elements} elements, steps of 0.2 ms", 6 * elements, float(np.mean(tail)), cost)


CASES: tuple[tuple[str, Callable[..., Peer], tuple[Any, ...]], ...] = (
    ("MuJoCo flex, trilinear", _mujoco, ("trilinear", (20, 2, 2), 3000)),
    ("MuJoCo flex, tetrahedra", _mujoco, ("full", (20, 2, 2), 3000)),
    ("PyElastica", _elastica, (20,)),
)


def settle_all() -> list[Peer]:
    """Every peer that is installed, and a remark on those that are not."""
    found = []
    for name, run, arguments in CASES:
        try:
            found.append(run(*arguments))
        except ImportError as error:
            found.append(Peer(name, remark=f"{error.name} is not installed (studies/requirements.txt)"))
        print(f"{found[-1].name}: {found[-1].sag}, {found[-1].cost} s per simulated s")
    return found
