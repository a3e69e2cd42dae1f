"""What a simulator lacks, by name: show, name, extend, measure; see docs/audit.md."""

from rfdropo_bayes.runtime import configure_jax

configure_jax()
