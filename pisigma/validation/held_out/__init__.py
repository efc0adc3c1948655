"""Errors of calibrations on held-out rows."""
