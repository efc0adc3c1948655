"""Geometric calibration as a least-squares problem, and the solver."""
