"""Predictions under a posterior: of fitted recordings, and of new ones from commands and at most a first row."""
