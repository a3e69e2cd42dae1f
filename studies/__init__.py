"""What is run for a paper: Table I, Table II, effects hidden from audits, checks of a method on simulated data.

``python -m studies COMMAND``, from the repository, with what studies/requirements.txt names installed.
"""
