"""What an experiment means: its file, the objects behind it, the model made of them, and the folders of runs."""
