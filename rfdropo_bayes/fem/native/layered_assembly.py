"""Layer frames, elastic forces, tangent and mass of a layered body in SIMD lanes, in the section modes of
`section_modes`.

The physics is that of ``fem.dynamics``. A time step and an iteration for static equilibrium differ in a few factors
only, held in ``factors``. ``tables``, ``samples``, ``factors`` and ``work`` are records of addresses; see
`layered_records`.
"""

from __future__ import annotations

from rfdropo_bayes.fem.corotational import POLAR_ITERATIONS
from rfdropo_bayes.fem.native.fields import clear
from rfdropo_bayes.fem.native.layered_effects import (
    BENDING,
    BRANCH,
    LOADED,
    SURROUNDED,
    add_bending_law,
    add_law_tangent,
    subtract_law_product,
    subtract_surroundings_product,
)
from rfdropo_bayes.fem.native.simd import fill, fma, fnma, kernel, load, load3, store
from rfdropo_bayes.fem.native.stiffening_kernels import resist_lateral
from rfdropo_bayes.fem.native.string_kernels import add_string_reaction, add_strings, measure_strings


@kernel
def _deformation(parity, slope, modes, layer, position, axes, token):
    """Mean deformation gradient of a layer into its ``axes``, row-major."""
    clear(axes, 9 * layer, 9 * layer + 9, token)
    for k in range(2 * modes):
        kind = parity[k]
        if kind == 3:
            continue
        column = (kind + 2) % 3
        factor = fill(slope[2 * modes * layer + k], position, token)
        row = 3 * (layer * modes + k)
        for i in range(3):
            t = 9 * layer + 3 * i + column
            store(axes, t, fma(load(position, row + i, token), factor, load(axes, t, token)))


@kernel
def _rotation(axes, t, token):
    """Rotation of the polar decomposition in place, by Newton's iteration."""
    one, half = fill(1.0, axes, token), fill(0.5, axes, token)
    a0, a1, a2 = load3(axes, t, token)
    b0, b1, b2 = load3(axes, t + 3, token)
    c0, c1, c2 = load3(axes, t + 6, token)
    for _ in range(POLAR_ITERATIONS):
        u0, u1, u2 = fnma(b2, c1, b1 * c2), fnma(b0, c2, b2 * c0), fnma(b1, c0, b0 * c1)
        v0, v1, v2 = fnma(c2, a1, c1 * a2), fnma(c0, a2, c2 * a0), fnma(c1, a0, c0 * a1)
        w0, w1, w2 = fnma(a2, b1, a1 * b2), fnma(a0, b2, a2 * b0), fnma(a1, b0, a0 * b1)
        scale = half * (one / fma(a0, u0, fma(a1, u1, a2 * u2)))
        a0, a1, a2 = fma(half, a0, u0 * scale), fma(half, a1, u1 * scale), fma(half, a2, u2 * scale)
        b0, b1, b2 = fma(half, b0, v0 * scale), fma(half, b1, v1 * scale), fma(half, b2, v2 * scale)
        c0, c1, c2 = fma(half, c0, w0 * scale), fma(half, c1, w1 * scale), fma(half, c2, w2 * scale)
    store(axes, t, a0, a1, a2, b0, b1, b2, c0, c1, c2)


@kernel
def _relative(field, row, base, constant, token):
    """One mode of a field; constant modes relative to that of the lower section."""
    x, y, z = load3(field, row, token)
    if constant:
        x, y, z = x - load(field, base, token), y - load(field, base + 1, token), z - load(field, base + 2, token)
    return x, y, z


@kernel
def _turned(axes, t, x, y, z, i, token):
    """Component i of a vector in a layer's frame."""
    return fma(load(axes, t + i, token), x, fma(load(axes, t + 3 + i, token), y, load(axes, t + 6 + i, token) * z))


@kernel
def _local_field(rest, modes, layer, factors, work, token):
    """``local`` = strain * (R' x - X) + strain_rate * R' v, relative to the lower section: K does not see the rest."""
    axes, frame = work.axes, 9 * layer
    force, rate = load(factors.strain, 0, token), load(factors.strain_rate, 0, token)
    base = 3 * layer * modes
    for k in range(2 * modes):
        row = base + 3 * k
        constant = k == 0 or k == modes
        x, y, z = _relative(work.position, row, base, constant, token)
        u, v, w = _relative(work.velocity, row, base, constant, token)
        for i in range(3):
            still = rest[row + i] - rest[base + i] if constant else rest[row + i]
            strain = _turned(axes, frame, x, y, z, i, token) - still
            store(work.local, 3 * k + i, fma(force, strain, rate * _turned(axes, frame, u, v, w, i, token)))


