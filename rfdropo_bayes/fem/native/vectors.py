"""Vectors of space in SIMD lanes: triples of values."""

from __future__ import annotations

from rfdropo_bayes.fem.native.simd import fma, fnma, inlined, load3, store


@inlined
def dot(a, b):
    """a . b."""
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


@inlined
def cross(a, b):
    """a x b."""
    return fnma(a[2], b[1], a[1] * b[2]), fnma(a[0], b[2], a[2] * b[0]), fnma(a[1], b[0], a[0] * b[1])


@inlined
def scaled(a, share):
    """share * a."""
    return a[0] * share, a[1] * share, a[2] * share


@inlined
def added(a, share, b):
    """share * a + b."""
    return fma(a[0], share, b[0]), fma(a[1], share, b[1]), fma(a[2], share, b[2])


@inlined
def plus(a, b):
    """a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def minus(a, b):
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def combined(directions, first, weights, token):
    """Sum of three vectors, in rows from ``first`` on, times weights."""
    x = scaled(load3(directions, first, token), weights[0])
    x = added(load3(directions, first + 3, token), weights[1], x)
    return added(load3(directions, first + 6, token), weights[2], x)


@inlined
def components(directions, first, a, token):
    """Products of a vector with three vectors, in rows from ``first`` on."""
    x = dot(load3(directions, first, token), a)
    return x, dot(load3(directions, first + 3, token), a), dot(load3(directions, first + 6, token), a)


@inlined
def add_to(rows, first, a, token):
    """Add a vector to three rows."""
    x, y, z = plus(load3(rows, first, token), a)
    store(rows, first, x, y, z)


@inlined
def put(rows, first, a):
    """Write a vector to three rows."""
    store(rows, first, a[0], a[1], a[2])
