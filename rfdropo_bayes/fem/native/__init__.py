"""Compiled engines for CPUs: many rollouts side by side in the lanes of vector registers."""
