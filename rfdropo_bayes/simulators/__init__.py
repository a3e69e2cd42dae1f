"""Simulators: the same call for every engine."""

from rfdropo_bayes.runtime import configure_jax

configure_jax()
