"""Calibration: the geometric calibrator, and the hybrid one, which also learns joint corrections."""
