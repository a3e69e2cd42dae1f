"""A simulator of a tip that lags behind a pull, for tests of days and groups."""

from __future__ import annotations

import numpy as np

import rfdropo_bayes as rb

STEP, SIGMA = 0.02, 2e-4
PRIORS = {"gain": {}, "time_constant": {}, "zero": {"distribution": "Normal", "loc": 0.0, "scale": 0.05}}


def lag(parameters, command):
    """The tip follows gain * (command + zero) with a time constant; many parameter sets at once."""
    gain, share = parameters["gain"][:, None], 1.0 - np.exp(-STEP / parameters["time_constant"])
    wanted = gain * (command[:, :, 0] + parameters["zero"][:, None])
    place = [wanted[:, 0]]
    for row in range(1, command.shape[1]):
        place.append(place[-1] + share * (wanted[:, row] - place[-1]))
    x = np.stack(place, axis=1)
    return np.stack([x, np.zeros_like(x), np.full_like(x, 0.1)], axis=-1)[:, :, None]


BOX = rb.BlackBox(
    lag,
    parameters={
        "gain": {"low": 0.2, "high": 3.0},
        "time_constant": {"low": 0.05, "high": 1.0, "unit": "s"},
        "zero": {"low": -1.0, "high": 1.0, "unit": "m"},
    },
    markers=["tip"],
    channels=["pull"],
    time_step=STEP,
    batched=True,
    name="lag",
)
