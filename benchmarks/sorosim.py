"""Shapes of two rods under gravity, forces and moments, beside those that SoroSim found: errors over all of them.

The shapes are 500 of a rod of spring steel and 500 of one of TPU, clamped at the base and loaded at the middle and at
the tip (SoroSim, Mathew et al. 2022; files of opencr-mujoco, MIT licence).

    python benchmarks/sorosim.py FOLDER [SHAPES]

The rod of TPU in these files does not twist: the difference of rotations about its axis is our twist, the moment over G
J. The angle between the axes leaves it out.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfdropo_bayes import fem

TURN = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""From the files' frame, whose x axis is along the rod, to ours, whose z axis is."""
ELEMENTS = 40


class Rod(NamedTuple):
    """A round rod."""

    radius: float  # [m]
    young_modulus: float  # [Pa]
    poisson_ratio: float
    density: float  # [kg/m3]
    length: float  # [m]


RODS = {"SpringSteelRod": Rod(0.8e-3, 200e9, 0.33, 7870.0, 0.6), "TPURod": Rod(5e-3, 70e6, 0.4, 1200.0, 0.4)}


class Shapes(NamedTuple):
    """Loads and shapes in our frame, one a row; wrenches are force and moment."""

    gravity: Float[np.ndarray, "shapes 3"]  # [m/s2]
    middle: Float[np.ndarray, "shapes 6"]  # [N], [N m]
    tip: Float[np.ndarray, "shapes 6"]
    place: Float[np.ndarray, "shapes 2 3"]  # of the middle and of the tip [m]
    frame: Float[np.ndarray, "shapes 2 3 3"]


def euler(angle: Float[np.ndarray, "shapes 3"]) -> Float[np.ndarray, "shapes 3 3"]:
    """Rotation Rx Ry Rz from angles about x, y and z [rad]."""
    sine, cosine = np.sin(angle), np.cos(angle)
    x, y, z = (np.tile(np.eye(3), (len(angle), 1, 1)) for _ in range(3))
    for matrix, axis, (i, k) in ((x, 0, (1, 2)), (y, 1, (2, 0)), (z, 2, (0, 1))):
        matrix[:, i, i] = matrix[:, k, k] = cosine[:, axis]
        matrix[:, i, k], matrix[:, k, i] = -sine[:, axis], sine[:, axis]
    return x @ y @ z


def read(file: Path) -> Shapes:
    """The shapes of a file."""
    rows = [line.split(",")[1:] for line in file.read_text().splitlines()[2:]]
    values = np.array(rows, dtype=float).reshape(-1, 6, 17)
    angles, places = values[:, :3], values[:, 3:]
    ends = [9, 16]
    frame = np.stack([TURN @ euler(angles[:, :, k]) @ TURN.T for k in ends], axis=1)
    wrench = np.concatenate([places[:, :, 1:3], angles[:, :, 1:3]], axis=1)
    wrench = np.einsum("ij,sbjk->ksbi", TURN, wrench.reshape(-1, 2, 3, 2)).reshape(2, -1, 6)
    return Shapes(places[:, :, 0] @ TURN.T, *wrench, places[:, :, ends].transpose(0, 2, 1) @ TURN.T, frame)


def system(rod: Rod) -> fem.System:
    """A rod without cables."""
    area, moment, part = np.pi * rod.radius**2, np.pi * rod.radius**4 / 4.0, np.ones(ELEMENTS)
    body = fem.profile_rod(
        station=np.linspace(0.0, rod.length, ELEMENTS + 1),
        half_width=np.full((ELEMENTS + 1, 2), rod.radius),
        axial_area=area * part,
        bending_moment_area=moment * np.ones((ELEMENTS, 2)),
        torsion_constant=2.0 * moment * part,
        mass_area=area * part,
        mass_moment_area=moment * np.ones((ELEMENTS, 2)),
    )
    return fem.System(body, fem.without_cables())


def settle(rod: Rod, gravity: jax.Array, wrench: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Places and quaternions of the middle and of the tip under wrenches there, in space; and whether it settled."""
    whole = system(rod)
    chosen = np.array([ELEMENTS // 2, ELEMENTS])
    material = fem.material(
        whole, young_modulus=rod.young_modulus, poisson_ratio=rod.poisson_ratio, density=rod.density, gravity=gravity
    )
    load = jnp.zeros((ELEMENTS + 1, 6)).at[chosen].set(wrench)
    state, info = fem.static_equilibrium(whole, fem.prepare(whole, material), jnp.zeros(0), load, 300)
    return state.position[chosen], state.orientation[chosen], info.converged


def errors(rod: Rod, shapes: Shapes) -> tuple[np.ndarray, ...]:
    """Errors of places [m], rotations and directions of the axis [rad] of middle and tip, and which shapes settled."""
    wrench = np.stack([shapes.middle, shapes.tip], axis=1)
    place, turn, settled = jax.jit(jax.vmap(partial(settle, rod)))(shapes.gravity, wrench)
    w, x, y, z = np.moveaxis(np.asarray(turn), -1, 0)
    frame = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    cosine = 0.5 * (np.einsum("ijse,seij->se", frame, shapes.frame) - 1.0)
    far = np.linalg.norm(np.asarray(place) - shapes.place, axis=-1)
    axis = np.einsum("ise,sei->se", frame[:, 2], shapes.frame[..., 2])
    turned, leaning = (np.arccos(np.clip(value, -1.0, 1.0)) for value in (cosine, axis))
    return far, turned, leaning, np.asarray(settled)


def main() -> None:
    """Print the errors."""
    folder, many = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else None
    titles = (
        f"{'mean mm':>9}{'worst mm':>10}{'of length':>11}{'mean rad':>10}{'worst':>8}{'mean of axis':>14}{'worst':>8}"
    )
    print(f"{'tip of':16}{'shapes':>8}{'settled':>8}{titles}")
    for name, rod in RODS.items():
        shapes = Shapes(*(part[:many] for part in read(folder / f"{name}.csv")))
        far, turned, leaning, settled = errors(rod, shapes)
        far, turned, leaning = far[settled, 1], turned[settled, 1], leaning[settled, 1]
        print(
            f"{name:16}{len(settled):8}{settled.sum():8}{1e3 * far.mean():9.3f}{1e3 * far.max():10.3f}"
            f"{far.max() / rod.length:11.5f}{turned.mean():10.5f}{turned.max():8.5f}"
            f"{leaning.mean():14.5f}{leaning.max():8.5f}"
        )


if __name__ == "__main__":
    main()
