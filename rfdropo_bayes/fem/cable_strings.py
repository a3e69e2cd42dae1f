"""Taut cables hold the sections of a body against each other, as strings do.

A cable of tension T whose crossings of two sections are L apart resists their relative motion across it with T / L. The
compression that it causes in the layer between them turns with the layer's frame, and cancels this as far as the layer
turns as a whole. What is left acts within the frame: against shear and twist of the layer, and against spread of its
sections. In a soft neck that opposed cables have squeezed to a third of its length it exceeds the neck's own stiffness
forty times. A step or an iteration that leaves it out swings in these motions and never ends.

Motion along a cable is resisted as well. In a neck that opposed cables fold, they point every way; without this the
rollouts of a notched trunk depended on the last digit of its parameters.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfdropo_bayes.fem.cables import CableLayout, routes
from rfdropo_bayes.fem.layered import LayeredBody, attach, rest_positions

SHORTEST = 0.02
"""Crossings closer than this share of the layer's length at rest count as this far apart: a layer may fold."""
AHEAD_SHORTEST, AHEAD_FACTOR = 1e-3, 1.5
"""The same, and a factor on all springs, for forces that are taken where the velocity leads (``fem.integrators``).

In a motion without mass SDIRK2 swings with growing amplitude where the matrix lacks over a seventh of the stiffness;
with more than all of it the motion is only slower. Opposed cables bring crossings as near as 60 um, 1 % of a neck. Then
`SHORTEST` leaves half of the stiffness, and the springs lack up to a quarter of it anyway: tensions of a trunk that
should be still swing by hundreds of newtons. The order stays: springs act on the change of the velocity only."""


def crossing_weights(body: LayeredBody, layout: CableLayout) -> Float[np.ndarray, "layers cables nodes2"]:
    """Weights of node positions that give the way of every cable through every layer, from the lower section to the
    upper one; zero beyond the cable's end."""
    nodes, middle = body.section_nodes, 0.5 * (body.station[1:] + body.station[:-1])
    weights = np.zeros((len(middle), len(layout.anchor), 2 * nodes))
    for cable, route in enumerate(routes(layout, rest_positions(body))):
        route = route[np.argsort(route[:, 2], kind="stable")]
        place = [np.interp(body.station, route[:, 2], route[:, i]) for i in (0, 1)]
        points = attach(body, np.stack([*place, body.station], axis=1))
        section = np.zeros((len(body.station), nodes))
        for station, (members, shares) in enumerate(zip(points.node, points.weight, strict=True)):
            np.add.at(section[station], members % nodes, np.where(members // nodes == station, shares, 0.0))
        reached = (middle >= route[0, 2]) & (middle <= route[-1, 2])
        weights[:, cable] = np.where(reached[:, None], np.concatenate([-section[:-1], section[1:]], axis=1), 0.0)
    return weights


def string_stiffness(
    body: LayeredBody,
    weights: Float[np.ndarray, "layers cables nodes2"],
    gradient: Float[Array, "layers nodes2 3"],
    turned: Float[Array, "layers nodes2 3"],
    tension: Float[Array, " cables"],
    ahead: bool = False,
) -> Float[Array, "layers dofs dofs"]:
    """Stiffness [N/m] that tensions [N] add to every layer in its frame; positive semi-definite.

    A cable resists the motion of one crossing relative to the other, less what the turn of the frame makes of it. The
    frame turns with ``gradient`` as the rotation of a polar decomposition does.

    Args:
        body: its layers.
        weights: from `crossing_weights`.
        gradient: from ``layered.centre_gradient``.
        turned: node positions in the frames [m], relative to any point.
        tension: of the cables.
        ahead: for forces that are taken where the velocity leads, see `AHEAD_FACTOR`.
    """
    shortest, factor = (AHEAD_SHORTEST, AHEAD_FACTOR) if ahead else (SHORTEST, 1.0)
    way = jnp.einsum("lcn,lni->lci", weights, turned)
    least = shortest * np.diff(body.station)[:, None]
    square = jnp.sum(way**2, axis=-1)
    length = jnp.where(square > least**2, jnp.sqrt(jnp.maximum(square, least**2)), least)
    stretch = jnp.einsum("lni,lni->li", turned, gradient)
    lever = length / (0.5 * (stretch[:, 0] + stretch[:, 1]) + stretch[:, 2])[:, None]
    spring = factor * np.any(weights != 0.0, axis=-1) * tension / length
    relative = weights - lever[..., None] * gradient[:, None, :, 2]
    straight = jnp.einsum("lc,lcn,lcm->lnm", spring, relative, relative)
    mixed = jnp.einsum("lc,lcn,lma->lnma", spring * lever, relative, gradient[..., :2])
    tilted = jnp.einsum("lc,lna,lma->lnm", spring * lever**2, gradient[..., :2], gradient[..., :2])
    size = 3 * weights.shape[2]
    stiffness = jnp.zeros((len(length), weights.shape[2], 3, weights.shape[2], 3))
    stiffness = stiffness.at[:, :, 2, :, 2].set(straight + tilted)
    for axis in range(2):
        stiffness = stiffness.at[:, :, axis, :, axis].set(straight)
        stiffness = stiffness.at[:, :, axis, :, 2].set(mixed[..., axis])
        stiffness = stiffness.at[:, :, 2, :, axis].set(jnp.swapaxes(mixed[..., axis], 1, 2))
    return stiffness.reshape(-1, size, size)
