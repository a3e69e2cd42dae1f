"""What the verbs return, as objects that show themselves, draw their figures and write their files."""
