"""``python -m rfdropo_bayes`` is ``rfdropo``."""

from rfdropo_bayes.cli import main

main()
