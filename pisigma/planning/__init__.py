"""Which poses to measure."""
