"""Displacement-driven cables that can pull but not push, through guides on the sections of a rod.

A cable runs straight from a fixed anchor through guide points of the body to the last guide, to which it is tied. Its
length may not exceed the commanded one; tension and slack are complementary (Signorini's condition, which
``fem.constraints`` solves).

Guides have a size: they touch before the segment between them has zero length. A segment shorter than ``ROUND`` of its
rest length counts as longer, by a smooth law, which keeps its direction defined and its stiffness bounded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.components import Matrix, Vector, cross, dot, skew, times
from rfdropo_bayes.fem.rod import Rod, attach

ROUND = 0.25
"""Share of its rest length below which a segment counts as longer. ASSUMED: necks compressed this far stand for
touching discs; with half of it, a step of 10 ms passes through the contact.
"""
TINY = 1e-30
"""[m2] Keeps the derivative of a way without length finite."""


class CableLayout(NamedTuple):
    """Cables of a rod; rows of unused guides repeat the last used one. NumPy arrays, fixed for a simulation.

    The way to a guide begins at the guide before it, or at the anchor. It runs beside elements, whose ends it holds
    against each other as a taut string does: one beside several elements is taken to hold each of them, one beside a
    part of an element that part.
    """

    anchor: Float[np.ndarray, "cables 3"]  # fixed in space [m]
    station: Int[np.ndarray, "cables guides 2"]  # of a guide, as in ``rod.PointMap``
    weight: Float[np.ndarray, "cables guides 2"]
    arm: Float[np.ndarray, "cables guides 2 3"]  # [m]
    used: Bool[np.ndarray, "cables guides"]
    way: Float[np.ndarray, "cables guides"]  # to a guide, at rest [m]
    element: Int[np.ndarray, "cables guides pieces"]  # that the way to a guide runs beside
    share: Float[np.ndarray, "cables guides pieces"]  # of the way's stiffness that the element sees; zero for none
    along: Float[np.ndarray, "cables guides pieces"]  # share of the way in the middle of the piece


def cable_layout(
    body: Rod, anchors: Float[np.ndarray, "cables 3"], guides: Sequence[Float[np.ndarray, "guides 3"]]
) -> CableLayout:
    """Cables from fixed anchors through guide points of the undeformed body [m]; each may have its own number of
    guides.

    Raises:
        InputError: a cable without guides, or with two successive points at the same place.
    """
    anchors, points, used = routed(anchors, guides)
    bound = attach(body, points.reshape(-1, 3))
    station, weight, arm = (part.reshape(*used.shape, *part.shape[1:]) for part in bound)
    return CableLayout(anchors, station, weight, arm, used, *_ways(body, anchors, points, used))


def _ways(
    body: Rod, anchors: np.ndarray, points: np.ndarray, used: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lengths of the ways to all guides, and their pieces beside elements: element, share of stiffness and place."""
    before = np.concatenate([anchors[:, None], points[:, :-1]], axis=1)
    way = np.where(used, np.linalg.norm(points - before, axis=-1), 1.0)
    low, rise = np.minimum(before, points)[..., 2, None], (points - before)[..., 2, None]
    ends = np.clip(body.station, low, low + np.abs(rise))
    covered, middle = np.where(used[..., None], np.diff(ends), 0.0), 0.5 * (ends[..., 1:] + ends[..., :-1])
    share = covered * way[..., None] / np.diff(body.station) ** 2
    along = (middle - before[..., 2, None]) / np.where(rise == 0.0, 1.0, rise)
    pieces = max(int(np.max(np.sum(share > 0.0, axis=-1), initial=1)), 1)
    element = np.sort(np.argsort(share == 0.0, axis=-1, kind="stable")[..., :pieces], axis=-1)
    return way, element, np.take_along_axis(share, element, -1), np.take_along_axis(along, element, -1)


