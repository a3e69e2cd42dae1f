"""Experiments: files, the objects that a file describes, models, and the folders of runs."""
