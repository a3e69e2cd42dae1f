"""The effects that a simulator lacks: detection, naming, extension, gain; see docs/audit.md."""

from rfdropo_bayes.runtime import configure_jax

configure_jax()
