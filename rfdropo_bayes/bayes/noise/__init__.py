"""Noise of measured series: white, correlated in time, heavy-tailed or shared between columns; inferred or known."""

from rfdropo_bayes.bayes.noise.autoregression import Autoregression
from rfdropo_bayes.bayes.noise.inferred import (
    LASTING_NOISE,
    NOISE_CORRELATION_TIME,
    NOISE_MODELS,
    OBSERVATION_NOISE,
    Noise,
    Timeline,
    draw_noise,
    noise_specs,
    noise_values,
    row_log_density,
    timeline,
    whiten,
)
