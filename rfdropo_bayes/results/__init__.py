"""Results of the verbs, as objects that show themselves, draw their figures and write their files."""
