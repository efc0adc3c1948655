"""Calibrated models for LeRobot: calibration file, and corrected frames of policies and data sets."""