@kernel
def _strain(tables, layer, k, i, x, y, z, work, token):
    """Component i of a mode's displacement in the layer's frame, relative to the lower section."""
    row, base = 3 * layer * tables.modes + 3 * k + i, 3 * layer * tables.modes + i
    constant = k == 0 or k == tables.modes
    still = tables.rest[row] - tables.rest[base] if constant else tables.rest[row]
    return _turned(work.axes, 9 * layer, x, y, z, i, token) - still


@kernel
def follow_branch(tables, factors, layer, work, token):
    """Let the dashpot of a layer's Prony branch follow the strain."""
    modes, share = tables.modes, load(factors.share, 0, token)
    base = 3 * layer * modes
    for k in range(2 * modes):
        x, y, z = _relative(work.position, base + 3 * k, base, k == 0 or k == modes, token)
        for i in range(3):
            strain, t = _strain(tables, layer, k, i, x, y, z, work, token), 2 * base + 3 * k + i
            behind = load(work.branch, t, token)
            store(work.branch, t, fma(share, strain - behind, behind))


@kernel
def add_branch(tables, factors, layer, work, token):
    """Add to ``local`` what the Prony branch of a layer makes of its strain."""
    modes, gain = tables.modes, load(factors.branch, 0, token)
    base = 3 * layer * modes
    for k in range(2 * modes):
        x, y, z = _relative(work.position, base + 3 * k, base, k == 0 or k == modes, token)
        for i in range(3):
            strain = _strain(tables, layer, k, i, x, y, z, work, token)
            behind = load(work.branch, 2 * base + 3 * k + i, token)
            store(work.local, 3 * k + i, fma(gain, strain - behind, load(work.local, 3 * k + i, token)))


@kernel
def _local_change(change, factor, modes, layer, work, token):
    """``local`` = factor * R' change, relative to the lower section."""
    base = 3 * layer * modes
    for k in range(2 * modes):
        x, y, z = _relative(change, base + 3 * k, base, k == 0 or k == modes, token)
        for i in range(3):
            store(work.local, 3 * k + i, factor * _turned(work.axes, 9 * layer, x, y, z, i, token))


@kernel
def _layer_reaction(tables, stiffness, first, local, reaction, token):
    """``reaction`` = K ``local`` for the layer whose stiffness starts at row ``first``."""
    clear(reaction, 0, 6 * tables.modes, token)
    for e in range(tables.entries):
        i, j = tables.entry_row[e], tables.entry_column[e]
        k = load(stiffness, first + e, token)
        store(reaction, i, fma(k, load(local, j, token), load(reaction, i, token)))
        if i != j:
            store(reaction, j, fma(k, load(local, i, token), load(reaction, j, token)))


@kernel
def _subtract_reaction(tables, layer, work, field, token):
    """Subtract ``reaction``, turned out of the layer's frame, from a field."""
    modes, axes, reaction = tables.modes, work.axes, work.reaction
    for k in range(2 * modes):
        x, y, z = load3(reaction, 3 * k, token)
        for i in range(3):
            t, row = 9 * layer + 3 * i, 3 * (layer * modes + k) + i
            value = fnma(load(axes, t, token), x, load(field, row, token))
            value = fnma(load(axes, t + 1, token), y, value)
            store(field, row, fnma(load(axes, t + 2, token), z, value))


@kernel
def _dyad(axes, frame, dyads, slot, i, j, scale, token):
    """``dyads``: nine values r_i r_j' by columns, times a scale; r are the columns of the frame."""
    for c in range(3):
        factor = scale * load(axes, frame + 3 * c + j, token)
        for r in range(3):
            store(dyads, 9 * slot + 3 * c + r, load(axes, frame + 3 * r + i, token) * factor)


@kernel
def _same_parity_tile(target, t, stiffness, e, dyads, add, token):
    """Write (or add) the turned block of two modes of equal parity: three entries on its diagonal."""
    first, second, third = load3(stiffness, e, token)
    for k in range(9):
        value = load(target, t + k, token) if add else fill(0.0, target, token)
        value = fma(first, load(dyads, k, token), value)
        value = fma(second, load(dyads, 9 + k, token), value)
        store(target, t + k, fma(third, load(dyads, 18 + k, token), value))


