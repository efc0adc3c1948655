"""From rows to a calibrated robot: the geometric calibrator, and the hybrid that learns joint corrections, too."""
