"""Constants of a rod, its cables and its recorded points for the kernels: arrays in the precision of the kernels.

A station has six velocities: velocity and spin of the section, both in space. It has twelve rows of `frame`: the
position of the centre line and the three directors, the columns of the section's rotation. A material point is a sum of
such rows with fixed weights.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfdropo_bayes.fem.cables import ROUND
from rfdropo_bayes.fem.dynamics import LOST
from rfdropo_bayes.fem.rod import SHEAR, Rod, drag_areas, inertia_per_density, shear_ratios, tributary_lengths

SIZE = 6
"""Velocities of a station."""
FRAME = 12
"""Rows of a station's frame: position, then directors."""
SECTION = 6
"""Stiffnesses of an element: against shear along x and along y, stretch, bending about x and about y, and twist."""
INNER = 5
"""Numbers of an element's inner bending: a, c / h and c' / h^2 of ``fem.rod_elements``, the last two along x and y."""


class RodTables(NamedTuple):
    """Body, cables and recorded points. Guide g is bound to sections by the entries ``guide_first[g]:guide_first[g +
    1]``, each with a station, a weight of its position and an arm in its frame."""

    length: Float[np.ndarray, " elements"]  # [m]
    area: Float[np.ndarray, "elements 6"]  # stiffness over modulus and length: per G, G, E, E, E and per G
    ratio: Float[np.ndarray, "elements 2"]  # see ``rod.shear_ratios``
    volume: Float[np.ndarray, " stations"]  # [m3]
    moment: Float[np.ndarray, "stations 3"]  # rotary inertia per density [m5]
    rest: Float[np.ndarray, " stations"]  # axial coordinate [m]
    cable_first: Int[np.ndarray, " cables_1"]  # guides of every cable
    guide_first: Int[np.ndarray, " guides_1"]
    guide_station: Int[np.ndarray, " entries"]
    guide_weight: Float[np.ndarray, " entries"]
    guide_arm: Float[np.ndarray, "entries 3"]  # [m]
    anchor: Float[np.ndarray, "cables 3"]
    rest_length: Float[np.ndarray, " cables"]
    near: Float[np.ndarray, " guides"]  # a shorter way to a guide counts as longer, see `cables.ROUND` [m]
    beside_first: Int[np.ndarray, " elements_1"]  # pieces of the ways beside every element
    beside_cable: Int[np.ndarray, " pieces"]
    beside_guide: Int[np.ndarray, " pieces"]
    beside_start: Int[np.ndarray, " pieces"]  # guide that the way begins at; of the first way of a cable its end
    beside_share: Float[np.ndarray, " pieces"]  # see `cables.CableLayout`
    beside_along: Float[np.ndarray, " pieces"]
    beside_part: Float[np.ndarray, " pieces"]  # of the element that the piece runs beside
    row: Int[np.ndarray, " cables"]  # of a cable's border: cables with the longest reach first
    active: Int[np.ndarray, " stations"]  # panels of the border that are not zero at a station
    section_length: Float[np.ndarray, " stations"]  # of the body that a station stands for [m]
    section_area: Float[np.ndarray, " stations"]  # that times the body's width [m2]
    point_first: Int[np.ndarray, " points_1"]
    point_place: Int[np.ndarray, " entries"]  # rows of frames
    point_weight: Float[np.ndarray, " entries"]
    reach: float  # a station farther from its rest position has been lost [m]
    total: float  # length of the body [m]
    blown: Float[np.ndarray, "chambers_elements3"]  # thrust and moments about x and y by 1 Pa in an element
    thrust: Float[np.ndarray, " chambers"]  # by 1 Pa, where a chamber fills an element [N]
    held: int
    stations: int
    panels: int  # of the border
    cables: int
    chambers: int
    drives: int  # cables, then chambers
    points: int


def border_panels(cables: int) -> int:
    """Panels of three rows that hold the right-hand side and one row for every cable."""
    return (cables + 3) // 3


def section_areas(body: Rod) -> Float[np.ndarray, "elements 6"]:
    """Stiffness of every element over modulus [m] or [m3]: shear twice, stretch, bending about x and y, twist."""
    about_y, about_x = body.bending_moment_area.T
    area = [SHEAR * body.axial_area, SHEAR * body.axial_area, body.axial_area, about_x, about_y, body.torsion_constant]
    return np.stack(area, axis=1) / np.diff(body.station)[:, None]


