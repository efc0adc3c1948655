"""Faults of the setup or the file that explain large errors: generation, test and report of hypotheses."""
