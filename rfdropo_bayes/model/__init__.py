"""Experiments: their file, the objects it describes, the model made of them, and the folders of runs."""
