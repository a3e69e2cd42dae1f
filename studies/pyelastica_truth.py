"""A robot made anew in PyElastica: a Cosserat rod with the robot's sections, and cables as forces at their guides.

A section keeps its shape, as if Poisson's ratio were zero, twists with half of Young's modulus, and shears as a round
one (Cowper). A cable runs straight from guide to guide. Its pull is that of a spring in series with the commanded
length, zero where it is slack, and acts on every guide, with its lever about the axis. The rod's own stepper is
explicit, and so is damped in proportion to mass: damping in proportion to stiffness would need steps of 0.5 us.

PyElastica's own sections keep their volume: at a stretch e their axial and shear stiffness is divided by e, their
bending and twist stiffness by e^3 (Gazzola et al. 2018). The sections here keep their stiffness, as those of MuJoCo's
arm and of the package do. With nothing hidden the tips are then .06 mm apart, with PyElastica's own sections 1 mm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots import Robot
from studies.mujoco_truth import (
    CABLE,
    CABLE_DAMPING,
    CONTROL,
    ENGINE_EFFECTS,
    POISSON,
    SHEARED,
    EngineArm,
    EngineEffect,
    commanded,
    integral,
    seen_at,
)

ELEMENTS = 40  # of the package's arm the tip is .06 mm apart (rms of 5 s), with 20 elements .13
PACE = 1e-3  # [s] a step times the number of elements: twice as much diverges with 20 and with 40


class _Cables(NamedTuple):
    """Guides of all cables.

    Attributes:
        element: of each guide; -1 for one that is fixed to the base.
        share: how far along its element it lies, from 0 to 1.
        offset: from the axis in the section [m].
        rest: lengths of the cables of the undeformed arm [m].
    """

    element: np.ndarray
    share: np.ndarray
    offset: np.ndarray
    rest: np.ndarray


def _cables(robot: Robot, elements: int) -> _Cables:
    found, offsets, rests = [], [], []
    for cable in robot.cables:
        turn = np.deg2rad(cable.azimuth_deg)
        heights = np.array([cable.anchor_z_m, *cable.guide_z_m])
        radii = np.array([cable.anchor_radius_m, *cable.guide_radius_m])
        element, share = _places(robot, elements, heights)
        found.append((np.where(heights <= 0.0, -1, element), share))
        offset = np.stack([radii * np.cos(turn), radii * np.sin(turn), np.zeros_like(radii)], axis=1)
        offsets.append(offset)
        places = offset + heights[:, None] * np.array([0.0, 0.0, 1.0])
        rests.append(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    element, share = (np.array(part) for part in zip(*found, strict=True))
    return _Cables(element, share, np.array(offsets), np.array(rests))


def _nodes(robot: Robot, elements: int) -> np.ndarray:
    """Heights of the nodes [m]. The rod bends at nodes, each for half a piece to both sides: half of the first element
    lies below the base, since all of it is clamped, and the last one is half as long as the others."""
    length = float(robot.body.station_m[-1])
    return np.append((np.arange(elements + 1) - 0.5) * length / elements, length)


def _places(robot: Robot, elements: int, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Element of each height [m], and the share of it that lies below."""
    nodes = _nodes(robot, elements)
    element = np.clip(np.searchsorted(nodes, heights + 1e-9, side="right") - 1, 0, elements)
    return element, (heights - nodes[element]) / np.diff(nodes)[element]