def routed(
    anchors: Float[np.ndarray, "cables 3"], guides: Sequence[Float[np.ndarray, "guides 3"]]
) -> tuple[Float[np.ndarray, "cables 3"], Float[np.ndarray, "cables guides 3"], Bool[np.ndarray, "cables guides"]]:
    """Anchors and guides of cables [m] as arrays, the last guide of a cable repeated, and which guides are used.

    Raises:
        InputError: a cable without guides, or with two successive points at the same place.
    """
    anchors = np.asarray(anchors, dtype=float).reshape(-1, 3)
    if len(anchors) != len(guides):
        raise InputError(f"{len(anchors)} anchors but {len(guides)} lists of guides", where="cables")
    most = max((len(points) for points in guides), default=1)
    padded, used = np.zeros((len(guides), most, 3)), np.zeros((len(guides), most), dtype=bool)
    for cable, points in enumerate(guides):
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        if len(points) == 0:
            raise InputError("no guide point", where=f"cable {cable}", remedy="give the point to which it is tied")
        steps = np.linalg.norm(np.diff(np.concatenate([anchors[cable : cable + 1], points]), axis=0), axis=1)
        if not np.all(steps > 1e-9):
            raise InputError("two successive points coincide", where=f"cable {cable}", remedy="remove one of them")
        padded[cable] = np.concatenate([points, np.repeat(points[-1:], most - len(points), axis=0)])
        used[cable, : len(points)] = True
    return anchors, padded, used


def routes(layout: CableLayout, body: Rod) -> list[Float[np.ndarray, "points 3"]]:
    """Anchor and guides of every cable on the undeformed body [m]."""
    height = np.einsum("cgs,cgs->cg", layout.weight, body.station[layout.station])
    place = layout.arm.sum(axis=2) + height[..., None] * [0.0, 0.0, 1.0]
    return [
        np.vstack([anchor, points[used]])
        for anchor, points, used in zip(layout.anchor, place, layout.used, strict=True)
    ]


class Threads(NamedTuple):
    """The numbers of a layout, components first."""

    anchor: Float[Array, "3 cables ..."]
    weight: Float[Array, "cables guides sides ..."]
    arm: Float[Array, "3 cables guides sides ..."]


class Courses(NamedTuple):
    """Courses of cables."""

    length: Float[Array, "cables guides ..."]  # from the previous point to each guide [m]; zero if unused
    direction: Float[Array, "3 cables guides ..."]  # its derivative by the guide's place, zero if unused
    inverse: Float[Array, "cables guides ..."]  # its second derivative is inverse - sharp * direction direction' [1/m]
    sharp: Float[Array, "cables guides ..."]
    lever: Float[Array, "3 cables guides sides ..."]  # of the guides, in space [m]

    @property
    def pull(self) -> Float[Array, "3 cables guides ..."]:
        """Derivatives of the cables' lengths by the guides' places."""
        return self.direction - jnp.concatenate(
            [self.direction[:, :, 1:], jnp.zeros_like(self.direction[:, :, :1])], axis=2
        )


def _sides(layout: CableLayout) -> int:
    """Stations that a guide is bound to at most."""
    second = layout.weight[..., 1:].any() or layout.arm[..., 1:, :].any()
    return 2 if second else 1


def _stations(layout: CableLayout) -> Int[np.ndarray, "cables_or_1 guides sides"]:
    """Stations of the guides. Cables that share the stations of their guides, as most do, have a first axis of length
    1, so that fewer parts are gathered.
    """
    station = layout.station[:, :, : _sides(layout)]
    if not len(station):
        return station
    longest = np.argmax(layout.used.sum(axis=1))
    same = (station == station[longest]).all(axis=-1) | ~layout.used
    return station[longest : longest + 1] if same.all() else station


def _gathered(values: Float[Array, "k n ..."], index: Int[np.ndarray, " m"]) -> Float[Array, "m k ..."]:
    """Parts of the second axis, which becomes the first.

    On lanes a loop copies long rows. Without lanes, a product with a 0-1 matrix is fast in both modes of
    differentiation.
    """
    if values.ndim == 2:
        return (index[:, None] == np.arange(values.shape[1])).astype(float) @ values.T
    return lax.map(lambda place: lax.dynamic_index_in_dim(values, place, 1, keepdims=False), index)


def threads(layout: CableLayout) -> Threads:
    """The numbers of a layout, as arguments of ``courses`` and ``station_rows``."""
    sides = _sides(layout)
    arm = np.moveaxis(layout.arm[:, :, :sides], -1, 0)
    return Threads(jnp.asarray(layout.anchor.T), jnp.asarray(layout.weight[:, :, :sides]), jnp.asarray(arm))


