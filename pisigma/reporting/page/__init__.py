"""Calibration reports and other pages as single HTML files."""
