"""A rod written down anew, dense and slow: strains, their derivatives, steps and equilibria, in NumPy.

Nothing of the engines is used: rotations are matrices, the maps from velocities to strains are matrices of 6 x 12, a
step solves one dense system, and the cables are found by trying which of them pull.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from rfdropo_bayes.fem.cables import ROUND
from rfdropo_bayes.fem.rod import SHEAR, inertia_per_density

SOFTNESS = 1e-9
"""Of cables, relative to how far they give way: as ``fem.constraints.CABLE_SOFTNESS``."""


def hat(a: np.ndarray) -> np.ndarray:
    """Matrix of the cross product with a vector."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Product of two quaternions (w, x, y, z)."""
    return np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])])


def matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrix of a unit quaternion."""
    return np.eye(3) + 2.0 * q[0] * hat(q[1:]) + 2.0 * hat(q[1:]) @ hat(q[1:])


def turned(q: np.ndarray, a: np.ndarray) -> np.ndarray:
    """A quaternion turned by a rotation vector in space."""
    new = q + 0.5 * (1.0 + a @ a / 12.0) * product(np.concatenate([[0.0], a]), q)
    return new / np.linalg.norm(new)


class Shape:
    """Places of all stations, and rotations as quaternions."""

    def __init__(self, body: Any) -> None:
        self.place = np.stack([0.0 * body.station, 0.0 * body.station, body.station], axis=1)
        self.turn = np.tile([1.0, 0.0, 0.0, 0.0], (len(body.station), 1))

    def moved(self, change: np.ndarray) -> Shape:
        """Stations displaced by the first three of six numbers each, and turned by the others."""
        new = object.__new__(Shape)
        new.place = self.place + change[:, :3]
        new.turn = np.array([turned(q, a) for q, a in zip(self.turn, change[:, 3:], strict=True)])
        return new


def shear_share(body: Any, material: Any, e: int) -> np.ndarray:
    """Flexibility of an element in S-shaped bending over that in shear, along x and y."""
    flexible = 2.0 * (1.0 + material.poisson_ratio) / (SHEAR * body.axial_area[e])
    return np.diff(body.station)[e] ** 2 / (12.0 * body.bending_moment_area[e]) / flexible


def strains(body: Any, material: Any, shape: Shape, e: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Strains of an element, their derivatives by the twists of both stations (6, 12), and these with the stretch of
    the chord and its arc alone."""
    first, second = shape.turn[e], shape.turn[e + 1]
    if first @ second < 0.0:
        second = -second
    between = product(first * [1.0, -1.0, -1.0, -1.0], second)
    middle = matrix((first + second) / np.linalg.norm(first + second))
    chord, h = shape.place[e + 1] - shape.place[e], np.diff(body.station)[e]
    strain = np.concatenate([middle.T @ chord / h - [0.0, 0.0, 1.0], 2.0 * between[1:] / h])
    u = middle @ between[1:]
    w, g = np.eye(3) - np.outer(u, u) / (1.0 + between[0]), hat(u / (1.0 + between[0]))
    levers = [hat(chord) @ (np.eye(3) + sign * g) / 2.0 for sign in (1.0, -1.0)]
    none = np.zeros((3, 3))
    rows = np.block([[-np.eye(3), levers[0], np.eye(3), levers[1]], [none, -w, none, w]])
    rows = np.kron(np.eye(2), middle.T) @ rows / h
    # An arc, and an S, are longer than their chords: the second order of both in the strains, with the stretch's share.
    share, stiff = shear_share(body, material, e), SHEAR / (2.0 * (1.0 + material.poisson_ratio))
    arc, left, along = h**2 / 24.0 * strain[3:5] @ strain[3:5], 1.0 / (1.0 + share), strain[2]
    shorter, first = 1.0 - 1.0 / stiff, (1.0 - stiff) * share * left**2
    bounded, rise = along / (1.0 + 4.0 * along**2), (1.0 - 4.0 * along**2) / (1.0 + 4.0 * along**2) ** 2
    slope = first * (1.0 + 0.5 * shorter * bounded) + 0.6 * (share * left) ** 2
    steep = 1.0 + rise * shorter * (arc + 0.5 * first @ strain[:2] ** 2)
    strain[2] += arc * (1.0 + shorter * bounded) + slope @ strain[:2] ** 2
    bow = h**2 / 12.0 * (1.0 + shorter * bounded) * strain[3:5]
    straight = rows.copy()
    straight[2] += bow @ rows[3:5] / steep
    rows[2] = steep * straight[2] + 2.0 * slope * strain[:2] @ rows[:2]
    return strain, rows, straight