def courses(layout: CableLayout, thread: Threads, position: Vector, frame: Matrix) -> Courses:
    """Courses of the cables, from the places and frames of the stations."""
    index, lanes = _stations(layout), position.shape[2:]
    parts = _gathered(jnp.concatenate([position, frame.reshape(9, *frame.shape[2:])]), index.ravel())
    parts = jnp.moveaxis(parts, 0, 1).reshape(12, *index.shape, *lanes)
    here, turn = parts[:3], parts[3:].reshape(3, 3, *index.shape, *lanes)
    lever = times(turn, thread.arm)
    bound = thread.weight * here + lever
    place = sum((bound[:, :, :, side] for side in range(1, bound.shape[3])), bound[:, :, :, 0])
    anchor = jnp.broadcast_to(thread.anchor[:, :, None], (*place.shape[:2], 1, *place.shape[3:]))
    points = jnp.concatenate([anchor, place], axis=2)
    used = layout.used.reshape(*layout.used.shape, *[1] * (place.ndim - 3))
    unit = np.array([1.0, 0.0, 0.0]).reshape(3, *[1] * (place.ndim - 1))
    segment = jnp.where(used, points[:, :, 1:] - points[:, :, :-1], unit)
    near = (ROUND * layout.way).reshape(used.shape)
    distance = jnp.sqrt(dot(segment, segment) + TINY)
    share = jnp.minimum(distance / near, 1.0)
    square, far = share * share, distance > near
    length = jnp.where(far, distance, near * (0.375 + square * (0.75 - 0.125 * square)))
    inverse = jnp.where(far, 1.0 / distance, (1.5 - 0.5 * square) / near)
    sharp = jnp.where(far, inverse, 1.0 / (inverse * inverse * near**3))
    return Courses(jnp.where(used, length, 0.0), jnp.where(used, segment * inverse, 0.0), inverse, sharp, lever)


def _entries(station: Int[np.ndarray, " bound"], used: Bool[np.ndarray, " bound"], stations: int) -> np.ndarray:
    """For every station the places in a list of guides' sides that are there, in rows; one past the last for none."""
    places_by_station = [np.flatnonzero(used & (station == number)) for number in range(stations)]
    most = max((len(places) for places in places_by_station), default=0) or 1
    return np.stack(
        [np.pad(places, (0, most - len(places)), constant_values=len(station)) for places in places_by_station], axis=1
    )


def station_rows(
    layout: CableLayout,
    thread: Threads,
    lever: Float[Array, "3 cables guides sides ..."],
    pull: Float[Array, "3 cables guides ..."],
    stations: int,
) -> Float[Array, "stations 6 cables ..."]:
    """Forces and moments on the stations by a unit tension of each cable."""
    pulled = jnp.broadcast_to(pull[:, :, :, None], lever.shape)
    parts = jnp.concatenate([thread.weight * pulled, cross(lever, pulled)])
    cables, lanes = lever.shape[1], lever.shape[4:]
    index, bound = (
        _stations(layout),
        ((layout.weight != 0.0) | (layout.arm != 0.0).any(axis=-1))[:, :, : lever.shape[3]],
    )
    if len(index) == cables:  # every cable has its own
        each = [
            _at_stations(parts[:, cable], index[cable], bound[cable] & layout.used[cable, :, None], stations)
            for cable in range(cables)
        ]
        return jnp.stack(each, axis=2) if each else jnp.zeros((stations, 6, 0, *lanes))
    rows = parts.reshape(6 * cables, *parts.shape[2:])
    return _at_stations(rows, index[0], bound.any(axis=0), stations).reshape(stations, 6, cables, *lanes)


def _at_stations(
    parts: Float[Array, "k guides sides ..."],
    station: Int[np.ndarray, "guides sides"],
    bound: Bool[np.ndarray, "guides sides"],
    stations: int,
) -> Float[Array, "stations k ..."]:
    """Sums over the parts bound to each station."""
    flat = parts.reshape(len(parts), -1, *parts.shape[3:])
    flat = jnp.concatenate([flat, jnp.zeros_like(flat[:, :1])], axis=1)
    index = _entries(station.ravel(), bound.ravel(), stations)
    return sum((_gathered(flat, places) for places in index[1:]), _gathered(flat, index[0]))


class TautCables(NamedTuple):
    """Stiffness of taut cables at the ends of elements: forces and moments per strain times length, in space."""

    force: Matrix  # by stretch and shear [N/m]
    mixed: Matrix  # force by bending and twist [N]
    moment: Matrix  # by bending and twist [N m]


def _outer(a: Vector, b: Vector) -> Matrix:
    return a[:, None] * b[None]


