"""Draws and predictions on disk: the only room that depends on ArviZ."""

from rfdropo_bayes.posteriors.inference_data import InferenceData, central_interval, load_posterior, summarise
from rfdropo_bayes.posteriors.parameter_info import (
    SHARED,
    DrawsByOwner,
    ParameterInfo,
    ProductOfPowers,
    Scope,
    by_owner,
    contradiction,
    contradicts,
    cut_off_at,
    label,
)
from rfdropo_bayes.posteriors.record import FIXED, PosteriorRecord, RecordingPrediction
