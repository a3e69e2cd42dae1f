"""Predictions under a posterior: of fitted recordings, and of new recordings from commands and at most a first row."""
