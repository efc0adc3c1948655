"""Changes since a calibration: recalibration, monitoring, comparison and fleets."""
