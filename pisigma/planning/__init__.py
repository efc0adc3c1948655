"""Planning of measurements: which poses to measure, in which order, and when to stop."""
