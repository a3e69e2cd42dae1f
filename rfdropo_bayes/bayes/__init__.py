"""Named parameters, priors, noise models and the rollout likelihood that joins them."""

from rfdropo_bayes.runtime import configure_jax

configure_jax()
