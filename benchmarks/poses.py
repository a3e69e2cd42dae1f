"""Poses at rest per processor second, beside soromox and PyElastica, and how far tips are from the elastica with shear.

    python benchmarks/poses.py [--batch N] [--json FILE]

A bar of silicone, held level at one end, hangs under its own weight; moduli and densities are drawn within 20 % of
their nominal values. The reference is the boundary value problem of the planar elastica with shear and stretch, solved
by SciPy. soromox has round sections, here of the same bending stiffness and weight, with a reference of their own, and
a planar arm, which is cheaper than its spatial one; ours are spatial. It has no search for equilibria: its forces at
rest are given to Newton's method, from the straight arm until no coordinate moves by more than 10^-9. PyElastica and
MuJoCo have none either, and move until the bar hangs still (3 s); their error is that of the nominal bar's sag.
Compilation is not counted. All rates are of one thread; of processor time, those of PyElastica and MuJoCo by the clock.
FILE gets the table as JSON, and as Markdown beside it.
"""

from __future__ import annotations

import os

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import peers
from jaxtyping import Float
from scipy.integrate import solve_bvp

from rfdropo_bayes import fem
from rfdropo_bayes.fem.rod import SHEAR
from rfdropo_bayes.simulators.body_engine import Backend, Engine
from rfdropo_bayes.simulators.trunk import Assembly

LENGTH, SIDE, POISSON, GRAVITY = peers.LENGTH, peers.SIDE, peers.POISSON, peers.GRAVITY
ELEMENTS, PIECES = (5, 10, 20, 40), (2, 4, 8, 16)
SETTLED, MOST = 1e-9, 50
REPEATS, CHECKED = 3, 16

Tips = Float[np.ndarray, "bars 2"]  # [m]: along the bar, and downwards


class Row(NamedTuple):
    """One line of the table."""

    solver: str
    unknowns: int
    per_second: float  # poses a processor second
    error_mm: float  # root mean square over bars
    settled: str


class Section(NamedTuple):
    """Areas of a section [m2]: of tension, and of shear."""

    area: float
    shear_area: float


SQUARE = Section(SIDE**2, SHEAR * SIDE**2)
RADIUS = SIDE / (3.0 * np.pi) ** 0.25  # [m] of the disc with the square's second moment of area
DISC = Section(np.pi * RADIUS**2, np.pi * RADIUS**2)


def elastica(young: float, density: float, section: Section) -> tuple[float, float]:
    """Tip of the planar elastica with shear and stretch under its weight [m]: along the bar, and downwards."""
    area, shear = section.area, young / (2.0 * (1.0 + POISSON)) * section.shear_area
    weight, bending = density * GRAVITY * SIDE**2, young * SIDE**4 / 12.0

    def slopes(s: np.ndarray, state: np.ndarray) -> np.ndarray:
        _, _, angle, moment = state
        load = weight * (LENGTH - s)
        along, across = np.sin(angle) * load / (young * area), np.cos(angle) * load / shear
        level = (1.0 + along) * np.cos(angle) - across * np.sin(angle)
        down = (1.0 + along) * np.sin(angle) + across * np.cos(angle)
        return np.stack([level, down, moment / bending, -level * load])

    def ends(base: np.ndarray, tip: np.ndarray) -> np.ndarray:
        return np.array([*base[:3], tip[3]])

    s = np.linspace(0.0, LENGTH, 50)
    start = np.stack([s, 0.5 * s, 0.5 * s / LENGTH, 0.0 * s])
    found = solve_bvp(slopes, ends, s, start, tol=1e-9, max_nodes=100_000)
    assert found.success, found.message
    return float(found.y[0, -1]), float(found.y[1, -1])


def rod(name: Literal["numba", "jax"], elements: int) -> Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """Tips of rods of an engine without cables, across which gravity acts, and whether each was found."""
    body = fem.uniform_rod(LENGTH, SIDE / 2.0, SIDE / 2.0, elements)
    system = fem.System(body, fem.cable_layout(body, np.zeros((0, 3)), []))
    assembly = Assembly(system, fem.attach(body, np.array([[0.0, 0.0, LENGTH]])), np.arange(elements + 1))
    engine = Engine(assembly, 0.01, Backend(name, "float64", 1), integrator="quasi-static")

    def tip(young: jax.Array, density: jax.Array) -> tuple[jax.Array, jax.Array]:
        material = fem.material(
            system, young_modulus=young, density=density, poisson_ratio=POISSON, gravity=(GRAVITY, 0.0, 0.0)
        )
        motion = engine.motion(material, jnp.zeros(0), jnp.zeros((1, 0)), None)
        place = motion.position[-1].reshape(-1, 3)[-1]
        return jnp.stack([place[2], place[0]]), ~motion.diverged

    return tip


