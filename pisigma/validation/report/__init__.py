"""Figures of a calibration report: what the pages of `pisigma.reporting` render."""
