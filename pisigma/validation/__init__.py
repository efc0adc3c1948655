"""Validation of calibrations: held-out rows, setup faults, checks of rows and results, and ISO 9283."""
