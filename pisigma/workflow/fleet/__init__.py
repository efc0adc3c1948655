"""Calibration of a fleet: of every robot individually, and of the prior of all robots."""
