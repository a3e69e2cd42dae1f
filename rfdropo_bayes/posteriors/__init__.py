"""Draws and predictions on disk: the only room that depends on ArviZ."""

from rfdropo_bayes.posteriors.bounds import contradiction, contradicts, cut_off_at
from rfdropo_bayes.posteriors.derived import Derived, LessMedian, ProductOfPowers, sharper_less_median
from rfdropo_bayes.posteriors.inference_data import InferenceData, central_interval, load_posterior, summarise
from rfdropo_bayes.posteriors.parameter_info import SHARED, DrawsByOwner, ParameterInfo, Scope, by_owner, label
from rfdropo_bayes.posteriors.record import FIXED, PosteriorRecord, RecordingPrediction
