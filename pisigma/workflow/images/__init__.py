"""What is done with images of boards: corners for a calibration of the robot, and intrinsics of a camera."""
