"""Plain numpyro models: as a problem, and sampled in two passes."""
