"""What the finite elements are measured against: each reference with our number beside it."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from rfdropo_bayes import fem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.constraints import Contacts, solve_constraints
from rfdropo_bayes.fem.dynamics import stage_body
from rfdropo_bayes.fem.pushing import contact_frame
from rfdropo_bayes.fem.rigid_body import (
    CORNERS,
    Cube,
    cube_at,
    free_twist,
    inverse_inertia,
    moved,
    rotation_matrix,
    solid_gyration_radius,
)
from rfdropo_bayes.fem.stage_solve import inertia_times, linearised, matrix_times
from rfdropo_bayes.model.model import Model
from rfdropo_bayes.verbs.simulate import simulate_all

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"
YOUNG, DENSITY, GRAVITY = 0.45e6, 1000.0, 9.81
LENGTH, SIDE, ELEMENTS = 0.195, 0.02, 20


class Reference(NamedTuple):
    """One row: a quantity, what it should be and what we find.

    ``sense`` "equal" allows the relative ``tolerance``; "at least" and "at most" make the expected value a bound.
    """

    group: str
    quantity: str
    expected: float
    found: float
    tolerance: float
    source: str
    sense: str = "equal"

    @property
    def error(self) -> float:
        """Relative error."""
        return self.found / self.expected - 1.0

    @property
    def passed(self) -> bool:
        """Within the tolerance, or on the right side of the bound."""
        if self.sense == "equal":
            return abs(self.error) <= self.tolerance
        return self.found >= self.expected if self.sense == "at least" else self.found <= self.expected


@functools.cache
def _equilibrium(length: float, half: float, elements: int):
    """Rod of that size, and the function (material, force and moment at the tip) -> its place and quaternion."""
    system = fem.System(fem.uniform_rod(length, half, half, elements), fem.without_cables())

    @jax.jit
    def settle(material: fem.Material, wrench: jax.Array) -> tuple[jax.Array, jax.Array]:
        load = jnp.zeros((elements + 1, 6)).at[-1].set(wrench)
        state, _ = fem.static_equilibrium(system, fem.prepare(system, material), jnp.zeros(0), load, 200)
        return state.position[-1], state.orientation[-1]

    return system, settle


def _end_load(x: float, y: float, z: float, torque: float = 0.0) -> jax.Array:
    return jnp.array([x, y, z, 0.0, 0.0, torque])


# Bisshopp and Drucker: P L^2 / E I -> deflection / L, shortening / L. Heavy elastica: w L^3 / E I -> x / L, y / L.
END_LOAD = {
    0.5: (0.16214, 0.01592),
    1.0: (0.30172, 0.05643),
    2.0: (0.49346, 0.16064),
    3.0: (0.60325, 0.25442),
    5.0: (0.71379, 0.38763),
    10.0: (0.81061, 0.55500),
}
OWN_WEIGHT = {1.0: (0.99125, 0.12347), 2.0: (0.96689, 0.23851), 5.0: (0.84666, 0.49591), 10.0: (0.65635, 0.70020)}


def large_deflections() -> Iterator[Reference]:
    """A slender cantilever, L / h = 50, Poisson ratio zero, 40 elements."""
    half, young = 0.01, 1e6
    system, settle = _equilibrium(1.0, half, 40)
    bending, area = young * 4.0 * half**4 / 3.0, 4.0 * half**2

    def tip(end: float, own: float) -> np.ndarray:
        gravity = (own * bending / (DENSITY * area), 0.0, 0.0)
        material = fem.material(system, young_modulus=young, poisson_ratio=0.0, density=DENSITY, gravity=gravity)
        return np.asarray(settle(material, _end_load(end * bending, 0.0, 0.0))[0])

    for load, (deflection, shortening) in END_LOAD.items():
        place, source = tip(load, 0.0), "Bisshopp and Drucker 1945"
        yield Reference("end load", f"P L2/EI = {load:g}: deflection / L", deflection, place[0], 0.01, source)
        yield Reference("end load", f"P L2/EI = {load:g}: shortening / L", shortening, 1.0 - place[2], 0.01, source)
    for load, (along, across) in OWN_WEIGHT.items():
        place, source = tip(0.0, load), "heavy elastica"
        yield Reference("own weight", f"w L3/EI = {load:g}: x / L", along, place[2], 0.01, source)
        yield Reference("own weight", f"w L3/EI = {load:g}: y / L", across, place[0], 0.01, source)


def bar() -> Iterator[Reference]:
    """The bar of the accuracy table, 195 x 20 x 20 mm, 20 elements."""
    system, settle = _equilibrium(LENGTH, SIDE / 2, ELEMENTS)

    def end(poisson: float, gravity: float, wrench: jax.Array) -> tuple[jax.Array, jax.Array]:
        material = fem.material(
            system, young_modulus=YOUNG, poisson_ratio=poisson, density=DENSITY, gravity=(0.0, -gravity, 0.0)
        )
        return settle(material, wrench)

    none, inertia, area = jnp.zeros(6), SIDE**4 / 12.0, SIDE**2
    sag = -float(end(0.45, GRAVITY, none)[0][1])
    source = "finest solid mesh; its clamped face, which keeps its width, stiffens it"
    yield Reference("bar", "sag under its weight [m]", 0.0944, sag, 0.02, source)
    shear = YOUNG / 2.0 * area * 10.0 / 12.0
    small = 1e-5
    moved_by = float(end(0.0, 0.0, _end_load(small, 0.0, 0.0))[0][0])
    expected = small * (LENGTH**3 / (3.0 * YOUNG * inertia) + LENGTH / shear)
    yield Reference("bar", "small end load: deflection [m]", expected, moved_by, 0.01, "Timoshenko, Cowper")
    weight = 1e-3 * GRAVITY * DENSITY * area
    expected = weight * LENGTH**4 / (8.0 * YOUNG * inertia) + weight * LENGTH**2 / (2.0 * shear)
    found = -float(end(0.0, 1e-3 * GRAVITY, none)[0][1])
    yield Reference("bar", "small weight: deflection [m]", expected, found, 0.01, "Timoshenko, Cowper")
    stretch = float(end(0.0, 0.0, _end_load(0.0, 0.0, 1e-3))[0][2]) - LENGTH
    yield Reference("bar", "end pull: extension [m]", 1e-3 * LENGTH / (YOUNG * area), stretch, 0.01, "N L / E A")
    turned = end(0.45, 0.0, _end_load(0.0, 0.0, 0.0, 1e-6))[1]
    twist = float(2.0 * turned[3] / turned[0])
    expected = 1e-6 * LENGTH / (YOUNG / 2.9 * 0.140577 * SIDE**4)
    yield Reference("bar", "end torque: twist [rad]", expected, twist, 0.01, "Saint-Venant, J = 0.140577 a4")


@functools.cache
def _beam_matrices(elements: int) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and mass of the free unknowns of a clamped unit beam, L / h = 50, E = rho = 1."""
    system = fem.System(fem.uniform_rod(1.0, 0.01, 0.01, elements), fem.without_cables())
    material = fem.material(system, young_modulus=1.0, poisson_ratio=0.0, density=1.0)
    body = stage_body(system, fem.prepare(system, material), fem.state_at_rest(system), 1.0)
    line, shape = linearised(body), (6, elements + 1)
    each = jnp.eye(6 * (elements + 1)).reshape(-1, *shape)
    mass = np.asarray(jax.vmap(lambda d: inertia_times(body, line.frame, d).ravel())(each))
    whole = np.asarray(jax.vmap(lambda d: matrix_times(body, line, d).ravel())(each))
    free = np.flatnonzero(np.tile(np.arange(elements + 1) > 0, 6))
    return (whole - mass)[np.ix_(free, free)], mass[np.ix_(free, free)]