def soromox(pieces: int) -> Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """The same of a planar arm of pieces of constant strain."""
    from soromox.systems.components import IsotropicMaterialParams, LinkSpec
    from soromox.systems.pcs import PlanarPCS

    own: dict[str, Any] = {"density": 1e3, "reference_strain": [0.0, 1.0, 0.0]}
    own |= {"young_modulus": 4.5e5, "poisson_ratio": POISSON, "material_damping_coefficient": 1.0}
    arm = PlanarPCS.from_links(
        [LinkSpec.circular(length=LENGTH / pieces, radius=RADIUS, **own) for _ in range(pieces)],
        gravity=jnp.array([0.0, -GRAVITY]),
        base_pose=jnp.zeros(3),
    )

    def tip(young: jax.Array, density: jax.Array) -> tuple[jax.Array, jax.Array]:
        body = arm.update_link_params(density=jnp.full(pieces, density * SIDE**2 / DISC.area)).with_isotropic_material(
            IsotropicMaterialParams(young, None, POISSON, 1.0)
        )

        def better(state: tuple) -> tuple:
            at, _, count = state
            move = jnp.linalg.solve(jax.jacfwd(body.potential_force)(at), -body.potential_force(at))
            return at + move, jnp.max(jnp.abs(move)), count + 1

        start = (jnp.zeros(body.num_coordinates), jnp.inf, 0)
        at, moved, _ = jax.lax.while_loop(lambda state: (state[1] > SETTLED) & (state[2] < MOST), better, start)
        _, level, up = body.forward_kinematics_abscissa_batched(at, jnp.array([LENGTH]))[0]
        return jnp.stack([level, -up]), jnp.asarray(moved <= SETTLED)

    return tip


def measure(solver: str, unknowns: int, tip: Any, bars: jax.Array, exact: Tips) -> Row:
    """A row: the best of the repeats, after a first call that compiles."""
    run = jax.jit(jax.vmap(tip))
    tips, settled = jax.block_until_ready(run(*bars))
    spent = []
    for _ in range(REPEATS):
        start = time.process_time()
        jax.block_until_ready(run(*bars))
        spent.append(time.process_time() - start)
    error = 1e3 * float(np.sqrt(np.mean(np.sum((np.asarray(tips)[: len(exact)] - exact) ** 2, axis=1))))
    settled_words = f"{int(np.sum(settled))} of {bars.shape[1]}"
    return Row(solver, unknowns, bars.shape[1] / min(spent), error, settled_words)


def main() -> None:
    """Print the table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    factors = np.random.default_rng(0).uniform(0.8, 1.2, (2, given.batch))
    bars = jnp.asarray(factors * np.array([[4.5e5], [1000.0]]))
    square, disc = (
        np.array([elastica(young, density, section) for young, density in np.asarray(bars)[:, :CHECKED].T])
        for section in (SQUARE, DISC)
    )
    rows = []
    names: tuple[Literal["numba", "jax"], ...] = ("numba", "jax")
    for name in names:
        for elements in ELEMENTS:
            rows.append(measure(f"ours, {name}, {elements} elements", 6 * elements, rod(name, elements), bars, square))
            print(rows[-1], flush=True)
    for pieces in PIECES:
        try:
            rows.append(measure(f"soromox, planar, {pieces} pieces", 3 * pieces, soromox(pieces), bars, disc))
        except ImportError as error:
            print(f"soromox: {error.name} is not installed (studies/requirements.txt)")
            break
        print(rows[-1], flush=True)
    for peer in peers.settle_all():
        if peer.sag is not None and peer.cost is not None:
            nominal = elastica(4.5e5, 1000.0, SQUARE)[1]
            off = 1e3 * abs(peer.sag - nominal)
            rows.append(Row(peer.name, peer.unknowns, 1.0 / (peers.SECONDS * peer.cost), off, "-"))
    lines = ["| solver | unknowns | poses a processor second | error [mm] | settled |", "|---|---|---|---|---|"]
    lines += [f"| {r.solver} | {r.unknowns} | {r.per_second:.3g} | {r.error_mm:.3g} | {r.settled} |" for r in rows]
    print("\n".join(lines))
    if given.json:
        given.json.write_text(json.dumps([row._asdict() for row in rows], indent=2) + "\n")
        given.json.with_suffix(".md").write_text("\n".join(["# Poses at rest", "", *lines]) + "\n")


if __name__ == "__main__":
    main()
