"""A robot as a chain of circular arcs under cables that only pull, or chambers: marker positions, for many guesses.

Between the heights at which cables end, the body is an arc that bends and shortens. A cable that is pulled in by
:math:`d` requires :math:`r\\,\\beta` and the shortening of all arcs below its end to add up to it, or is slack. The
body of least energy is taken: a linear complementarity problem in the tensions, solved by projected Gauss-Seidel
iterations. There is no weight. It serves a search; a rod at rest must confirm the result.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.cable import Cable
from rfdropo_bayes.robots.chamber import Chamber

ITERATIONS = 30
LOOKED, STILL = 5, 1e-2
"""Iterations between convergence checks, and the limit of a change as a share of the largest tension."""
SOFTENED = 1e-3  # softness of a cable as a share of its own compliance: redundant cables then share the load
LEAST_RADIUS = 1e-6  # [m] A chamber on the axis, which bends nothing, counts as beside it by this distance
STIFFEST = 10.0
"""Stiffness against shortening over that against bending, at the cables: more would slow the iterations down, and is
felt only by cables that pull against each other."""


class Kind(NamedTuple):
    """Cables of one kind of channel: equal end heights, at any azimuth."""

    gain: tuple[float, ...]  # cable displacement [m], or tension [N], of a unit command
    radius: tuple[float, ...]  # radius of the cables about the axis [m]
    azimuth: tuple[float, ...]  # azimuth of the cables from the first [rad]
    end: tuple[int, ...]  # index of the arc at whose end each cable ends


class Arcs(NamedTuple):
    """The chain, and the markers on it."""

    length: Float[np.ndarray, " arc"]  # length of each arc [m]
    # bending, axial: compliances of each arc: bending in radians per unit moment, shortening in metres per unit force
    bending: Float[np.ndarray, " arc"]
    axial: Float[np.ndarray, " arc"]
    # marker_arc, marker_share, marker_offset: arc of a marker, its position along the arc, and its offset from the axis
    # [m]
    marker_arc: Int[np.ndarray, " marker"]
    marker_share: Float[np.ndarray, " marker"]
    marker_offset: Float[np.ndarray, "marker 2"]
    pulled: bool  # commands impose lengths, else tensions

    def markers(
        self,
        command: Float[np.ndarray, "guess row cable"],
        arm: Float[np.ndarray, "guess cable 3 arc"],
        use: np.ndarray,
    ) -> Float[np.ndarray, "guess row marker 3"]:
        """Positions of the markers [m], relative to the straight body's base.

        Args:
            command: displacement of each cable [m], or its tension.
            arm: shortening of a cable per radian of an arc's bending towards x, towards y, and per shortening.
            use: (guess, cable), whether the cable exists.
        """
        guesses, cables = arm.shape[:2]
        softness = np.stack([self.bending, self.bending, self.axial])
        flat = arm.reshape(guesses, cables, -1)
        soft = flat * softness.reshape(-1)
        if self.pulled:
            tension = _tensions(np.einsum("gck,gdk->gcd", flat, soft), command, use)
        else:
            tension = np.where(use[:, None], np.maximum(command, 0.0), 0.0)
        bent = np.matmul(tension, soft).reshape(guesses, command.shape[1], 3, -1)
        return self._placed(bent)

    def _placed(self, bent: Float[np.ndarray, "guess row 3 arc"]) -> Float[np.ndarray, "guess row marker 3"]:
        shape = bent.shape[:2]
        place, frame = np.zeros((*shape, 3)), np.broadcast_to(np.eye(3), (*shape, 3, 3))
        placed = np.zeros((*shape, len(self.marker_arc), 3))
        for arc, length in enumerate(self.length):
            for marker in np.flatnonzero(self.marker_arc == arc):
                share = float(self.marker_share[marker])
                way, turned = _arc(share * bent[..., arc], share * length)
                there = place + np.einsum("...ij,...j->...i", frame, way)
                offset = turned[..., :2] @ self.marker_offset[marker]
                placed[:, :, marker] = there + np.einsum("...ij,...j->...i", frame, offset)
            way, turned = _arc(bent[..., arc], length)
            place = place + np.einsum("...ij,...j->...i", frame, way)
            frame = frame @ turned
        return placed


def _tensions(
    give: Float[np.ndarray, "guess cable cable"], asked: Float[np.ndarray, "guess row cable"], use: np.ndarray
) -> Float[np.ndarray, "guess row cable"]:
    """Tensions of cables of imposed lengths, with unneeded cables slack."""
    there = np.flatnonzero(use.any(axis=0))
    own = np.einsum("gcc->gc", give) * (1.0 + SOFTENED)
    # One cable after the other, contiguous in memory: most of a search is spent here.
    soft = np.ascontiguousarray(np.moveaxis(give, 0, -1))[..., None]
    wanted = np.ascontiguousarray(np.moveaxis(asked, -1, 0)) / own.T[..., None]
    tension = np.zeros((use.shape[1], len(give), asked.shape[1]))
    for iteration in range(ITERATIONS):
        largest = change = 0.0
        for c in there:
            reached = sum(soft[c, d] * tension[d] for d in there)
            new = tension[c] + wanted[c] - reached / own[:, c, None]
            np.maximum(new, 0.0, out=new)
            new *= use[:, c, None]
            if iteration % LOOKED == LOOKED - 1:
                change = max(change, float(np.abs(new - tension[c]).max()))
                largest = max(largest, float(new.max()))
            tension[c] = new
        if iteration % LOOKED == LOOKED - 1 and change <= STILL * largest:
            break
    return np.moveaxis(tension, 0, -1)


def _arc(
    bent: Float[np.ndarray, "*n 3"], length: float
) -> tuple[Float[np.ndarray, "*n 3"], Float[np.ndarray, "*n 3 3"]]:
    """Way along an arc that bends by ``bent[:2]`` towards x and y [rad] and is shorter by ``bent[2]`` [m], and the
    frame at its end."""
    angle = np.hypot(bent[..., 0], bent[..., 1])
    safe = np.maximum(angle, 1e-9)
    x, y = bent[..., 0] / safe, bent[..., 1] / safe
    whole = length - bent[..., 2]
    s, c = np.sin(angle), np.cos(angle)
    across = whole * (1.0 - c) / safe
    way = np.stack([across * x, across * y, whole * np.where(angle > 1e-9, s / safe, 1.0)], axis=-1)
    row = np.stack(
        [
            np.stack([1.0 + (c - 1.0) * x * x, (c - 1.0) * x * y, s * x], axis=-1),
            np.stack([(c - 1.0) * x * y, 1.0 + (c - 1.0) * y * y, s * y], axis=-1),
            np.stack([-s * x, -s * y, c], axis=-1),
        ],
        axis=-2,
    )
    return way, row


def _as_cable(each: Cable | Chamber) -> tuple[Cable, float]:
    """A cable, and its force per unit of its drive; for a chamber a cable on the other side of the axis, which bends
    the body the same way."""
    if isinstance(each, Cable):
        return each, 1.0
    radius = max(each.radius_m, LEAST_RADIUS)
    cable = Cable(
        name=each.name, azimuth_deg=each.azimuth_deg + 180.0, anchor_z_m=each.z_m[0], anchor_radius_m=radius,
        guide_z_m=each.z_m[1:], guide_radius_m=(radius,), drive="tension", tension_limit_n=(0.0, 1.0),
    )  # fmt: skip
    return cable, each.area_m2


def arcs_of(robot: Robot, markers: tuple[str, ...]) -> tuple[Arcs, list[Kind], list[tuple[int, float]]]:
    """The chain of a robot; the kinds of its channels; and of each channel its kind and azimuth [rad]."""
    station = np.array(robot.body.station_m)
    cables, forces = zip(*(_as_cable(each) for each in robot.actuators), strict=True)
    ends = sorted({round(cable.end_m, 9) for cable in cables})
    base = min(cable.anchor_z_m for cable in cables)
    tip = max([*ends, *(marker.point_m[2] for marker in robot.markers)])
    cuts = np.array([base, *ends, *([tip] if tip > ends[-1] + 1e-9 else [])])
    length = np.diff(cuts)
    layer = np.clip(np.minimum.outer(cuts[1:], station[1:]) - np.maximum.outer(cuts[:-1], station[:-1]), 0.0, None)
    moment = np.array(robot.body.bending_moment_area_m4).mean(axis=1)
    area = np.array(robot.body.axial_area_m2)
    modulus = robot.nominal()["young_modulus"]
    bending = layer @ (1.0 / moment) / modulus
    radius = float(np.mean([r for cable in cables for r in cable.guide_radius_m]))
    axial = np.maximum(bending * radius**2 / STIFFEST, layer @ (1.0 / area) / modulus)
    shown = [next(m for m in robot.markers if m.name == name) for name in markers]
    height = np.array([marker.point_m[2] for marker in shown])
    at = np.clip(np.searchsorted(cuts, height - 1e-9) - 1, 0, len(length) - 1)
    share = np.clip((height - cuts[at]) / length[at], 0.0, 1.0)
    offset = np.array([marker.point_m[:2] for marker in shown]).reshape(-1, 2)
    chain = Arcs(length, bending, axial, at, share, offset, not robot.held_by_force)
    kinds, channels = [], []
    matrix = np.array(forces)[:, None] * np.asarray(robot.channel_matrix(robot.nominal()), float)
    for column in matrix.T:
        moved = np.flatnonzero(column)
        moved = moved[np.argsort([-ends.index(round(cables[c].end_m, 9)) for c in moved], kind="stable")]
        first = np.radians(cables[moved[0]].azimuth_deg)
        kind = Kind(
            tuple(float(f"{column[c]:.9g}") for c in moved),
            tuple(float(f"{np.mean(cables[c].guide_radius_m):.9g}") for c in moved),
            tuple(round(float((np.radians(cables[c].azimuth_deg) - first) % (2 * np.pi)), 6) for c in moved),
            tuple(ends.index(round(cables[c].end_m, 9)) for c in moved),
        )
        if kind not in kinds:
            kinds.append(kind)
        channels.append((kinds.index(kind), float(first)))
    return chain, kinds, channels


def arms(chain: Arcs, kind: Kind, azimuth: Float[np.ndarray, " guess"]) -> Float[np.ndarray, "guess cable 3 arc"]:
    """Shortening of the cables of a channel of this kind as the arcs bend and shorten, at each azimuth [rad]."""
    arcs = np.arange(len(chain.length))
    parts = []
    for radius, beside, end in zip(kind.radius, kind.azimuth, kind.end, strict=True):
        reach = (arcs <= end).astype(float)
        angle = azimuth + beside
        parts.append(
            np.stack(
                [
                    radius * np.cos(angle)[:, None] * reach,
                    radius * np.sin(angle)[:, None] * reach,
                    np.broadcast_to(reach, (len(azimuth), len(arcs))),
                ],
                axis=1,
            )
        )
    return np.stack(parts, axis=1)