def _frequencies(elements: int) -> np.ndarray:
    squares = scipy.linalg.eigh(*_beam_matrices(elements), eigvals_only=True, subset_by_index=[0, 5])
    return np.sqrt(squares[::2])


def modes() -> Iterator[Reference]:
    """First three bending frequencies, and the rate at which the second converges."""
    exact = np.array([1.875104, 4.694091, 7.854757]) ** 2 * 0.01 / np.sqrt(3.0)
    for number, (expected, found) in enumerate(zip(exact, _frequencies(40), strict=True), 1):
        yield Reference("modes", f"mode {number}, frequency", expected, found, 0.02, "Euler and Bernoulli")
    coarse, middle, fine = (_frequencies(elements)[1] for elements in (10, 20, 40))
    rate = np.log2((coarse - middle) / (middle - fine))
    yield Reference("rates", "second frequency, order in the element's length", 2.0, rate, 0.1, "theory")
    tips = []
    for elements in (10, 20, 40):
        system, settle = _equilibrium(1.0, 0.02, elements)
        material = fem.material(system, young_modulus=1e6, poisson_ratio=0.0, density=DENSITY)
        tips.append(float(settle(material, _end_load(3.0 * 1e6 * 0.04**4 / 12.0, 0.0, 0.0))[0][0]))
    rate = np.log2((tips[0] - tips[1]) / (tips[1] - tips[2]))
    yield Reference("rates", "large deflection, order in the element's length", 1.8, rate, 0.0, "theory: 2", "at least")


