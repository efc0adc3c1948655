"""Checks of a calibration, one file each: whether it can be trusted, and if not, why."""
