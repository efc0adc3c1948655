"""Corners of printed boards in images, by OpenCV (the extra `camera`)."""