def sliding() -> Iterator[Reference]:
    """A cube of 35 mm and 50 g on a tilted plate."""
    side = jnp.asarray(0.035)
    up, time_step, count = jnp.array([0.0, 1.0, 0.0]), 0.01, 50
    frame = contact_frame(jnp.tile(up, (8, 1)))

    @jax.jit
    def speed(angle: float, friction: float) -> jax.Array:
        gravity = GRAVITY * jnp.array([jnp.sin(angle), -jnp.cos(angle), 0.0])
        cube = Cube(jnp.asarray(0.05), side, solid_gyration_radius(side), friction)

        def step(carry, _):
            state, before = carry
            arm = (CORNERS * cube.side) @ rotation_matrix(state.orientation).T
            rows = jnp.concatenate([frame, jnp.cross(arm[:, None, :], frame)], axis=2).reshape(24, 6)
            twist, mass = free_twist(state, gravity, 0.0, time_step), inverse_inertia(cube)
            contacts = Contacts((state.position[1] + arm[:, 1]) / time_step, friction, before)
            nothing = jnp.zeros(0)
            found = solve_constraints((rows * mass) @ rows.T, rows @ twist, nothing, time_step, contacts=contacts)
            state = moved(state, twist + mass * (rows.T @ found.contact.ravel()), time_step)
            return (state, found.contact), None

        start = cube_at(jnp.array([0.0, 0.0175, 0.0]), 0.0, up)
        return jax.lax.scan(step, (start, jnp.zeros((8, 3))), None, length=count)[0][0].velocity[0]

    for angle, friction in ((0.3, 0.1), (0.5, 0.3), (0.8, 0.6)):
        expected = GRAVITY * (np.sin(angle) - friction * np.cos(angle))
        found = float(speed(angle, friction)) / (time_step * count)
        name = f"tilt {angle:g} rad, friction {friction:g}: acceleration [m/s2]"
        yield Reference("sliding cube", name, expected, found, 1e-6, "g (sin - mu cos)")
    held = float(speed(np.arctan(0.3) - 0.005, 0.3)) / (time_step * count)
    yield Reference(
        "sliding cube", "0.005 rad below the angle of friction: 1 + acceleration", 1.0, 1.0 + held, 1e-4, "it stays"
    )


def recordings() -> Iterator[Reference]:
    """SOFA's own recordings of the trunk on SOFA's mesh; nothing where they are not at hand ($RFDROPO_DATA)."""
    bounds, source = {"mean": 0.1, "max": 0.6}, "SOFA's recording"
    runs = (
        ("reach_1", "sofa_reach.toml", []),
        ("push_2", "sofa_push.toml", ["data.fit=['sofa_trunk/push_2.csv']"]),
        (
            "push_1, before contact",
            "sofa_push.toml",
            ["data.fit=[{observations='sofa_trunk/push_1.csv', rows=[0, 10]}]"],
        ),
    )
    for name, file, overrides in runs:
        try:
            model = Model.read(EXPERIMENTS / file, overrides)
            with tempfile.TemporaryDirectory() as folder:
                found = simulate_all(model, Path(folder))
        except InputError as error:
            print(f"{name}: {error}")
            continue
        for kind, bound in bounds.items():
            error = found["error_mm"][kind]
            yield Reference("SOFA's trunk", f"{name}: {kind} error [mm]", bound, error, 0.0, source, "at most")
        cube = next(iter(found["recordings"].values())).get("object_error")
        if cube is not None:
            worst = cube["position_mm"]["max"]
            yield Reference("SOFA's cube", f"{name}: largest error [mm]", 0.1, worst, 0.0, source, "at most")
