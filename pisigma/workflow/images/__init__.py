"""Images of boards: detection of corners for a calibration of the robot, and calibration of a camera."""