@kernel
def _mixed_parity_tile(target, t, stiffness, e, dyads, d, add, token):
    """Write (or add) the turned block of two modes of different parity: two entries that mirror each other's place."""
    first, second = load(stiffness, e, token), load(stiffness, e + 1, token)
    for c in range(3):
        for r in range(3):
            k = 3 * c + r
            value = load(target, t + k, token) if add else fill(0.0, target, token)
            value = fma(first, load(dyads, d + k, token), value)
            store(target, t + k, fma(second, load(dyads, d + 3 * r + c, token), value))


@kernel
def _tangent_block(parity, modes, target, t, stiffness, e, dyads, triangle, add, token):
    """Turned stiffness of one pair of faces into tiles from ``t`` on; returns the entry after its last."""
    for m in range(modes):
        for n in range(m + 1 if triangle else modes):
            kind = parity[m] ^ parity[n]
            tile = t + 9 * (m * modes + n)
            if kind == 0:
                _same_parity_tile(target, tile, stiffness, e, dyads, add, token)
                e += 3
            else:
                _mixed_parity_tile(target, tile, stiffness, e, dyads, 18 + 9 * kind, add, token)
                e += 2
    return e


@kernel
def _layer_tangent(parity, modes, stiffness, first, layer, whole, factors, work, token):
    """Add the tangent of a layer to the pivot of its upper station; ``whole``: set the coupling, and start the pivot of
    the lower one."""
    dyads, scale = work.dyads, load(factors.elasticity, 0, token)
    _dyad(work.axes, 9 * layer, dyads, 0, 0, 0, scale, token)
    _dyad(work.axes, 9 * layer, dyads, 1, 1, 1, scale, token)
    _dyad(work.axes, 9 * layer, dyads, 2, 2, 2, scale, token)
    _dyad(work.axes, 9 * layer, dyads, 3, 0, 2, scale, token)
    _dyad(work.axes, 9 * layer, dyads, 4, 1, 2, scale, token)
    _dyad(work.axes, 9 * layer, dyads, 5, 0, 1, scale, token)
    block = 9 * modes * modes
    upper = (layer + 1) * block
    e = first
    if whole:
        e = _tangent_block(parity, modes, work.pivot, upper - block, stiffness, e, dyads, True, False, token)
    else:
        for m in range(modes):
            for n in range(m + 1):
                e += 3 if parity[m] == parity[n] else 2
    e = _tangent_block(parity, modes, work.pivot, upper, stiffness, e, dyads, True, True, token)
    if whole:
        _tangent_block(parity, modes, work.coupling, upper, stiffness, e, dyads, False, False, token)


@kernel
def add_mass(parity, modes, target, t, mass, entry, inertia, triangle, token):
    """Add the inertia of a station, a ``triangle``, or that which couples the stations of a layer, to tiles from ``t``
    on."""
    for m in range(modes):
        for n in range(m + 1 if triangle else modes):
            if parity[m] == parity[n]:
                value = inertia * load(mass, entry, token)
                tile = t + 9 * (m * modes + n)
                for i in range(3):
                    store(target, tile + 4 * i, load(target, tile + 4 * i, token) + value)
                entry += 1


@kernel
def layer_frame(tables, layer, work, token):
    """Frame of a layer into its ``axes``."""
    _deformation(tables.parity, tables.gradient, tables.modes, layer, work.position, work.axes, token)
    _rotation(work.axes, 9 * layer, token)


@kernel
def add_layer_force(tables, samples, factors, layer, work, strings, token):
    """Add the elastic force of a layer to ``field``, and what its ``strings`` put against velocities where they are
    measured; leaves in ``held`` the axial force that the layer resists."""
    _local_field(tables.rest, tables.modes, layer, factors, work, token)
    if samples.present[BRANCH]:
        add_branch(tables, factors, layer, work, token)
    if samples.present[BENDING]:
        add_bending_law(tables, samples, factors, layer, work, token)
    _layer_reaction(tables, samples.stiffness, layer * tables.entries, work.local, work.reaction, token)
    store(work.held, layer, load(work.reaction, 3 * tables.modes + 2, token))
    if strings:
        one = fill(1.0, work.local, token)
        _local_change(work.velocity, one, tables.modes, layer, work, token)
        add_string_reaction(tables, layer, one, work, token)
    _subtract_reaction(tables, layer, work, work.field, token)