def _pull(
    cables: _Cables,
    wanted: np.ndarray,
    before: np.ndarray,
    position: np.ndarray,
    frame: np.ndarray,
    forces: np.ndarray,
    torques: np.ndarray,
    step: float,
) -> None:
    """Add the pull of the cables to forces on nodes (3, node) [N] and torques on elements (3, element), in the axes of
    their sections [N m].

    Rows of ``frame`` are these axes, (3, 3, element). ``wanted`` are lengths of the cables without tension, ``before``
    those that they had a ``step`` [s] ago [m], which are renewed; the first is negative before the first step.
    """
    guides = cables.element.shape[1]
    place, lever, force = np.empty((guides, 3)), np.empty((guides, 3)), np.empty((guides, 3))
    for c in range(len(wanted)):
        for g in range(guides):
            k, share = cables.element[c, g], cables.share[c, g]
            if k < 0:
                place[g] = cables.offset[c, g]
                continue
            for axis in range(3):
                lever[g, axis] = np.sum(cables.offset[c, g] * frame[:, axis, k])
            place[g] = (1.0 - share) * position[:, k] + share * position[:, k + 1] + lever[g]
        length = 0.0
        for g in range(guides - 1):
            length += float(np.linalg.norm(place[g + 1] - place[g]))
        rate = (length - before[c]) / step if before[c] > 0.0 else 0.0
        before[c] = length
        tension = max(CABLE * (length - wanted[c]) + CABLE_DAMPING * rate, 0.0)
        force[:] = 0.0
        for g in range(guides - 1):
            chord = place[g + 1] - place[g]
            along = tension / np.linalg.norm(chord) * chord
            force[g] += along
            force[g + 1] -= along
        for g in range(guides):
            k, share = cables.element[c, g], cables.share[c, g]
            if k < 0:
                continue
            forces[:, k] += (1.0 - share) * force[g]
            forces[:, k + 1] += share * force[g]
            turn = np.cross(lever[g], force[g])
            for axis in range(3):
                torques[axis, k] += np.sum(frame[axis, :, k] * turn)


@cache
def _compiled() -> Any:
    import numba

    return numba.njit(_pull)


def _elastica() -> Any:
    try:
        import elastica
    except ImportError:
        remedy = "install it: pip install -r studies/requirements.txt"
        raise InputError("PyElastica is not installed", where="--truth pyelastica", remedy=remedy) from None
    return elastica


class ElasticaParts(NamedTuple):
    """What effects change in place.

    Attributes:
        mass: of the nodes [kg].
        gravity: [m/s2].
    """

    mass: np.ndarray
    gravity: np.ndarray


def _payload(parts: ElasticaParts, size: float) -> None:
    parts.mass[-1] += size


def _tilt(parts: ElasticaParts, size: float) -> None:
    x, y, z = parts.gravity
    parts.gravity[:] = [x * np.cos(size) - y * np.sin(size), x * np.sin(size) + y * np.cos(size), z]


ELASTICA_EFFECTS: dict[str, EngineEffect] = {
    "payload at the tip": replace(ENGINE_EFFECTS["payload at the tip"], model=_payload),
    "gravity tilted": replace(ENGINE_EFFECTS["gravity tilted"], model=_tilt),
    **{name: effect for name, effect in ENGINE_EFFECTS.items() if effect.model is None},
}
"""By name: what has no part in an engine is as in MuJoCo."""


