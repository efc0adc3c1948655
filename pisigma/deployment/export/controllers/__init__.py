"""Calibration files of controllers: writers, and readers that return a robot."""
