"""Checks of a calibration, one file each: whether it can be trusted, and what is wrong where it cannot."""
