"""Optima of a posterior: climbs, where they start, and the normal approximation around where they end."""
