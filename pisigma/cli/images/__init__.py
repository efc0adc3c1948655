"""Commands for images of boards: detect corners, and calibrate a camera."""
