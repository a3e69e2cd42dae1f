"""Inference methods. They see a `Problem` and nothing of the simulator behind it."""

from rfdropo_bayes.runtime import configure_jax

configure_jax()
