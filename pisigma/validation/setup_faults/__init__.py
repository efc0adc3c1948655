"""Faults of the setup or the file that explain large errors: hypotheses, how they are tried and reported."""
