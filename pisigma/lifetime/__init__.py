"""Changes since a calibration: recalibration, monitoring, comparison, fleets."""
