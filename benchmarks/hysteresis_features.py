"""How much of an unseen hysteresis of one cable the features of laws leave: plays, and Bouc and Wen's equation.

    python benchmarks/hysteresis_features.py

Signals alone, without a robot or noise: commands like those of `unknown_effects.py`, sets of eight recordings. Widths
and coefficients are fitted to four recordings; the share of the variance that is left of the other four is printed,
the median over the sets. Fifteen seconds of one processor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

SETS, FITTED, LEFT_OUT = 12, 4, 4
INTERVAL, DURATION, STEP = 0.2, 5.0, 0.01  # between commands, of a recording, and between rows [s]
MOVE, STROKE = 2.5e-3, 1e-2  # largest change of a command, and its range [m]
WIDTHS = np.geomspace(1e-4, 1e-2, 25)  # [m]
HIDDEN = 1.5e-3  # width of what is hidden [m]
RIDGE = 1e-9  # of a fit with two features that are alike

Signals = Float[np.ndarray, "recording row width"]


def commands(rng: np.random.Generator) -> Float[np.ndarray, "recording row"]:
    """Random walks within the stroke."""
    clock, time = np.arange(0.0, DURATION + INTERVAL, INTERVAL), np.arange(0.0, DURATION, STEP)
    found = []
    for _ in range(SETS * (FITTED + LEFT_OUT)):
        walk = [0.0]
        for _ in clock[1:]:
            walk.append(float(np.clip(walk[-1] + rng.uniform(-MOVE, MOVE), 0.0, STROKE)))
        found.append(np.interp(time, clock, walk))
    return np.stack(found)


def play(u: Float[np.ndarray, "recording row"], widths: Sequence[float]) -> Signals:
    """-1 to 1: where a drive stands in its play of each half width."""
    z, found = np.zeros((len(u), len(widths))), [np.zeros((len(u), len(widths)))]
    for move in np.diff(u).T:
        z = np.clip(z + move[:, None] / widths, -1.0, 1.0)
        found.append(z)
    return np.stack(found, axis=1)


def bouc_wen(
    u: Float[np.ndarray, "recording row"], widths: Sequence[float], power: float = 1.0, gamma: float = 0.5
) -> Signals:
    """z' = (u' - |z|^n ((1 - gamma) |u'| sign z + gamma u')) / width, which saturates at 1; gamma = 0 is Dahl's."""
    z, found = np.zeros((len(u), len(widths))), [np.zeros((len(u), len(widths)))]
    for row in np.diff(u).T:
        move = row[:, None]
        z = z + (move - np.abs(z) ** power * ((1.0 - gamma) * np.abs(move) * np.sign(z) + gamma * move)) / widths
        z = np.clip(z, -1.0, 1.0)
        found.append(z)
    return np.stack(found, axis=1)


def left(y: Float[np.ndarray, "recording row"], choices: Sequence[Sequence[np.ndarray]]) -> float:
    """Median share of left-out variance that the choice of features leaves which fits a set best."""
    square, sums = (y**2).sum(axis=1), []
    for features in choices:
        x = np.stack(features, axis=-1)
        sums.append((np.einsum("rti,rtj->rij", x, x), np.einsum("rti,rt->ri", x, y)))
    shares = []
    for k in range(SETS):
        first = k * (FITTED + LEFT_OUT)
        known, unseen = slice(first, first + FITTED), slice(first + FITTED, first + FITTED + LEFT_OUT)
        best, share = np.inf, 1.0
        for gram, along in sums:
            size = np.linalg.solve(gram[known].sum(axis=0) + RIDGE * np.eye(gram.shape[1]), along[known].sum(axis=0))
            error = square[known].sum() - float(along[known].sum(axis=0) @ size)
            if error < best:
                best, total = error, float(square[unseen].sum())
                taken = 2.0 * size @ along[unseen].sum(axis=0) - size @ gram[unseen].sum(axis=0) @ size
                share = (total - float(taken)) / total
        shares.append(share)
    return float(np.median(shares))


def main() -> None:
    """A table: what is hidden, and what each set of features leaves of it."""
    u = commands(np.random.default_rng(1))
    plays, bends = play(u, WIDTHS), bouc_wen(u, WIDTHS)
    every = range(len(WIDTHS))
    features = {
        "play": [[plays[..., i]] for i in every],
        "Bouc-Wen": [[bends[..., i]] for i in every],
        "two plays": [[plays[..., i], plays[..., j]] for i in every for j in every if i < j],
        "play and Bouc-Wen": [[plays[..., i], bends[..., j]] for i in every for j in every],
    }
    hidden = {"play": play(u, [HIDDEN]), "four plays": play(u, [5e-4, 1e-3, 2e-3, 3e-3]).mean(axis=2, keepdims=True)}
    for power in (1.0, 2.0):
        for gamma in (0.0, 0.5, 0.9):
            hidden[f"Bouc-Wen, n = {power:g}, gamma = {gamma:g}"] = bouc_wen(u, [HIDDEN], power, gamma)
    print(f"| hidden | {' | '.join(features)} |\n|{'---|' * (1 + len(features))}")
    for name, signal in hidden.items():
        found = [f"{100.0 * left(signal[..., 0], choices):.1f} %" for choices in features.values()]
        print(f"| {name} | {' | '.join(found)} |")


if __name__ == "__main__":
    main()
