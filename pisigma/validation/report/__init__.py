"""Figures of a calibration report, which the pages of `pisigma.reporting` render."""