def taut_cables(layout: CableLayout, course: Courses, tension: Float[Array, "cables ..."], elements: int) -> TautCables:
    """Stiffness of the cables at a tension [N]: P times the change of every segment, with P the second derivative of
    its length.

    Together with the rod's forces that turn with its sections, this is the exact tangent of a body loaded by cables
    only.
    """
    parts = []
    for number, arm in enumerate(_arms(layout, course)):
        share = layout.share[:, :, number].reshape(*layout.share.shape[:2], *[1] * (arm.ndim - 3))
        taut = tension[:, None] * share
        a, way, turn = taut * course.inverse, course.direction, cross(course.direction, arm)
        b = taut * course.sharp
        one = jnp.eye(3).reshape(3, 3, *[1] * a.ndim)
        force = one * a - _outer(way, b * way)
        mixed = _outer(way, b * turn) - skew(a * arm)
        moment = one * (a * dot(arm, arm)) - _outer(arm, a * arm) - _outer(turn, b * turn)
        parts.append(jnp.stack([force, mixed, moment]).reshape(27, *a.shape))
    return TautCables(*_over_elements(layout, parts, elements).reshape(3, 3, 3, elements, *parts[0].shape[3:]))


def pull_beside(
    layout: CableLayout, course: Courses, tension: Float[Array, "cables ..."], length: Float[Array, "elements ..."]
) -> Float[Array, "6 elements ..."]:
    """Force and moment of the cables beside every element, in space."""
    parts = []
    for number, arm in enumerate(_arms(layout, course)):
        lanes = [1] * (arm.ndim - 3)
        share, way = (part.reshape(*part.shape, *lanes) for part in (layout.share[:, :, number], layout.way))
        pull = course.direction * (tension[:, None] * share * length[layout.element[:, :, number]] / way)
        parts.append(jnp.concatenate([pull, cross(arm, pull)]))
    return _over_elements(layout, parts, len(length))


def _arms(layout: CableLayout, course: Courses) -> Iterator[Vector]:
    """Arms in space of the middles of the ways' pieces beside elements, piece by piece [m]."""
    offset = sum((course.lever[:, :, :, side] for side in range(1, course.lever.shape[3])), course.lever[:, :, :, 0])
    before = jnp.concatenate([offset[:, :, :1], offset[:, :, :-1]], axis=2)
    for piece in range(layout.share.shape[2]):
        along = jnp.asarray(layout.along[:, :, piece]).reshape(*layout.along.shape[:2], *[1] * (offset.ndim - 3))
        yield along * offset + (1.0 - along) * before


def _over_elements(
    layout: CableLayout, parts: Sequence[Float[Array, "k cables guides ..."]], elements: int
) -> Float[Array, "k elements ..."]:
    """Sums over the pieces of ways beside each element; ``parts`` has one array for each piece of a way."""
    whole = jnp.stack(parts, axis=3)
    index, bound = layout.element, layout.share > 0.0
    if not len(index):
        return jnp.zeros((len(whole), elements, *whole.shape[4:]))
    longest = np.argmax(bound.sum(axis=(1, 2)))
    if np.all((index == index[longest]) | ~bound):
        sums = _at_stations(jnp.sum(whole, axis=1), index[longest], np.asarray(bound.any(axis=0)), elements)
    else:
        each = [_at_stations(whole[:, c], index[c], bound[c], elements) for c in range(len(index))]
        sums = sum(each[1:], each[0])
    return jnp.moveaxis(sums, 0, 1)


def lengths(course: Courses) -> Float[Array, "cables ..."]:
    """Lengths of the cables [m]."""
    parts = course.length
    return sum((parts[:, k] for k in range(1, parts.shape[1])), parts[:, 0])


def rest_lengths(layout: CableLayout, body: Rod) -> Float[np.ndarray, " cables"]:
    """Lengths of the cables on the undeformed body [m]."""
    ways = (np.diff(route, axis=0) for route in routes(layout, body))
    return np.array([np.linalg.norm(way, axis=1).sum() for way in ways])


def patterns(
    layout: CableLayout,
    thread: Threads,
    lever: Float[Array, "3 cables guides sides"],
    pulls: Float[Array, "3 many cables guides"],
    stations: int,
) -> Float[Array, "stations 6 many cables"]:
    """``station_rows`` of many pulls."""
    return jax.vmap(partial(station_rows, layout, thread, lever, stations=stations), 1, 2)(pulls)
