"""The verbs of the front door and of the command line, one module each, named after the verb."""
