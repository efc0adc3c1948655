"""Whether a calibration is right: rows left out, faults of the set-up, checks of rows and results, ISO 9283."""
