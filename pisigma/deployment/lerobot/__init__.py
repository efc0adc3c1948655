"""Calibrated models for LeRobot: its calibration file, and corrected frames of policies and data sets."""
