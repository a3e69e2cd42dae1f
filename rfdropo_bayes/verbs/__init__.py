"""Functions of the Python interface and of the command line: one module for each verb."""
