"""Whether a correction is active, and which fault of the set-up explains large errors."""
