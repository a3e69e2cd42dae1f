"""Whether recordings move the way that their commands ask for: a frame turned about the body's axis, or mirrored."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.data import Trajectory, shared_markers
from rfdropo_bayes.data.named_columns import axes_matrix, axes_words
from rfdropo_bayes.model.model_spec import ModelSpec
from rfdropo_bayes.verbs.numerical_error import longest_of, nominal_markers

AGREEING = 0.8
"""Least agreement of a turn that is said. Nominal models of the arm, SOFA's trunk and the paper's trunk agree with
their recordings to 0.88 to 0.96, and the turn between them is at most 6 degrees. Of 632 recordings of 3 s that five
robots made in the right frame, under parameters of the prior, 2 are said to be turned and none to be mirrored
(`benchmarks/frame_check.py`); 25 agree less."""
TURNED = np.pi / 4.0
QUARTER = np.pi / 12.0
"""A turn as near to a number of quarters is written as ``axes``."""
MOST = 5


class Direction(NamedTuple):
    """How the measured motion across the body lies to the nominal one.

    Attributes:
        turn: angle [rad] about +z from the simulated motion to the measured one.
        agreement: correlation of both after that turn, 0 to 1.
        mirrored: the same after a mirror and any turn.
    """

    turn: float
    agreement: float
    mirrored: float


class Paths(NamedTuple):
    """Markers in one recording [m], where the nominal model has them, and which of them were seen."""

    nominal: Float[np.ndarray, "time marker 3"]
    measured: Float[np.ndarray, "time marker 3"]
    mask: Bool[np.ndarray, "time marker"]


def measure_direction(spec: ModelSpec, recordings: Sequence[Trajectory]) -> Direction:
    """Compare the motion across the body, about its mean, with that of the nominal model.

    Args:
        spec: of a robot; values are nominal or fixed.
        recordings: in the frame of the base; the first `MOST` of them count.

    Raises:
        InputError: commands that do not fit, or a rollout that did not end well.
    """
    longest = longest_of(spec.simulator.body == "rod")
    return direction_of(_paths(spec, recording, longest) for recording in recordings[:MOST])


def _paths(spec: ModelSpec, recording: Trajectory, longest: float) -> Paths:
    nominal = nominal_markers(spec, recording, longest)
    names = shared_markers([recording], spec.robot.marker_names)
    index, rows = [recording.marker_names.index(name) for name in names], len(nominal)
    return Paths(nominal, recording.position[:rows, index], recording.position_mask[:rows, index])


def direction_of(recordings: Iterable[Paths]) -> Direction:
    """Compare the motion across the body, about its mean, in recordings and under the nominal model."""
    turned, mirrored, simulated, measured = 0.0j, 0.0j, 0.0, 0.0
    for paths in recordings:
        for k in range(paths.mask.shape[1]):
            seen = paths.mask[:, k]
            if not seen.any():
                continue
            one, other = _across(paths.nominal[seen, k]), _across(paths.measured[seen, k])
            turned += np.sum(np.conj(one) * other)
            mirrored += np.sum(one * other)
            simulated += np.sum(np.abs(one) ** 2)
            measured += np.sum(np.abs(other) ** 2)
    scale = np.sqrt(simulated * measured)
    if scale == 0.0:
        return Direction(0.0, 0.0, 0.0)
    return Direction(float(np.angle(turned)), float(abs(turned) / scale), float(abs(mirrored) / scale))


def _across(position: np.ndarray) -> np.ndarray:
    """Motion in x and y about its mean, as complex numbers."""
    plane = position[:, 0] + 1j * position[:, 1]
    return plane - plane.mean()


def direction_doubt(found: Direction, axes: tuple[str, str, str] | None) -> str | None:
    """What a direction says against the frame or the order of the cables, in words; None if it says nothing.

    Args:
        found: the direction.
        axes: of [data.columns], under which the recordings were read; None for formats that have none.
    """
    if found.agreement >= AGREEING and abs(found.turn) > TURNED:
        degrees = np.degrees(found.turn)
        return (
            f"the measured motion is turned about z by {degrees:.0f} degrees, counted from +x towards +y, from the "
            f"motion that the commands ask for (agreement {found.agreement:.2f}): {_remedy(found.turn, axes)}"
        )
    if found.agreement < AGREEING <= found.mirrored:
        return (
            f"the markers move as in a mirror (agreement {found.mirrored:.2f}, without the mirror "
            f"{found.agreement:.2f}): look at the order of the commands and at azimuth_deg of the cables, which counts "
            "from +x towards +y"
        )
    return None


def _remedy(turn: float, axes: tuple[str, str, str] | None) -> str:
    """What would turn the motion back."""
    quarters = round(turn / (0.5 * np.pi))
    azimuth = f"add {np.degrees(turn) % 360.0:.0f} to azimuth_deg of every cable"
    if axes is None or abs(turn - 0.5 * np.pi * quarters) > QUARTER:
        return f"{azimuth}, or turn the recordings' frame"
    c, s = np.round(np.cos(0.5 * np.pi * quarters)), np.round(np.sin(0.5 * np.pi * quarters))
    back = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    words = f"axes = {axes_words(back @ axes_matrix(axes))} in [data.columns] would turn them back, or {azimuth}"
    return words + ("; so would commands of the other sign: pull is positive" if abs(quarters) == 2 else "")
