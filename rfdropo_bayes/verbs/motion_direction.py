"""Whether recordings move the way that their commands ask for: a frame turned about the body's axis, or mirrored."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rfdropo_bayes.data.named_columns import axes_matrix, axes_words

AGREEING = 0.8
"""Least agreement of a reported turn. Nominal models of the arm, SOFA's trunk and the paper's trunk agree with their
recordings to 0.88 to 0.96, and the turn between them is at most 6 degrees. With prior parameters, 2 of 632 recordings
of 3 s by five robots in the right frame are reported as turned and none as mirrored (`benchmarks/frame_check.py`); 25
agree less.
"""
TURNED = np.pi / 4.0
QUARTER = np.pi / 12.0  # A turn as near to a number of quarters is written as ``axes``


class Direction(NamedTuple):
    """Direction of the measured motion across the body relative to the nominal motion."""

    turn: float  # angle [rad] about +z from the simulated motion to the measured one
    agreement: float  # correlation of both after that turn, 0 to 1
    mirrored: float  # the same after a mirror, y to -y, and a turn
    mirror_turn: float = 0.0  # the angle [rad] of the latter

    @property
    def straight(self) -> float:
        """Correlation of both motions without rotation, -1 to 1."""
        return self.agreement * float(np.cos(self.turn))


class Paths(NamedTuple):
    """Marker positions in one recording [m], in the nominal model [m], and a mask of seen markers."""

    nominal: Float[np.ndarray, "time marker 3"]
    measured: Float[np.ndarray, "time marker 3"]
    mask: Bool[np.ndarray, "time marker"]


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
    turn, mirror_turn = float(np.angle(turned)), float(np.angle(mirrored))
    return Direction(turn, float(abs(turned) / scale), float(abs(mirrored) / scale), mirror_turn)


def _across(position: np.ndarray) -> np.ndarray:
    """Motion in x and y about its mean, as complex numbers."""
    plane = position[:, 0] + 1j * position[:, 1]
    return plane - plane.mean()


def direction_doubt(direction: Direction, axes: tuple[str, str, str] | None) -> str | None:
    """Doubt about the frame or the order of the cables from a direction, in words; None without doubt.

    Args:
        direction: direction of the motion.
        axes: axes of [data.columns] used to read the recordings; None for formats that have none.
    """
    if direction.agreement >= AGREEING and abs(direction.turn) > TURNED:
        degrees = np.degrees(direction.turn)
        return (
            f"the measured motion is turned about z by {degrees:.0f} degrees, counted from +x towards +y, from the "
            f"motion that the commands ask for (agreement {direction.agreement:.2f}): {_remedy(direction.turn, axes)}"
        )
    if direction.agreement < AGREEING <= direction.mirrored:
        return (
            f"the markers move as in a mirror (agreement {direction.mirrored:.2f}, without the mirror "
            f"{direction.agreement:.2f}): {_mirror_remedy(direction.mirror_turn, axes)}"
        )
    return None


def axes_of_mirror(turn: float, axes: tuple[str, str, str] | None) -> str:
    """The line that corrects a left-handed frame, or the place to check it."""
    if axes is None or not _by_quarters(turn):
        return "look at the axes of the positions"
    c, s = np.round(np.cos(turn)), np.round(np.sin(turn))
    back = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, 1.0]])
    return f"axes = {axes_words(back @ axes_matrix(axes))} in [data.columns]"


def _mirror_remedy(turn: float, axes: tuple[str, str, str] | None) -> str:
    """Remedy for a mirrored motion: the frame is left-handed, or the commands run the other way round."""
    order = "look at the order of the commands and at azimuth_deg of the cables, which counts from +x towards +y"
    if axes is None or not _by_quarters(turn):
        return f"the frame is left-handed, or {order}"
    return f"if the frame is left-handed, {axes_of_mirror(turn, axes)}; else {order}"


def _by_quarters(turn: float) -> bool:
    """Whether an angle is about a number of quarter turns."""
    quarter = 0.5 * np.pi
    return bool(abs(turn - quarter * round(turn / quarter)) <= QUARTER)


def _remedy(turn: float, axes: tuple[str, str, str] | None) -> str:
    """Remedy for a turned motion."""
    azimuth = f"add {np.degrees(turn) % 360.0:.0f} to azimuth_deg of every cable"
    if axes is None or not _by_quarters(turn):
        return f"{azimuth}, or turn the recordings' frame"
    c, s = np.round(np.cos(turn)), np.round(np.sin(turn))
    back = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    words = f"axes = {axes_words(back @ axes_matrix(axes))} in [data.columns] would turn them back, or {azimuth}"
    opposite = c == -1.0
    return words + ("; so would commands of the other sign: pull is positive" if opposite else "")