def stiffness(body: Any, material: Any, e: int) -> np.ndarray:
    """Stiffness of a section: shear twice, stretch, bending about x and about y, twist."""
    young = material.young_modulus * material.stiffness_scale[e]
    shear = young / (2.0 * (1.0 + material.poisson_ratio))
    about_y, about_x = body.bending_moment_area[e]
    area, left = body.axial_area[e], 1.0 / (1.0 + shear_share(body, material, e))
    return np.array(
        [
            *(left * SHEAR * shear * area),
            young * area,
            young * about_x,
            young * about_y,
            shear * body.torsion_constant[e],
        ]
    )


def energy(body: Any, material: Any, shape: Shape) -> float:
    """Elastic energy [J] of a linear rod."""
    length = np.diff(body.station)
    parts = [
        (strains(body, material, shape, e)[0], stiffness(body, material, e), length[e]) for e in range(body.elements)
    ]
    return sum(0.5 * h * strain @ (stiff * strain) for strain, stiff, h in parts)


def guides_of(system: Any, shape: Shape, cable: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a cable from its anchor on, and their derivatives (points, 3, stations, 6)."""
    layout, stations = system.cables, len(system.body.station)
    points, rows = [layout.anchor[cable]], [np.zeros((3, stations, 6))]
    for guide in np.flatnonzero(layout.used[cable]):
        point, row = np.zeros(3), np.zeros((3, stations, 6))
        parts = (part[cable, guide] for part in (layout.station, layout.weight, layout.arm))
        for station, weight, arm in zip(*parts, strict=True):
            lever = matrix(shape.turn[station]) @ arm
            point += weight * shape.place[station] + lever
            row[:, station, :3] += weight * np.eye(3)
            row[:, station, 3:] -= hat(lever)
        points.append(point)
        rows.append(row)
    return np.array(points), np.array(rows)


def way_law(distance: float, near: float) -> tuple[float, float, float]:
    """How long a way counts, and its first and second derivative by the distance: guides have a size."""
    if distance > near:
        return distance, 1.0, 0.0
    x = distance / near
    return near * (3.0 + 6.0 * x**2 - x**4) / 8.0, (3.0 * x - x**3) / 2.0, 1.5 * (1.0 - x**2) / near


def ways_of(system: Any, shape: Shape, cable: int) -> list[tuple[np.ndarray, np.ndarray, tuple[float, float, float]]]:
    """Ways of a cable from point to point: direction, its derivative (3, stations, 6), and its law."""
    (points, rows), (rest, _) = guides_of(system, shape, cable), guides_of(system, Shape(system.body), cable)
    near = ROUND * np.linalg.norm(np.diff(rest, axis=0), axis=1)
    result = []
    for way, change, close in zip(np.diff(points, axis=0), np.diff(rows, axis=0), near, strict=True):
        distance = float(np.linalg.norm(way))
        result.append((way / distance, change, way_law(distance, close)))
    return result


def cable_rows(system: Any, shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of all cables, and their derivatives (cables, stations * 6)."""
    lengths, rows = [], []
    for cable in range(len(system.cables.anchor)):
        ways = ways_of(system, shape, cable)
        lengths.append(sum(law[0] for _, _, law in ways))
        parts = (law[1] * np.einsum("i,isk->sk", way, change).ravel() for way, change, law in ways)
        rows.append(sum(parts, np.zeros(6 * len(system.body.station))))
    return np.array(lengths), np.reshape(rows, (len(lengths), 6 * len(system.body.station)))


def held(system: Any, material: Any, shape: Shape, tension: np.ndarray) -> np.ndarray:
    """Stiffness (stations * 6, stations * 6) of the second derivatives of all ways by the strains of the elements that
    they run beside: a straight way that holds several elements is taken to hold each."""
    station, length = system.body.station, np.diff(system.body.station)
    total = np.zeros((6 * len(station), 6 * len(station)))
    for cable, pull in enumerate(tension):
        rest, _ = guides_of(system, Shape(system.body), cable)
        points, _ = guides_of(system, shape, cable)
        guides = np.flatnonzero(system.cables.used[cable])
        arms = [_arm(system, shape, cable, guide) for guide in guides]
        for g, (way, _, law) in enumerate(ways_of(system, shape, cable)):
            distance = float(np.linalg.norm(points[g + 1] - points[g]))
            second = pull * (law[1] / distance * (np.eye(3) - np.outer(way, way)) + law[2] * np.outer(way, way))
            low, high = sorted([rest[g, 2], rest[g + 1, 2]])
            for e, h in enumerate(length):
                first, last = max(low, station[e]), min(high, station[e + 1])
                if last <= first:
                    continue
                along = (0.5 * (first + last) - rest[g, 2]) / (rest[g + 1, 2] - rest[g, 2])
                arm = along * arms[g] + (1.0 - along) * arms[max(g - 1, 0)]
                a, b = shape.turn[e], shape.turn[e + 1] * np.sign(shape.turn[e] @ shape.turn[e + 1])
                middle = matrix((a + b) / np.linalg.norm(a + b))
                rows = h * np.kron(np.eye(2), middle) @ strains(system.body, material, shape, e)[2]
                change = rows[:3] - hat(arm) @ rows[3:]
                share = (last - first) * np.linalg.norm(rest[g + 1] - rest[g]) / h**2
                both = slice(6 * e, 6 * e + 12)
                total[both, both] += share * change.T @ second @ change
    return total


def _arm(system: Any, shape: Shape, cable: int, guide: int) -> np.ndarray:
    """Offset of a guide from the axis, in space."""
    stations, arms = system.cables.station[cable, guide], system.cables.arm[cable, guide]
    return sum((matrix(shape.turn[k]) @ arm for k, arm in zip(stations, arms, strict=True)), np.zeros(3))


def pulls(compliance: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Impulses of cables that pull only: those of the set that neither pushes nor leaves a cable too long."""
    count = len(free)
    soft = compliance + SOFTNESS * np.diag(np.diag(compliance))
    for size in range(count + 1):
        for taut in itertools.combinations(range(count), size):
            impulse, rows = np.zeros(count), list(taut)
            if rows:
                impulse[rows] = np.linalg.solve(soft[np.ix_(rows, rows)], -free[rows])
            slack = free + compliance @ impulse
            if np.all(impulse >= 0.0) and np.all(np.delete(slack, rows) >= 0.0):
                return impulse
    raise AssertionError("no set of taut cables")


def inertia(system: Any, material: Any, shape: Shape) -> np.ndarray:
    """Mass matrix (stations, 6, 6) in space."""
    volume, moment = inertia_per_density(system.body)
    total = np.zeros((len(volume), 6, 6))
    for k, q in enumerate(shape.turn):
        turn = matrix(q)
        total[k, :3, :3] = (material.density * volume[k] + material.point_mass[k]) * np.eye(3)
        total[k, 3:, 3:] = material.density * (turn * moment[k]) @ turn.T
    return total


class Motion:
    """A rod in motion under its weight and cables that pull only: a linear body without effects."""

    def __init__(self, system: Any, material: Any, integrator: str) -> None:
        self.system, self.material, self.integrator = system, material, integrator
        self.shape = Shape(system.body)
        self.velocity = np.zeros((len(system.body.station), 6))
        self.tension = np.zeros(len(system.cables.anchor))
        self.rest = cable_rows(system, self.shape)[0]
        self.command = np.zeros(len(self.rest))

    def step(self, command: np.ndarray, time_step: float) -> None:
        """A step to the commanded displacements [m]."""
        g = 1.0 - 1.0 / np.sqrt(2.0)
        if self.integrator == "euler":
            self._stage(command, time_step, time_step, None)
        else:
            before = self.velocity
            self._stage(self.command + g * (command - self.command), g * time_step, g * time_step, None)
            change = (1.0 - 2.0 * g) / g * (self.velocity - before)
            self._stage(command, (1.0 - g) * time_step, g * time_step, change)
        self.command = command

    def _stage(self, command: np.ndarray, elapsed: float, p: float, carried: np.ndarray | None) -> None:
        system, material, velocity = self.system, self.material, self.velocity
        euler, stations = self.integrator == "euler", len(velocity)
        shape = self.shape if euler else self.shape.moved(elapsed * velocity)
        mass = inertia(system, material, shape)
        beta, alpha = material.rayleigh_stiffness, material.rayleigh_mass
        size = 6 * stations
        matrix_, right = np.zeros((size, size)), np.zeros((stations, 6))
        for k in range(stations):
            rows = slice(6 * k, 6 * k + 6)
            matrix_[rows, rows] += (1.0 + p * alpha) * mass[k]
            spin = velocity[k, 3:]
            right[k] -= p * alpha * mass[k] @ velocity[k]
            right[k, :3] += p * mass[k, 0, 0] * np.asarray(material.gravity)
            right[k, 3:] -= p * np.cross(spin, mass[k, 3:, 3:] @ spin)
            if carried is not None:
                right[k] += mass[k] @ carried[k]
        length = np.diff(system.body.station)
        for e in range(system.body.elements):
            strain, rows, _ = strains(system.body, material, shape, e)
            stiff, h = stiffness(system.body, material, e), length[e]
            rate = rows @ velocity[e : e + 2].ravel()
            behind = p + beta if euler else beta
            force = rows.T @ (h * stiff * (strain + behind * rate))
            right[e : e + 2] -= p * force.reshape(2, 6)
            both = slice(6 * e, 6 * e + 12)
            matrix_[both, both] += p * (p + beta) * h * (rows.T * stiff) @ rows
        taut = p * p * held(system, material, shape, self.tension)
        matrix_ += taut
        if euler:
            right -= (taut @ velocity.ravel()).reshape(right.shape)
        lengths, pull = cable_rows(system, shape)
        free = slice(6 * system.clamped_stations, size)
        solved = np.linalg.solve(matrix_[free, free], np.column_stack([right.ravel()[free], pull[:, free].T]))
        slack = (self.rest - command - lengths) / p
        if euler:
            slack = slack - pull @ velocity.ravel()
        impulse = pulls(pull[:, free] @ solved[:, 1:], slack - pull[:, free] @ solved[:, 0])
        change = np.zeros(size)
        change[free] = solved[:, 0] - solved[:, 1:] @ impulse
        change = change.reshape(stations, 6)
        self.velocity, self.tension = velocity + change, impulse / p
        self.shape = shape.moved(p * (self.velocity if euler else change))


def unbalanced(system: Any, material: Any, shape: Shape, tension: np.ndarray) -> np.ndarray:
    """Forces and moments (stations, 6) out of balance on a linear rod at rest."""
    mass, length = inertia(system, material, shape), np.diff(system.body.station)
    total = np.zeros((len(mass), 6))
    total[:, :3] = mass[:, 0, 0, None] * np.asarray(material.gravity)
    for e in range(system.body.elements):
        strain, rows, _ = strains(system.body, material, shape, e)
        force = rows.T @ (length[e] * stiffness(system.body, material, e) * strain)
        total[e : e + 2] -= force.reshape(2, 6)
    total -= (tension @ cable_rows(system, shape)[1]).reshape(total.shape)
    return total[system.clamped_stations :]
