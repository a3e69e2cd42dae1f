"""Model extensions, each nested at a null value that reproduces the base simulator exactly."""

from rfdropo_bayes.runtime import configure_jax

configure_jax()

from rfdropo_bayes.mechanisms.registry import REGISTRY, mechanisms_named  # noqa: E402