def entries_of(points: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Entries of points bound to two sections each, without zero entries: first, station, weight and arm."""
    station, weight, arm = (np.asarray(getattr(points, name)) for name in ("station", "weight", "arm"))
    used = (weight != 0.0) | np.any(arm != 0.0, axis=-1)
    first = np.concatenate([[0], np.cumsum(used.sum(axis=1))]).astype(np.int64)
    return first, station[used].astype(np.int64), weight[used], arm[used]


def _frame_sums(points: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points as sparse sums of rows of frames: first, place, weight."""
    first, station, weight, arm = entries_of(points)
    values = np.concatenate([weight[:, None], arm], axis=1)
    place = FRAME * station[:, None] + 3 * np.arange(4)
    used = values != 0.0
    counts = np.concatenate([[0], np.cumsum(used.sum(axis=1))])
    return counts[first].astype(np.int64), place[used], values[used]


class _Guides(NamedTuple):
    """Guides of all cables, one after the other, as points."""

    station: np.ndarray
    weight: np.ndarray
    arm: np.ndarray


def _cables(layout: Any, body: Rod) -> dict[str, np.ndarray]:
    used, anchor = np.asarray(layout.used, dtype=bool), np.asarray(layout.anchor, dtype=float).reshape(-1, 3)
    guides = _Guides(layout.station[used], layout.weight[used], layout.arm[used])
    first, station, weight, arm = entries_of(guides)
    counts = used.sum(axis=1)
    cable_first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    place = guides.arm.sum(axis=1)
    place[:, 2] += np.sum(guides.weight * body.station[guides.station], axis=1)
    reach, length = np.zeros(len(anchor), dtype=int), np.zeros(len(anchor))
    for cable, (one, two) in enumerate(pairwise(cable_first)):
        route = np.concatenate([anchor[cable : cable + 1], place[one:two]])
        length[cable] = np.linalg.norm(np.diff(route, axis=0), axis=1).sum()
        reach[cable] = station[first[one] : first[two]].max()
    farthest = np.argsort(-reach, kind="stable")
    row = np.empty(len(anchor), dtype=np.int64)
    row[farthest] = 1 + np.arange(len(anchor))
    active = [border_panels(int(np.sum(reach >= k))) for k in range(len(body.station))]
    return {
        "cable_first": cable_first,
        "guide_first": first,
        "guide_station": station,
        "guide_weight": weight,
        "guide_arm": arm,
        "anchor": anchor,
        "rest_length": length,
        "near": ROUND * layout.way[used],
        **_beside(layout, np.diff(body.station)),
        "row": row,
        "active": np.array(active, dtype=np.int64),
    }


def _beside(layout: Any, length: Float[np.ndarray, " elements"]) -> dict[str, np.ndarray]:
    """Pieces of the ways to guides, sorted by the elements that they run beside."""
    number = np.cumsum(layout.used.ravel()).reshape(layout.used.shape) - 1
    cable, guide, piece = np.nonzero(layout.share)
    order = np.argsort(layout.element[cable, guide, piece], kind="stable")
    cable, guide, piece = cable[order], guide[order], piece[order]
    share = layout.share[cable, guide, piece]
    return {
        "beside_first": np.searchsorted(layout.element[cable, guide, piece], np.arange(len(length) + 1)),
        "beside_cable": cable,
        "beside_guide": number[cable, guide],
        "beside_start": number[cable, np.maximum(guide - 1, 0)],
        "beside_share": share,
        "beside_along": layout.along[cable, guide, piece],
        "beside_part": share * length[layout.element[cable, guide, piece]] / layout.way[cable, guide],
    }


def rod_tables(system: Any, points: Any, dtype: type) -> RodTables:
    """Tables of a rod with cables and recorded points, in the precision of the kernels."""
    body: Rod = system.body
    volume, moment = inertia_per_density(body)
    point_first, point_place, point_weight = _frame_sums(points)
    cables, layout = len(system.cables.anchor), system.chambers
    layout = np.zeros((0, body.elements, SIZE)) if layout is None else layout
    tables = RodTables(
        length=np.diff(body.station),
        area=section_areas(body),
        ratio=shear_ratios(body),
        volume=volume,
        moment=moment,
        rest=body.station,
        **_cables(system.cables, body),
        section_length=tributary_lengths(body),
        section_area=drag_areas(body),
        point_first=point_first,
        point_place=point_place,
        point_weight=point_weight,
        reach=float(LOST * body.length),
        total=body.length,
        blown=layout[:, :, 2:5].ravel(),
        thrust=layout[:, :, 2].max(axis=1),
        held=int(system.clamped_stations),
        stations=len(body.station),
        panels=border_panels(cables),
        cables=cables,
        chambers=len(layout),
        drives=system.drives,
        points=len(points.station),
    )
    return RodTables(*(as_kernel_array(value, dtype) for value in tables))


def as_kernel_array(value: np.ndarray | float, dtype: type) -> np.ndarray | float:
    """An array in the precision of the kernels; numbers as they are.

    It can be written to: Numba compiles a second kernel, which takes half a minute, for an array that cannot.
    """
    if not isinstance(value, np.ndarray):
        return value
    return np.require(value, dtype if value.dtype.kind == "f" else value.dtype, ("C", "W"))
