"""What a fitted model leaves of the recordings that it was fitted to, and so is off by in others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.noise import Autoregression
from rfdropo_bayes.bayes.noise.autoregression import RESIDUALS, estimate_noise
from rfdropo_bayes.data.sample_times import sample_time
from rfdropo_bayes.posteriors import PosteriorRecord, RecordingPrediction

MODEL_ERROR = "model_error"  # among the attributes of a posterior


class ModelError(NamedTuple):
    """What a fitted model leaves: its size for each coordinate of each marker, and how long it lasts.

    Attributes:
        markers: names.
        scale: root mean square [m], marker by marker, x, y and z of each.
        correlation_time: over which it forgets its sign [s].
        share: what a coordinate of a row counts, because markers err together: independent coordinates of equal worth
            are as many as their correlation matrix has eigenvalues of note (its participation ratio).
    """

    markers: tuple[str, ...]
    scale: tuple[float, ...]
    correlation_time: float
    share: float = 1.0

    def of_marker(self, name: str) -> float:
        """How far [m] a marker is off, root mean square, where all coordinates of a row are taken for independent."""
        index = self.markers.index(name)
        return float(np.linalg.norm(self.scale[3 * index : 3 * index + 3]) / np.sqrt(self.share))

    def every(self, step: float) -> Autoregression:
        """The same as noise of rows that are ``step`` seconds apart."""
        memory = np.array([1.0, np.exp(-step / self.correlation_time)])
        return Autoregression(np.array(self.scale), memory, RESIDUALS, np.inf)


def model_error(
    predictions: Sequence[RecordingPrediction], widened: Float[np.ndarray, " column"] | float = 1.0
) -> ModelError | None:
    """What the mean prediction leaves in the recordings that were fitted; None without one.

    It is taken for a first-order autoregression, which has a time constant: the error then counts as little in rows of
    another rate. White noise of the same size would give three seconds of a recording the weight of three hundred
    independent measurements, of a model whose error lasts for one of them.

    Args:
        predictions: of recordings, the fitted ones among them.
        widened: what residuals of the coordinates have to be multiplied by, because parameters follow them.
    """
    fitted = [p for p in predictions if p.split == "fit" and p.mask.any()]
    if not fitted:
        return None
    rows = max(len(p.time) for p in fitted)
    markers = fitted[0].marker_names
    error, valid = (
        np.zeros((len(fitted), rows, 3 * len(markers))),
        np.zeros((len(fitted), rows, 3 * len(markers)), bool),
    )
    for i, p in enumerate(fitted):
        error[i, : len(p.time)] = (p.observed - p.central).reshape(len(p.time), -1)
        valid[i, : len(p.time)] = np.repeat(p.mask, 3, axis=1)
    noise = estimate_noise(error, valid, 1.0, source=RESIDUALS, order=1, pooled=False, shared=None)
    across = noise.correlation
    share = 1.0 if across is None else len(across) / float(np.sum(across**2))
    step = sample_time(*(p.time for p in fitted))
    memory = float(np.clip(noise.autocorrelation[1], 1e-3, 0.999))
    return ModelError(tuple(markers), tuple((widened * noise.scale).tolist()), float(-step / np.log(memory)), share)


def recorded_model_error(record: PosteriorRecord) -> ModelError | None:
    """What the fit's model leaves: as the fit says, or as its predictions of the fitted recordings show; None where it
    holds neither."""
    given = record.attrs.get(MODEL_ERROR)
    if given is None:
        return model_error(record.recordings)
    lists = {name: tuple(given[name]) for name in ("markers", "scale")}
    return ModelError(**{**given, **lists})