@dataclass(frozen=True)
class ElasticaArm(EngineArm):
    """The robot in PyElastica, of so many pieces; its values are ``young_modulus`` [Pa], ``trunk_mass`` [kg] and
    ``rayleigh_mass`` [1/s]."""

    elements: int = ELEMENTS

    @property
    def step(self) -> float:
        """Of time [s]."""
        return PACE / self.elements

    def _recorded(self, recording: Trajectory, size: float) -> Float[np.ndarray, "time marker 3"]:
        clock, held = commanded(self.robot, recording, self.effect, size)
        path = self._path(held, size)
        if not np.isfinite(path).all():
            raise InputError("the rod does not hold the motion", where=recording.name, remedy="make the effect smaller")
        return seen_at(recording, clock, path, self.effect, size)

    def _path(self, held: Float[np.ndarray, "period cable"], size: float) -> Float[np.ndarray, "period marker 3"]:
        """Markers [m] at the start of every period for which a row of displacements [m] is held."""
        elastica = _elastica()
        cables = _cables(self.robot, self.elements)
        wanted, before = cables.rest - held[0], np.full(len(cables.rest), -1.0)
        scene, rod = self._scene(elastica, partial(_compiled(), cables, wanted, before), size)
        marked, share = _places(self.robot, self.elements, np.array([m.point_m[2] for m in self.robot.markers]))
        stepper, time = elastica.PositionVerlet(), np.float64(0.0)
        path = np.empty((len(held), len(marked), 3))
        for row, level in enumerate(held):
            nodes = rod.position_collection
            path[row] = ((1.0 - share) * nodes[:, marked] + share * nodes[:, marked + 1]).T
            wanted[:] = cables.rest - level
            for _ in range(round(CONTROL / self.step)):
                time = stepper.step(scene, time, np.float64(self.step))
        return path

    def _scene(self, elastica: Any, pull: Callable[..., None], size: float) -> tuple[Any, Any]:
        """The scene that is stepped, and the rod in it."""

        class Pull(elastica.NoForces):
            """Cables."""

            def apply_forces(self, system: Any, time: float = 0.0) -> None:
                """Add their forces and torques."""
                where = (system.position_collection, system.director_collection)
                pull(*where, system.external_forces, system.external_torques, step)
                system.shear_matrix[:] = shear * system.dilatation
                system.bend_matrix[:] = bend * system.voronoi_dilatation**3

        class Scene(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Damping):
            """What PyElastica simulates."""

        scene, rod = Scene(), self._rod(elastica)
        step, shear, bend = self.step, rod.shear_matrix.copy(), rod.bend_matrix.copy()
        parts = ElasticaParts(rod.mass, np.array(self.robot.gravity_m_s2, dtype=float))
        if self.effect is not None and self.effect.model is not None:
            self.effect.model(parts, size)
        scene.append(rod)
        fixed = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
        scene.constrain(rod).using(elastica.OneEndFixedBC, **fixed)
        scene.add_forcing_to(rod).using(elastica.GravityForces, acc_gravity=parts.gravity)
        scene.add_forcing_to(rod).using(Pull)
        constant = self.values["rayleigh_mass"]
        scene.dampen(rod).using(elastica.AnalyticalLinearDamper, uniform_damping_constant=constant, time_step=step)
        scene.finalize()
        return scene, rod

    def _rod(self, elastica: Any) -> Any:
        """The undeformed rod, with the sections of the robot's file."""
        shape, modulus = self.robot.body, self.values["young_modulus"]
        within, nodes = partial(integral, self.robot), _nodes(self.robot, self.elements)
        elements, pieces = np.maximum(nodes, 0.0), np.linspace(0.0, nodes[-1], self.elements + 1)  # their ends

        def yields(table: Any, length: Any, ends: np.ndarray) -> np.ndarray:
            """Stiffness of parts of the rod, each of a length: layers between its ends yield one after the other."""
            return length / np.array([within(1.0 / np.asarray(table), *part) for part in pairwise(ends)])

        lengths = np.diff(nodes)
        area = yields(shape.axial_area_m2, lengths, elements)  # half of the first element is the base's
        density = self.values["trunk_mass"] / within(shape.mass_area_m2, 0.0, nodes[-1])
        shear = modulus / (2.0 * (1.0 + POISSON))
        rod = elastica.CosseratRod.straight_rod(
            self.elements + 1,
            start=np.array([0.0, 0.0, nodes[0]]),
            direction=np.array([0.0, 0.0, 1.0]),
            normal=np.array([1.0, 0.0, 0.0]),
            base_length=nodes[-1] - nodes[0],
            position=np.stack([0.0 * nodes, 0.0 * nodes, nodes]),
            base_radius=np.sqrt(yields(shape.axial_area_m2, np.diff(elements), elements) / np.pi),
            density=density,
            youngs_modulus=modulus,
            shear_modulus=shear,
        )
        moment, bent = np.asarray(shape.bending_moment_area_m4), 0.5 * (lengths[1:] + lengths[:-1])
        rod.shear_matrix[:] = 0.0
        rod.shear_matrix[0, 0] = rod.shear_matrix[1, 1] = SHEARED * shear * area
        rod.shear_matrix[2, 2] = modulus * area
        rod.bend_matrix[:] = 0.0
        # The layer's plane x bends by forces along x, that is about y.
        rod.bend_matrix[0, 0] = modulus * yields(moment[:, 1], bent, pieces)
        rod.bend_matrix[1, 1] = modulus * yields(moment[:, 0], bent, pieces)
        rod.bend_matrix[2, 2] = shear * yields(shape.torsion_constant_m4, bent, pieces)
        centre = np.append(0.5 * (nodes[1:] + nodes[:-1]), nodes[-1])
        weighed = [density * within(shape.mass_area_m2, *part) for part in pairwise(centre)]
        rod.mass[:] = [weighed[0], *weighed]  # the first node is held
        return rod
