"""Sequential Monte Carlo: where it starts, how its particles move, and the bridge from optima to the posterior."""
