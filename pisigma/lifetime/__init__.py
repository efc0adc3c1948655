"""What has changed since a calibration: recalibration, monitoring, comparison, fleets."""
