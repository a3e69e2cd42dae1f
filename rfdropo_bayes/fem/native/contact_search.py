"""Where a trunk comes near a cube and a plate, in SIMD lanes: what ``fem.pushing.find_contacts`` looks for.

Bands of the surface whose mean is far from both in every lane are passed over: what is further than ``ALARM`` exerts
nothing, so that lanes do not see what their neighbours have looked at.
"""

from __future__ import annotations

from rfdropo_bayes.fem.native.layered_step import point
from rfdropo_bayes.fem.native.simd import any_greater, fill, fma, kernel, load, square_root, store, where_greater
from rfdropo_bayes.fem.pushing import ALARM, LYING, PUSHING

FAR = 1e6
"""[m] Distance of what was not looked at."""


@kernel
def _plate_height(scene, x, y, z, token):
    """Height of a point above the plate."""
    return fma(x, scene.up[0], fma(y, scene.up[1], z * scene.up[2])) - scene.height


@kernel
def _box_distance(touch, x, y, z, token):
    """Signed distance of a point to the cube, as ``fem.contact.distance_to_box``."""
    half, zero = 0.5 * load(touch.values, 1, token), fill(0.0, touch.cube, token)
    dx, dy, dz = x - load(touch.cube, 0, token), y - load(touch.cube, 1, token), z - load(touch.cube, 2, token)
    square, deepest = zero, zero - FAR
    for j in range(3):
        local = fma(dx, load(touch.turn, j, token), fma(dy, load(touch.turn, 3 + j, token), zero))
        local = fma(dz, load(touch.turn, 6 + j, token), local)
        beyond = where_greater(local, zero, local, -local) - half
        deepest = where_greater(beyond, deepest, beyond, deepest)
        outside = where_greater(beyond, zero, beyond, zero)
        square = fma(outside, outside, square)
    return where_greater(square, zero, square_root(square), deepest)


@kernel
def _insert(touch, first, count, gap, chosen, token):
    """Take a point into an ascending list of fixed length; of equal ones, the earlier stays before."""
    for s in range(first, first + count):
        other, index = load(touch.gap, s, token), load(touch.nearest, s, token)
        store(touch.gap, s, where_greater(other, gap, gap, other))
        store(touch.nearest, s, where_greater(other, gap, chosen, index))
        chosen = where_greater(other, gap, index, chosen)
        gap = where_greater(other, gap, other, gap)


@kernel
def _search_band(scene, band, position, touch, cube_near, token):
    """Offer the band's nearest points, to the cube and to the plate."""
    far, none = fill(FAR, touch.cube, token), fill(-1.0, touch.cube, token)
    gap, chosen, low, lowest = far, none, far, none
    for k in range(scene.band_first[band], scene.band_first[band + 1]):
        p = scene.member[k]
        number = fill(float(p), touch.cube, token)
        x, y, z = point(scene.first, scene.place, scene.weight, p, position, token)
        height = _plate_height(scene, x, y, z, token)
        lowest = where_greater(low, height, number, lowest)
        low = where_greater(low, height, height, low)
        if cube_near:
            distance = _box_distance(touch, x, y, z, token)
            chosen = where_greater(gap, distance, number, chosen)
            gap = where_greater(gap, distance, distance, gap)
    _insert(touch, 0, PUSHING, gap - scene.distance, chosen, token)
    _insert(touch, PUSHING, LYING, low - scene.distance, lowest, token)


@kernel
def _near(touch, first, count, token):
    """How many contacts of a list may act in any lane."""
    found, alarm = 0, fill(ALARM, touch.gap, token)
    for s in range(count):
        if any_greater(alarm, load(touch.gap, first + s, token)):
            found = s + 1
    return found


@kernel
def search(scene, position, touch, token):
    """Fill ``gap`` and ``nearest`` with the points of the nearest bands; sets ``count``."""
    far, none = fill(FAR, touch.cube, token), fill(-1.0, touch.cube, token)
    for s in range(PUSHING + LYING):
        store(touch.gap, s, far)
        store(touch.nearest, s, none)
    for band in range(scene.bands):
        x, y, z = point(scene.first, scene.place, scene.weight, scene.points + band, position, token)
        reach = fill(scene.reach[band], touch.cube, token)
        cube_near = any_greater(reach, _box_distance(touch, x, y, z, token))
        plate_near = any_greater(reach, _plate_height(scene, x, y, z, token))
        if cube_near or plate_near:
            _search_band(scene, band, position, touch, cube_near, token)
    touch.count[0] = _near(touch, 0, PUSHING, token)
    touch.count[1] = _near(touch, PUSHING, LYING, token)
