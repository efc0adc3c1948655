"""A cell as Python uses it: its file, and every step of a calibration with what the file states."""