@kernel
def subtract_tangent_product(tables, samples, factors, change, field, work, token):
    """Subtract the matrix, in its factors and not as it was summed, times a change of velocity from a field."""
    elasticity, inertia = load(factors.elasticity, 0, token), load(factors.inertia, 0, token)
    inverse = fill(1.0, elasticity, token) / elasticity
    for layer in range(tables.stations - 1):
        _local_change(change, elasticity, tables.modes, layer, work, token)
        _layer_reaction(tables, samples.stiffness, layer * tables.entries, work.local, work.reaction, token)
        add_string_reaction(tables, layer, inverse, work, token)
        _subtract_reaction(tables, layer, work, field, token)
        resist_lateral(tables, layer, change, field, work, token)
        if samples.present[BENDING]:
            subtract_law_product(tables, layer, elasticity, change, field, work, token)
    add_momentum(tables, samples, fill(0.0, inertia, token), inertia, change, field, token)
    if samples.present[SURROUNDED]:
        subtract_surroundings_product(tables, samples, change, field, work, token)


@kernel
def assemble_layer(tables, samples, factors, layer, square, ahead, work, whole, token):
    """Frame and force of a layer, and its part of the matrix, of a stage whose length has this ``square``; see
    `measure_strings` for ``ahead`` and `_layer_tangent` for ``whole``."""
    layer_frame(tables, layer, work, token)
    measure_strings(tables, layer, square, ahead, work, token)
    add_layer_force(tables, samples, factors, layer, work, not ahead, token)
    first = layer * tables.entries
    _layer_tangent(tables.parity, tables.modes, samples.stiffness, first, layer, whole, factors, work, token)
    add_strings(tables, layer, work, whole, token)
    if samples.present[BENDING]:
        add_law_tangent(tables, factors, layer, work, whole, token)


@kernel
def _add_momentum(field, row, mass, velocity, v, constant, gravity, force, drag, token):
    """Add mass * (force * gravity - drag * velocity) of the mode at ``v`` to the mode at ``row``."""
    for i in range(3):
        value = -(drag * load(velocity, v + i, token))
        if constant:
            value = fma(force, load(gravity, i, token), value)
        store(field, row + i, fma(mass, value, load(field, row + i, token)))


@kernel
def add_momentum(tables, samples, force, drag, velocity, field, token):
    """Add M (force * gravity - drag * velocity) to a field."""
    modes, parity, g = tables.modes, tables.parity, samples.gravity
    entry, coupled = 0, 0
    for station in range(tables.stations):
        base = 3 * station * modes
        for m in range(modes):
            row = base + 3 * m
            for n in range(m + 1):
                if parity[m] == parity[n]:
                    mass, column = load(samples.station_mass, entry, token), base + 3 * n
                    _add_momentum(field, row, mass, velocity, column, n == 0, g, force, drag, token)
                    if m != n:
                        _add_momentum(field, column, mass, velocity, row, m == 0, g, force, drag, token)
                    entry += 1
            if station + 1 == tables.stations:
                continue
            for n in range(modes):
                if parity[m] == parity[n]:
                    mass, column = load(samples.layer_mass, coupled, token), base + 3 * (modes + n)
                    _add_momentum(field, row, mass, velocity, column, n == 0, g, force, drag, token)
                    _add_momentum(field, column, mass, velocity, row, m == 0, g, force, drag, token)
                    coupled += 1


@kernel
def start_loads(tables, samples, factors, work, token):
    """``field`` = M (force * gravity - drag * v) and forces on sections: the right-hand side without elastic forces."""
    clear(work.field, 0, 3 * tables.modes * tables.stations, token)
    force, drag = load(factors.force, 0, token), load(factors.drag, 0, token)
    add_momentum(tables, samples, force, drag, work.velocity, work.field, token)
    if samples.present[LOADED]:  # the first mode of a section moves it as a whole
        for station in range(tables.stations):
            for i in range(3):
                row, pushed = 3 * station * tables.modes + i, load(work.pushed, 3 * station + i, token)
                store(work.field, row, fma(force, pushed, load(work.field, row, token)))
