"""Probabilistic sim-to-real for soft robots: calibrate a simulator, say what it lacks, and measure the gain."""

from rfdropo_bayes.runtime import limit_blas_threads

limit_blas_threads()

__version__ = "0.1.0"
