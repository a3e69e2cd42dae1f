"""Inference methods. They depend on a `Problem` alone, not on its simulator.

| to find | look in |
|---|---|
| the methods by name | `methods` |
| the start, the stages and the moves of SMC | `smc.start`, `smc.sampler`, `smc.moves` |
| the search for modes | `modes.mode_search` |
| RF-DROPO | `rfdropo.phi_search` |
"""

from rfdropo_bayes.runtime import configure_jax

configure_jax()
