"""Geometric calibration: initial guess, parameters, least squares, identifiability and result."""
