"""How accurate a calibration is on rows that it never saw."""
