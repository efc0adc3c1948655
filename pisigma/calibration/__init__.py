"""Calibration: the geometric calibrator, and the hybrid calibrator, which also learns joint corrections."""
