"""Recalibration of a model with few new rows, and what moved since it was made."""
