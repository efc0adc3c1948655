"""Faults of the setup or the file that explain large errors: hypotheses, their trial and their report."""
