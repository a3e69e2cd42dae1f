"""Draws and predictions on disk: the only room that depends on ArviZ."""

from rfdropo_bayes.posteriors.bounds import contradiction, contradicts, piled_at
from rfdropo_bayes.posteriors.derived import ProductOfPowers, evaluate_products
from rfdropo_bayes.posteriors.inference_data import (
    InferenceData,
    central_interval,
    load_posterior,
    save_posterior,
    summarise,
    to_tree,
)
from rfdropo_bayes.posteriors.parameter_info import SPREAD, ParameterInfo
from rfdropo_bayes.posteriors.record import PosteriorRecord, RecordingPrediction

__all__ = [
    "SPREAD",
    "InferenceData",
    "ParameterInfo",
    "PosteriorRecord",
    "ProductOfPowers",
    "RecordingPrediction",
    "central_interval",
    "contradiction",
    "contradicts",
    "evaluate_products",
    "load_posterior",
    "piled_at",
    "save_posterior",
    "summarise",
    "to_tree",
]
