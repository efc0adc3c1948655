"""One page by which an engineer accepts a calibration."""
