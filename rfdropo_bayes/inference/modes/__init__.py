"""Optima of a posterior: optimisations, their starts, and the normal approximations at their ends."""
