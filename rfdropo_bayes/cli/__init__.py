"""The command line: ``rfdropo calibrate | simulate | report``."""

from rfdropo_bayes.cli.main import main

__all__ = ["main"]
