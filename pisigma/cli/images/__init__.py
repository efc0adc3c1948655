"""Commands for images of boards: corners for a calibration, and the intrinsics of a camera."""
