"""Calibration of a fleet: every robot by itself, and the prior of all robots."""
