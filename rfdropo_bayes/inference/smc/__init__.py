"""Sequential Monte Carlo: its starts, the moves of its particles, and the bridge from optima to the posterior."""
