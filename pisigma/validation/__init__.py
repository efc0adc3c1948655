"""Validation of calibrations: held-out rows, setup faults, checks of rows and results, ISO 9283."""
