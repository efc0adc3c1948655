"""Geometric calibration as a least-squares problem, and its solver."""
